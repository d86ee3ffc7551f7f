"""Where to draw the line between somebody and nobody (``models.presence.LEAST_BELIEF``).

``python -m models.training.presence_threshold --data DIR --scenes-labels FILE`` prints, for a range
of thresholds, what they keep of the boxes that the teacher confirms in training scenes, and what
they drop of those that show nobody in mosaics of training crops (exact boxes). The threshold is
chosen by eye from that table; held-out people judge it (``evaluation.people``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from library_store.arguments import SEED
from models.card import WEIGHTS_DIR
from models.person_detector import PersonDetector, corners, iou
from models.pose_estimator import PoseEstimator
from models.presence import belief
from models.training.crowds import calm_patches
from models.training.dataset import Image, held_out, load
from models.training.scenes import mosaic, read_scenes

SURE, SAME, STRANGE = 0.7, 0.5, 0.3
MOSAICS, MOSAIC_SIZE = 400, (640, 480)
THRESHOLDS = np.arange(0.10, 0.52, 0.03)


class Finder:
    """The two networks as the service uses them, up to the decision."""

    def __init__(self, people: str, pose: str, weights: Path) -> None:
        self._detector = PersonDetector(people, weights_dir=weights)
        self._estimator = PoseEstimator(pose, weights_dir=weights)

    def __call__(self, image: Image) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corner boxes (n, 4) px and the belief in each (n,)."""
        boxes = self._detector.detect(image, 10)
        poses = self._estimator.estimate(image, boxes)
        beliefs = [belief(box, pose) for box, pose in zip(boxes, poses, strict=True)]
        return corners(boxes), np.array(beliefs, np.float64)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--scenes-labels", type=Path, required=True)
    parser.add_argument("--weights", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--people", default="person-int8")
    parser.add_argument("--pose", default="cpm-int8")
    parser.add_argument("--seed", type=SEED, default=1)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(args.seed)
    find = Finder(args.people, args.pose, args.weights)
    console = Console(stderr=True)

    scenes, _ = read_scenes(args.data / "photos_scenes.tar", args.scenes_labels)
    somebody: list[float] = []
    for scene in track(scenes, "scenes", transient=True, console=console):
        boxes, beliefs = find(scene.image)
        sure = scene.people[scene.people[:, 4] >= SURE, :4].astype(np.float64)
        somebody += beliefs[iou(boxes, sure).max(1, initial=0) > SAME].tolist()
    crops = [
        crop
        for name in ("photos_a", "photos_b", "lspet_train_a")
        for crop in load(args.data / f"{name}.tar")
        if not held_out(crop)
    ]
    calm = calm_patches(scenes, rng)
    exact: list[float] = []
    nobody: list[float] = []
    for _ in track(range(MOSAICS), "mosaics", transient=True, console=console):
        made = mosaic(crops, calm, MOSAIC_SIZE, rng)
        boxes, beliefs = find(made.image)
        nearest = iou(boxes, made.boxes.astype(np.float64)).max(1, initial=0)
        exact += beliefs[nearest > SAME].tolist()
        nobody += beliefs[nearest < STRANGE].tolist()
    print(f"{len(somebody)} confirmed in scenes; {len(exact)} people, {len(nobody)} strange boxes")
    print("| least belief | kept in scenes, % | kept in mosaics, % | strange dropped, % |")
    print("|---|---|---|---|")
    for least in THRESHOLDS:
        shares = [100 * float((np.array(v) >= least).mean()) for v in (somebody, exact, nobody)]
        print(f"| {least:.2f} | {shares[0]:.1f} | {shares[1]:.1f} | {100 - shares[2]:.1f} |")


if __name__ == "__main__":
    main()
