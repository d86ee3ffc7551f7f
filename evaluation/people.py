"""Finding people: recall, precision, duplicates and false alarms, of the boxes and of the answer.

    python -m evaluation.people --data DIR --labels FILE [--seed 0]

``--data`` has ``photos_scenes.tar``, ``photos_*.tar`` and ``lspet_val.tar``; ``--labels`` is what
``models.training.label_scenes`` wrote of the scenes. All of it was held out from training: one
scene in eight, mosaics of held-out people (exact boxes), their crops as they are, patches of
held-out scenes with nobody. "Answered" are the people left after the pose network's second thoughts
(models/presence.py), or, where nobody is left, of the look for people who fill the photo.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from app.engine import chosen_networks
from app.settings import load_settings
from evaluation.pose2d import held_out_photos
from evaluation.progress import followed
from library_store.arguments import SEED
from models import PersonBox, PersonDetector, PoseEstimator
from models.person_detector import Floats, corners, iou
from models.presence import present
from models.training.dataset import Image, LabelledCrop, decode_members, load
from models.training.scenes import DEV_ONE_IN, mosaic

SURE = 0.7
"""Teacher's score from which a box has to be found; surer and unsurer ones excuse a box."""
SAME, STRANGE = 0.5, 0.3
"""Overlap (IoU) from which two boxes are of one person, and up to which of nobody known."""
LEAST_HEIGHT_PX = 60.0
MOST_PEOPLE = 10
MOSAICS, EMPTY = 200, 200
MOSAIC_SIZE = (640, 480)

Find = Callable[[Image], list[PersonBox]]


@dataclass(frozen=True)
class Scene:
    """A picture, the boxes to be found (n, 4) and all that excuse one (m, 4), corners in px."""

    image: Image
    wanted: Floats
    known: Floats


@dataclass(frozen=True)
class Counts:
    """What was found in a set of scenes."""

    scenes: int
    wanted: int
    found: int
    boxes: int
    strange: int
    duplicates: int
    peopled: int
    """Scenes with somebody to be found, and how many of these came back without a box."""
    missed: int

    def row(self, name: str) -> str:
        """A line of the table."""
        recall = f"{100 * self.found / self.wanted:.1f}" if self.wanted else "-"
        precision = f"{100 * (1 - self.strange / self.boxes):.1f}" if self.boxes else "-"
        missed = f"{100 * self.missed / self.peopled:.1f}" if self.peopled else "-"
        return (
            f"| {name} | {self.scenes} | {self.wanted} | {recall} | {missed} | {precision} "
            f"| {self.duplicates} | {self.strange / self.scenes:.3f} |"
        )


def count(find: Find, scenes: list[Scene], label: str) -> Counts:
    """Run ``find`` over scenes. A duplicate is a further box of somebody found already."""
    found = wanted = total = strange = duplicates = peopled = missed = 0
    for scene in followed(scenes, label):
        boxes = corners(find(scene.image))
        overlap = iou(boxes, scene.wanted)
        found += int((overlap.max(0, initial=0) > SAME).sum())
        wanted += len(scene.wanted)
        peopled += bool(len(scene.wanted))
        missed += bool(len(scene.wanted)) and not len(boxes)
        total += len(boxes)
        strange += int((iou(boxes, scene.known).max(1, initial=0) < STRANGE).sum())
        duplicates += int(np.clip((overlap > SAME).sum(0) - 1, 0, None).sum())
    return Counts(len(scenes), wanted, found, total, strange, duplicates, peopled, missed)


def tall(boxes: Floats) -> Floats:
    """Those of at least LEAST_HEIGHT_PX."""
    return boxes[boxes[:, 3] - boxes[:, 1] >= LEAST_HEIGHT_PX]


def teacher_scenes(images: dict[str, Image], labels: Path) -> list[Scene]:
    """Held-out scenes with the teacher's boxes."""
    scenes = []
    for record in json.loads(labels.read_text())[::DEV_ONE_IN]:
        people = np.array(record["people"], np.float64).reshape(-1, 5)
        sure = tall(people[people[:, 4] >= SURE, :4])
        scenes.append(Scene(images[record["image"]], sure, people[:, :4]))
    return scenes


def empty_patches(scenes: list[Scene], rng: np.random.Generator) -> list[Image]:
    """Patches of scenes that touch no known box, at most eight a scene, in random order."""
    patches: list[Image] = []
    for scene in scenes:
        height, width = scene.image.shape[:2]
        kept = 0
        for _ in range(400):
            w, h = (int(v) for v in rng.uniform(0.25, 0.9, 2) * (width, height))
            x, y = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
            low = np.maximum(scene.known[:, :2], (x, y))
            high = np.minimum(scene.known[:, 2:], (x + w, y + h))
            if (high > low).all(1).any():
                continue
            patches.append(scene.image[y : y + h, x : x + w])
            kept += 1
            if kept == 8:
                break
    order: NDArray[np.int64] = rng.permutation(len(patches))
    return [patches[i] for i in order]


def around(crop: LabelledCrop) -> Floats:
    """The box (1, 4) around a person's labelled joints."""
    known = crop.joints_px[crop.weight > 0].astype(np.float64)
    return np.concatenate([known.min(0), known.max(0)])[None]


def filled(crop: LabelledCrop) -> Scene:
    """A crop as a photo of its own."""
    return Scene(crop.image, around(crop), around(crop))


def finders() -> dict[str, Find]:
    """The person network alone, and what the service would answer, with the networks it chooses."""
    settings = load_settings()
    pose, people = chosen_networks(settings)
    where, provider = settings.weights_dir, settings.provider
    detector = PersonDetector(people, weights_dir=where, provider=provider)
    estimator = PoseEstimator(pose, weights_dir=where, provider=provider)

    def shown(image: Image, boxes: list[PersonBox]) -> list[PersonBox]:
        return [boxes[i] for i in present(boxes, estimator.estimate(image, boxes))]

    def answered(image: Image) -> list[PersonBox]:
        people = shown(image, detector.detect(image, MOST_PEOPLE))
        return people or shown(image, detector.detect_close(image, MOST_PEOPLE))

    return {"boxes": lambda image: detector.detect(image, MOST_PEOPLE), "answered": answered}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("--seed", type=SEED, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(args.seed)
    scenes = teacher_scenes(decode_members(args.data / "photos_scenes.tar"), args.labels)
    empty = empty_patches(scenes, rng)
    sport, everyday = load(args.data / "lspet_val.tar"), held_out_photos(args.data)
    people = sport + everyday
    mosaics: list[Scene] = []
    while len(mosaics) < MOSAICS:
        made = mosaic(people, empty, MOSAIC_SIZE, rng)
        boxes = made.boxes.astype(np.float64)
        if len(boxes):
            mosaics.append(Scene(made.image, tall(boxes), boxes))
    nobody = np.empty((0, 4))
    sets = {
        "held-out scenes, teacher's boxes": scenes,
        "mosaics, exact boxes": mosaics,
        "lspet_val's crops, which one person fills": [filled(crop) for crop in sport],
        "photos' crops, which one person fills": [filled(crop) for crop in everyday],
        "patches without people": [Scene(p, nobody, nobody) for p in empty[:EMPTY]],
    }
    print(
        "| set: of what | scenes | people | recall, % | nobody, % | precision, % | duplicates "
        "| strange/scene |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for title, chosen in sets.items():
        for who, find in finders().items():
            print(count(find, chosen, title).row(f"{title}: {who}"), flush=True)


if __name__ == "__main__":
    main()
