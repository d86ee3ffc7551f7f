"""What pose networks get wrong, for the lifter to learn.

On photos joints are not noisy but now and then elsewhere: on the other leg, exchanged with the
other side, on somebody else. The network's confidence tells something of it; some networks also
say how deep the joints lie, and that is wrong in ways of its own. Rendered people
(``models.training.rendered``) have the truth in 3D. This program has a pose network find their
joints and keeps both:

    python -m models.training.lifter_mistakes --renders A.tar B.tar --out FILE.npz

``train_lifter --mistakes FILE.npz`` shows the lifter these people, and people of the pose prior
with the mistakes of whoever of these is seen most like them.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from library_store.arguments import SEED
from library_store.skeleton import LSP14
from library_store.upright import MOST_LEAN, lean_rad
from models.card import WEIGHTS_DIR
from models.errors import AnnotationError
from models.person_detector import PersonBox
from models.pose_estimator import PoseEstimator
from models.training.cut_short import end_px
from models.training.dataset import Image, decode_members, read_annotations
from models.training.lifter_samples import (
    IN_MIRROR,
    Floats,
    Samples,
    relative_depths,
    samples_of,
    seen_people,
)
from models.training.shortened import seen_box

LEAST_CONFIDENCE, LEAST_JOINTS = 0.2, 6
"""Joints of less confidence count as missing, as in the service; people with fewer are left out."""
SHIFT, GROWTH = 0.03, 0.08
"""Deviation of boxes from the true ones: of their place, in their longer side, and log size."""
CUT_OFF = 0.35
"""Share of those who are upright whose photo ends between their chest and their knees."""
CANDIDATES = 512
"""Among so many of the known people, drawn at random, the one seen most alike is looked for."""
CANDIDATES_IN_DEPTH = 2048
"""Among so many if they must also lie alike in depth."""
NO_HINTS = 0.2
"""Share of people whose depths are kept from the lifter, so that it can do without them."""
_ON_ANOTHER, _NEARER = 0.35, 0.5
"""A joint counts as put on another one when it lies so many radii from the own one, and at less
than such a share of that from the other."""
_MIRROR = np.array(LSP14.mirror)


@dataclass(frozen=True)
class Mistakes:
    """People (n) as a pose network found them.

    ``found`` and ``truth`` (n, 14, 2) normalised image coordinates, ``confidence`` (n, 14),
    ``joints_mm`` (n, 14, 3) in the camera frame; ``depths`` (n, 14) as the network read them off
    the picture, relative to the hips' (``z / z_root - 1``, the camera turned onto the person), nan
    if it reads none.
    """

    found: Floats
    confidence: Floats
    truth: Floats
    joints_mm: Floats
    depths: Floats

    def __len__(self) -> int:
        """How many people."""
        return len(self.found)

    @property
    def have_depths(self) -> bool:
        """Whether the network read depths."""
        return bool(np.isfinite(self.depths).any())

    def write(self, path: Path) -> None:
        """As one npz."""
        np.savez_compressed(path, **vars(self))

    @staticmethod
    def read(path: Path) -> Mistakes:
        """What ``write`` wrote; ``AnnotationError`` for any other file.

        Files from before pose networks read depths have none.
        """
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
                columns = dict(data)
            columns.setdefault("depths", np.full_like(columns["confidence"], np.nan))
            return Mistakes(**columns)
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise AnnotationError(f"{path} is not what lifter_mistakes wrote: {error}") from error

    def people(self, n: int, rng: np.random.Generator) -> Samples:
        """``n`` of these people themselves, half of them in the mirror."""
        who = rng.integers(len(self), size=n)
        flip = rng.random(n) < 0.5
        found, confidence, joints = self.found[who], self.confidence[who], self.joints_mm[who]
        depths = self.depths[who]
        found[flip] = (found[flip] * IN_MIRROR[:2])[:, _MIRROR]
        joints[flip] = (joints[flip] * IN_MIRROR)[:, _MIRROR]
        confidence[flip] = confidence[flip][:, _MIRROR]
        depths[flip] = depths[flip][:, _MIRROR]
        samples = _samples(found, confidence, joints)
        return _hinted(samples, depths, rng) if self.have_depths else samples


class Transplanter:
    """Gives people of the pose prior the mistakes of people who are seen like them.

    Mistakes are kept as shapes, joints less their mean over their RMS radius: a joint that was put
    on another one of the person goes to that one of the receiver, and what is left of the error is
    added in units of the radius. So it is with depths; they then also tell who is like whom. Read
    off a picture depths err towards 0 or to the other side: that error, carried over to someone
    whose limb points the other way, would make hints that mislead too seldom.
    """

    def __init__(self, mistakes: Mistakes) -> None:
        truth, centre, radius = _shape(mistakes.truth)
        found = (mistakes.found - centre) / radius
        self._truth = _with_mirror(truth)
        self._confidence = _with_mirror(mistakes.confidence)
        found = _with_mirror(found)
        apart = np.linalg.norm(found[:, :, None] - self._truth[:, None], axis=-1)
        own, nearest = apart.diagonal(axis1=1, axis2=2), apart.argmin(-1)
        elsewhere = (own > _ON_ANOTHER) & (apart.min(-1) < _NEARER * own)
        self._onto = np.where(elsewhere, nearest, np.arange(LSP14.n_joints))
        self._rest = found - np.take_along_axis(self._truth, self._onto[..., None], 1)
        self._have_depths = mistakes.have_depths
        self._seen = self._truth.reshape(len(self._truth), -1)
        if self._have_depths:
            people = _samples(mistakes.found, mistakes.confidence, mistakes.joints_mm)
            depths = _with_mirror(people.depths / radius[..., 0])
            read = _with_mirror(mistakes.depths / radius[..., 0])
            self._depth_rest = read - np.take_along_axis(depths, self._onto, 1)
            self._seen = np.concatenate([self._seen, depths], 1)

    def samples(self, poses_mm: Floats, n: int, rng: np.random.Generator) -> Samples:
        """``n`` people in poses (P, 14, 3) of the prior, badly found."""
        joints_mm = seen_people(poses_mm, n, rng)
        shape, centre, radius = _shape(joints_mm[..., :2] / joints_mm[..., 2:])
        seen, candidates = shape.reshape(n, -1), CANDIDATES
        if self._have_depths:
            seen = np.concatenate([seen, relative_depths(joints_mm) / radius[..., 0]], 1)
            candidates = CANDIDATES_IN_DEPTH
        known = rng.choice(len(self._seen), min(candidates, len(self._seen)), replace=False)
        flat = self._seen[known]
        apart2 = (flat**2).sum(1) - 2 * seen @ flat.T
        like = known[apart2.argmin(1)]
        found = np.take_along_axis(shape, self._onto[like, :, None], 1) + self._rest[like]
        samples = _samples(found * radius + centre, self._confidence[like], joints_mm)
        if not self._have_depths:
            return samples
        there = np.take_along_axis(samples.depths, self._onto[like], 1)
        return _hinted(samples, there + self._depth_rest[like] * radius[..., 0], rng)


def _samples(found: Floats, confidence: Floats, joints_mm: Floats) -> Samples:
    present = (confidence >= LEAST_CONFIDENCE).astype(np.float32)
    return samples_of(found.astype(np.float32), present, 1 - confidence, joints_mm)


def _hinted(samples: Samples, depths: Floats, rng: np.random.Generator) -> Samples:
    """With depths (n, 14) read off the picture: of joints that are there, and not of everybody."""
    heard = rng.random((len(depths), 1)) >= NO_HINTS
    known = heard & np.isfinite(depths) & (samples.present > 0)
    hint = np.where(known, depths, 0.0).astype(np.float32)
    return replace(samples, hint=hint, known=known.astype(np.float32))


def _shape(points: Floats) -> tuple[Floats, Floats, Floats]:
    """(n, 14, 2) -> the shapes, and the means (n, 1, 2) and radii (n, 1, 1) taken from them."""
    centre = points.mean(1, keepdims=True)
    radius = np.sqrt(((points - centre) ** 2).sum(2).mean(1))[:, None, None]
    return (points - centre) / radius, centre, radius


def _with_mirror(values: Floats) -> Floats:
    """And those of the people in the mirror: of shapes (n, 14, 2), or a value a joint (n, 14)."""
    mirrored = values * IN_MIRROR[:2] if values.ndim == 3 else values
    return np.concatenate([values, mirrored[:, _MIRROR]])


def find(renders: list[Path], estimator: PoseEstimator, rng: np.random.Generator) -> Mistakes:
    """Have a network find the people of rendered sets.

    Raises ``AnnotationError`` for sets without the truth in 3D, and when nobody is found.
    """
    rows: list[tuple[NDArray[np.float64], ...]] = []
    for path in renders:
        images = decode_members(path)
        records = read_annotations(path)
        for record in track(records, path.name, transient=True, console=Console(stderr=True)):
            if "joints_mm" not in record:
                raise AnnotationError(f"{path} has no 3D truth: render it anew")
            truth_px = np.array(record["joints_px"], np.float64)
            photo, corners = _photo(images[record["image"]], truth_px, rng)
            if corners is None:
                continue
            (found,) = estimator.estimate(photo, [_boxed(corners, rng)])
            if (found.belief >= LEAST_CONFIDENCE).sum() < LEAST_JOINTS:
                continue
            centre, focal = np.array(record["principal_point_px"]), record["focal_length_px"]
            normal = [(px - centre) / focal for px in (found.positions_px, truth_px)]
            depths = np.full(LSP14.n_joints, np.nan)
            if found.depths_px is not None:
                depths = found.depths_px / focal
            joints_mm = np.array(record["joints_mm"])
            rows.append((normal[0], found.belief, normal[1], joints_mm, depths))
    if not rows:
        raise AnnotationError(f"nobody is found in {', '.join(str(path) for path in renders)}")
    return Mistakes(*(np.array(part, np.float32) for part in zip(*rows, strict=True)))


def _photo(
    image: Image, truth_px: NDArray[np.float64], rng: np.random.Generator
) -> tuple[Image, NDArray[np.float64] | None]:
    """A rendered person's picture, cut off now and then, and the corners (4,) of who is left."""
    corners = np.concatenate([truth_px.min(0), truth_px.max(0)])
    if abs(lean_rad(truth_px)) > MOST_LEAN or rng.random() >= CUT_OFF:
        return image, corners
    height = int(np.clip(end_px(truth_px, rng), 1, len(image)))
    photo = np.array([0.0, 0.0, image.shape[1], height])
    return image[:height], seen_box(truth_px, np.ones(len(truth_px), np.bool_), photo)


def _boxed(corners: NDArray[np.float64], rng: np.random.Generator) -> PersonBox:
    """A box about as good as a detector's."""
    size = corners[2:] - corners[:2]
    middle = corners[:2] + size / 2 + rng.normal(0, SHIFT, 2) * size.max()
    size = size * np.exp(rng.normal(0, GROWTH))
    (x, y), (width, height) = middle - size / 2, size
    return PersonBox(x, y, width, height, score=1.0)


def main() -> None:
    """Command line: see the module."""
    parser = argparse.ArgumentParser(prog="models.training.lifter_mistakes", description=__doc__)
    parser.add_argument("--renders", type=Path, nargs="+", required=True, help="tars with 3D truth")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name", default="cpm-int8")
    parser.add_argument("--weights", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--seed", type=SEED, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    estimator = PoseEstimator(args.name, weights_dir=args.weights)
    mistakes = find(args.renders, estimator, np.random.default_rng(args.seed))
    mistakes.write(args.out)
    print(f"{args.out}: {len(mistakes)} people, {args.out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
