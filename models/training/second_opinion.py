"""People whom the teacher missed: ``python -m models.training.second_opinion --help``.

The shipped networks go over the scenes that ``label_scenes`` labelled, whole and in tiles. Where
person and pose network agree on somebody without a teacher's box, a box is added: a sure one where
they are very sure, else an unsure one, which training takes for "do not know". The scenes that are
held out keep the teacher's boxes alone, so that figures stay comparable.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from models.card import WEIGHTS_DIR
from models.person_detector import PersonDetector, corners, iou
from models.pose_estimator import PoseEstimator
from models.training.dataset import Image, decode_members
from models.training.scenes import DEV_ONE_IN, SURE

Boxes = NDArray[np.float64]

LEAST_SCORE, LEAST_CONFIDENCE, BEST_JOINTS = 0.25, 0.55, 8
"""Of the box; mean of that many best joints' confidence: below, the two do not agree."""
SEEN_JOINT, SEEN_JOINTS = 0.3, 8
SURE_PRODUCT = 0.45
"""Product of both from which an added box is sure."""
ADDED_SURE, ADDED_UNSURE = 0.65, 0.45
"""Scores that added boxes get; ``SURE`` lies between them."""


@dataclass(frozen=True)
class Opinion:
    """Somebody both networks see: ``box_px`` (4,) around the joints, and how sure they are."""

    box_px: Boxes
    product: float


def opinions(image: Image, detector: PersonDetector, estimator: PoseEstimator) -> list[Opinion]:
    """Whom the networks agree on in a scene and in nine overlapping quarters of it, best first."""
    height, width = image.shape[:2]
    tiles = [(0, 0, width, height)]
    for y in (0.0, 0.25, 0.5):
        tiles += [
            (int(x * width), int(y * height), width // 2, height // 2) for x in (0, 0.25, 0.5)
        ]
    found: list[Opinion] = []
    for x, y, w, h in tiles:
        tile = np.ascontiguousarray(image[y : y + h, x : x + w])
        boxes = detector.detect(tile, 10, threshold=LEAST_SCORE)
        for box, pose in zip(boxes, estimator.estimate(tile, boxes), strict=True):
            confidence = float(np.sort(pose.belief)[-BEST_JOINTS:].mean())
            seen = pose.belief > SEEN_JOINT
            if confidence < LEAST_CONFIDENCE or seen.sum() < SEEN_JOINTS:
                continue
            low, high = pose.positions_px[seen].min(0), pose.positions_px[seen].max(0)
            around = np.concatenate([low, high])
            inner = (low < 4) & (np.array([x, y]) > 0)
            inner |= (high > np.array([w, h]) - 5) & (
                np.array([x + w, y + h]) < np.array([width, height]) - 1
            )
            if inner.any() or iou(corners([box]), around[None])[0, 0] < 0.55:
                continue  # cut by the tile's own border, or the two mean different things
            found.append(Opinion(around + np.array([x, y, x, y]), box.score * confidence))
    return sorted(found, key=lambda opinion: -opinion.product)


def added(people: list[list[float]], found: list[Opinion]) -> list[list[float]]:
    """The teacher's ``people`` (box and score each) and those that the opinions add."""
    people = [list(person) for person in people]
    teachers = len(people)
    for opinion in found:
        box = opinion.box_px
        known = np.array([person[:4] for person in people], np.float64).reshape(-1, 4)
        overlap = iou(box[None], known)[0]
        if overlap.max(initial=0) > 0.4:
            best = int(overlap.argmax())
            confirmed = opinion.product > 0.4 and overlap[best] > 0.5
            if best < teachers and people[best][4] < SURE and confirmed:
                people[best][4] = 0.62
            continue
        if (_inside(box[None], known) > 0.75).any() or (_inside(known, box[None]) > 0.75).any():
            continue  # somebody's upper half, or two people in one box
        width, height = box[2:] - box[:2]
        part = (_inside(box[None], known[:teachers]) > 0.5).any() or height < 1.3 * width
        sure = opinion.product > SURE_PRODUCT and not part
        rounded = [round(float(v), 1) for v in box]
        people.append([*rounded, ADDED_SURE if sure else ADDED_UNSURE])
    return people


def _inside(a: Boxes, b: Boxes) -> NDArray[np.float64]:
    """Share of each box of ``a`` (n, 4) that lies in each of ``b`` (m, 4), (n, m)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    share: NDArray[np.float64] = np.clip(high - low, 0, None).prod(-1)
    share /= np.maximum((a[:, 2:] - a[:, :2]).prod(-1), 1.0)[:, None]
    return share


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="folder or tar of JPEG scenes")
    parser.add_argument("--scenes-labels", type=Path, required=True, help="label_scenes' file")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--weights", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--people", default="person-int8")
    parser.add_argument("--pose", default="cpm-int8")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    detector = PersonDetector(args.people, weights_dir=args.weights)
    estimator = PoseEstimator(args.pose, weights_dir=args.weights)
    images = decode_members(args.scenes)
    records = json.loads(args.scenes_labels.read_text())
    before = sum(len(record["people"]) for record in records)
    console = Console(stderr=True)
    for i, record in enumerate(track(records, "scenes", transient=True, console=console)):
        if i % DEV_ONE_IN:
            found = opinions(images[record["image"]], detector, estimator)
            record["people"] = added(record["people"], found)
    args.out.write_text(json.dumps(records))
    print(f"{before} boxes, now {sum(len(record['people']) for record in records)}")


if __name__ == "__main__":
    main()
