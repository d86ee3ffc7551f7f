"""What photos may be like: people found, and their joints, when photos are turned, dark, noisy.

    python -m evaluation.robustness --data DIR [--every 4]

``--data`` has ``photos_*.tar``. One in ``--every`` of the held-out people, each crop a photo of its
own, is changed in one way after the other and answered as the service answers photos. *Found*: a
box that overlaps the labelled joints' by half (IoU); PCK@0.2 is of those who are found.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from app.engine import load_engine
from app.pipeline import PhotoQuery, Pipeline, SeenPerson
from app.settings import load_settings
from evaluation.metrics import Floats
from evaluation.people import SAME
from evaluation.pose2d import held_out_photos
from evaluation.progress import followed
from library_store.arguments import integer
from models.pck import correct_keypoints
from models.person_detector import iou
from models.training.augment import MIRROR
from models.training.dataset import Image, LabelledCrop

NOISE_SIGMA, NOISE_SEED = 25.0, 0
"""Of each colour, in grey levels."""


@dataclass(frozen=True)
class Seen:
    """A photo (h, w, 3) uint8 BGR with somebody's joints (14, 2) px, and which are labelled."""

    image: Image
    joints_px: Floats
    known: Floats


Change = Callable[[Seen], Seen]


def quarter_turns(count: int) -> Change:
    """Turned clockwise by that many quarters."""

    def turned(seen: Seen) -> Seen:
        image, joints = seen.image, seen.joints_px
        for _ in range(count):
            joints = np.stack([image.shape[0] - 1 - joints[:, 1], joints[:, 0]], 1)
            image = np.ascontiguousarray(np.rot90(image, -1))
        return Seen(image, joints, seen.known)

    return turned


def mirrored(seen: Seen) -> Seen:
    """In the mirror: who raised the right hand raises the left one."""
    joints = seen.joints_px[MIRROR].copy()
    joints[:, 0] = seen.image.shape[1] - 1 - joints[:, 0]
    return Seen(np.ascontiguousarray(seen.image[:, ::-1]), joints, seen.known[MIRROR])


def shrunk_to(long_side_px: int) -> Change:
    """Shrunk until the longer side has so many pixels."""

    def shrunk(seen: Seen) -> Seen:
        height, width = seen.image.shape[:2]
        scale = long_side_px / max(height, width)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        small = np.asarray(cv2.resize(seen.image, size, interpolation=cv2.INTER_AREA))
        ratio = np.array(size) / (width, height)
        return Seen(small, (seen.joints_px + 0.5) * ratio - 0.5, seen.known)

    return shrunk


def repainted(paint: Callable[[Image], Image]) -> Change:
    """Other pixels in the same places."""
    return lambda seen: Seen(paint(seen.image), seen.joints_px, seen.known)


def exposed(factor: float) -> Callable[[Image], Image]:
    """All colours times ``factor``, cut off at white."""
    return lambda image: np.clip(image * factor, 0, 255).astype(np.uint8)


def _grey(image: Image) -> Image:
    return np.repeat(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None], 3, -1)


def _noisy(image: Image) -> Image:
    noise = np.random.default_rng(NOISE_SEED).normal(0, NOISE_SIGMA, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _compressed(image: Image) -> Image:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 8])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


CHANGES: dict[str, Change] = {
    "as it is": lambda seen: seen,
    "in the mirror": mirrored,
    "a quarter turn": quarter_turns(1),
    "upside down": quarter_turns(2),
    "a quarter turn back": quarter_turns(3),
    "a fifth of the light": repainted(exposed(0.2)),
    "twice the light": repainted(exposed(2.0)),
    "grey": repainted(_grey),
    "blurred, 2 px": repainted(lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0))),
    "blurred, 4 px": repainted(lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 4.0))),
    f"noise of {NOISE_SIGMA:g} grey levels": repainted(_noisy),
    "JPEG of quality 8": repainted(_compressed),
    "96 px long": shrunk_to(96),
    "64 px long": shrunk_to(64),
}


@dataclass
class Tally:
    """Of people asked for: how many photos were answered with nobody, who was found, how well."""

    asked: int = 0
    nobody: int = 0
    found: int = 0
    right: int = 0
    joints: int = 0

    def add(self, people: tuple[SeenPerson, ...], seen: Seen, wanted: Floats) -> None:
        """Count one photo's answer."""
        self.asked += 1
        self.nobody += not people
        if not people:
            return
        boxes = np.array([person.box_px for person in people])
        boxes[:, 2:] += boxes[:, :2]
        overlap = iou(boxes, wanted)[:, 0]
        if overlap.max() <= SAME:
            return
        self.found += 1
        near = correct_keypoints(people[int(overlap.argmax())].joints_px, seen.joints_px)
        known = seen.known > 0
        self.right += int(near[known].sum())
        self.joints += int(known.sum())

    def row(self, name: str) -> str:
        """A line of the table."""
        pck = f"{100 * self.right / self.joints:.1f}" if self.joints else "-"
        shares = (100 * self.nobody / self.asked, 100 * self.found / self.asked)
        return f"| {name} | {shares[0]:.1f} | {shares[1]:.1f} | {pck} |"


def tally(pipeline: Pipeline, crops: list[LabelledCrop], name: str) -> Tally:
    """Answer every crop after the change of that name."""
    counts = Tally()
    for crop in followed(crops, name):
        plain = Seen(crop.image, crop.joints_px.astype(np.float64), crop.weight.astype(np.float64))
        seen = CHANGES[name](plain)
        known = seen.joints_px[seen.known > 0]
        wanted = np.concatenate([known.min(0), known.max(0)])[None]
        data = cv2.imencode(".png", seen.image)[1].tobytes()
        counts.add(pipeline.estimate(data, PhotoQuery()).people, seen, wanted)
    return counts


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--every", type=integer(1), default=4)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    crops = [crop for crop in held_out_photos(args.data)[:: args.every] if crop.has_torso]
    pipeline = load_engine(load_settings()).pipeline
    print(f"{len(crops)} held-out people\n")
    print("| photo | answered with nobody, % | found, % | PCK@0.2 of the found, % |")
    print("|---|---|---|---|")
    for name in CHANGES:
        print(tally(pipeline, crops, name).row(name), flush=True)


if __name__ == "__main__":
    main()
