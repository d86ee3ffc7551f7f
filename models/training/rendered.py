"""Rendered people as training data: ``python -m models.training.rendered --out rendered.tar``.

Photos with exact labels are rare, and rarest for people seen from behind, bent, lying or upside
down. This program poses a CC0 body after mocap, dresses it, lights it, and puts it before patches
of photos; the labels are the skeleton's own projections, and the truth in 3D is beside them. Each
crop depends on the seed and its number alone, so that a set can be made in parts and made again.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import tarfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from library_store.arguments import SEED, integer
from library_store.skeleton import LSP14
from models.errors import AnnotationError
from models.training.dataset import decode_members
from models.training.rendering.backdrop import Backgrounds
from models.training.rendering.body import BodyModel
from models.training.rendering.pose import Poser, TrunkStats
from models.training.rendering.poses import PoseSource
from models.training.rendering.scene import Studio
from models.training.scenes import read_people

JPEG_QUALITY = (60, 95)
CAST = 250


@dataclass(frozen=True)
class Entry:
    """A crop as it is stored: its record in the annotations and its JPEG."""

    record: dict[str, Any]
    jpeg: bytes


def make_entry(studio: Studio, seed: int, number: int) -> Entry:
    """Crop ``number`` of the set with this seed."""
    rng = np.random.default_rng((seed, number))
    size = 192 if rng.random() < 0.75 else int(rng.integers(96, 192))
    crop = studio.crop(rng, size)
    quality = int(rng.integers(*JPEG_QUALITY))
    _, data = cv2.imencode(".jpg", crop.image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    record: dict[str, Any] = {
        "image": f"r{number:05d}.jpg",
        "size_px": size,
        "joints_px": np.round(crop.joints_px.astype(float), 2).tolist(),
        "joints_mm": np.round(crop.joints_mm.astype(float), 1).tolist(),
        "focal_length_px": round(crop.focal_length_px, 3),
        "principal_point_px": np.round(crop.principal_point_px.astype(float), 3).tolist(),
        "labelled": [1] * LSP14.n_joints,
        "visible": crop.visible.astype(int).tolist(),
        "wild": False,
    }
    return Entry(record, data.tobytes())


def open_studio(
    body: Path,
    mocap: Path,
    backgrounds: Path,
    unseen: Path | None = None,
    people: Path | None = None,
    cast: int = CAST,
) -> Studio:
    """Read everything that is needed to render.

    ``body`` the folder mpfb2, ``mocap`` an npz with ``positions`` (N, 14, 3) mm y up,
    ``backgrounds`` a tar of JPEGs, ``people`` their boxes as ``models.training.label_scenes``
    writes them, ``unseen`` a ground_truth.json whose poses are kept out, ``cast`` how many bodies.
    Raises ``AnnotationError`` where ``people`` is of other photos.
    """
    photos = decode_members(backgrounds)
    avoid = [np.zeros((0, 4), np.float32)] * len(photos)
    if people is not None:
        boxes = read_people(people)
        missing = sorted(photos.keys() - boxes.keys())
        if missing:
            raise AnnotationError(f"{people} does not say who is in {missing[0]} of {backgrounds}")
        avoid = [boxes[name][:, :4] for name in photos]
    poses = np.load(mocap)["positions"][::2].astype(np.float32)  # neighbours hardly differ
    tests = None
    if unseen is not None:
        records = json.loads(unseen.read_text())["images"]
        in_camera = np.array([r["joints_3d_mm"] for r in records], np.float32)
        tests = in_camera * np.array([1, -1, -1], np.float32)
    model = BodyModel(body)
    source = PoseSource(poses, tests)
    poser = Poser(model, TrunkStats.of(poses[::97]))
    return Studio(model, poser, source, Backgrounds(list(photos.values()), avoid), cast)


def write_tar(path: Path, entries: list[Entry], seed: int) -> None:
    """JPEGs and annotations.json, byte for byte the same for the same entries."""
    annotations = {
        "joint_names": list(LSP14.joint_names),
        "source": f"rendered by models.training.rendered, seed {seed}",
        "images": [e.record for e in entries],
    }
    partial = path.with_suffix(".part")
    with tarfile.open(partial, "w") as tar:
        files = [(str(e.record["image"]), e.jpeg) for e in entries]
        for name, data in [("annotations.json", json.dumps(annotations).encode()), *files]:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    partial.rename(path)


class _Worker:
    """What a worker process was forked with; ``pool.map`` can only send it numbers."""

    studio: Studio
    seed: int

    @classmethod
    def start(cls, studio: Studio, seed: int) -> None:
        cv2.setNumThreads(1)
        cls.studio, cls.seed = studio, seed

    @classmethod
    def make(cls, number: int) -> Entry:
        return make_entry(cls.studio, cls.seed, number)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body", type=Path, required=True, help="folder mpfb2 (CC0)")
    parser.add_argument("--mocap", type=Path, required=True, help="npz with positions in mm")
    parser.add_argument("--backgrounds", type=Path, required=True, help="tar of JPEGs")
    parser.add_argument("--people", type=Path, help="boxes of people in the backgrounds")
    parser.add_argument("--unseen", type=Path, help="ground_truth.json of test renders")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=integer(1), default=5000)
    parser.add_argument("--first", type=integer(0), default=0, help="number of the first crop")
    parser.add_argument("--jobs", type=integer(1), default=1)
    parser.add_argument("--seed", type=SEED, default=0)
    args = parser.parse_args()
    studio = open_studio(args.body, args.mocap, args.backgrounds, args.unseen, args.people)
    numbers = range(args.first, args.first + args.count)
    started = time.monotonic()
    entries: list[Entry] = []
    with ProcessPoolExecutor(
        args.jobs, multiprocessing.get_context("fork"), _Worker.start, (studio, args.seed)
    ) as pool:
        for entry in pool.map(_Worker.make, numbers, chunksize=10):
            entries.append(entry)
            if len(entries) % 100 == 0:
                each = (time.monotonic() - started) / len(entries)
                print(f"{len(entries)}/{args.count}  {1000 * each:.0f} ms each", flush=True)
    write_tar(args.out, entries, args.seed)


if __name__ == "__main__":
    main()
