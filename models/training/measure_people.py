"""Measure a person network through its ONNX file, into its card.

``python -m models.training.measure_people --scenes SCENES --scenes-labels FILE [--name person]``
on the scenes that training held out, against the teacher's boxes (label_scenes.py).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models.card import WEIGHTS_DIR, read_card, write_card
from models.cost import with_cost
from models.person_detector import PersonDetector, corners, iou
from models.session import OnnxModel
from models.training.dataset import Image
from models.training.scenes import LabelledScene, read_scenes

SURE = 0.7
"""Teacher's score from which a box has to be found."""
SAME, STRANGE = 0.5, 0.3
"""Overlap from which a box is the teacher's, and up to which it is none of the teacher's."""


def recall_and_extra(
    find: Callable[[Image], NDArray[np.float64]], scenes: list[LabelledScene]
) -> tuple[float, float]:
    """Share of the sure teacher boxes found; strange boxes a scene.

    ``find`` says where people are in a picture: corner boxes (n, 4) px.
    """
    found = wanted = extra = 0
    for scene in scenes:
        boxes = find(scene.image)
        known = scene.people[:, :4].astype(np.float64)
        sure = known[scene.people[:, 4] >= SURE]
        found += int((iou(boxes, sure).max(0, initial=0) > SAME).sum())
        wanted += len(sure)
        extra += int((iou(boxes, known).max(1, initial=0) < STRANGE).sum())
    return found / wanted, extra / len(scenes)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="tar or folder")
    parser.add_argument("--scenes-labels", type=Path, required=True)
    parser.add_argument("--weights", type=Path, default=WEIGHTS_DIR)
    parser.add_argument("--name", default="person")
    args = parser.parse_args()
    cv2.setNumThreads(1)

    _, scenes = read_scenes(args.scenes, args.scenes_labels)
    detector = PersonDetector(args.name, weights_dir=args.weights)
    recall, extra = recall_and_extra(lambda image: corners(detector.detect(image, 100)), scenes)
    path = args.weights / f"{args.name}.json"
    card = read_card(path)
    kept = {k: v for k, v in card.measured.items() if k == "training_steps"}
    measured = {
        **kept,
        f"recall_of_sure_teacher_boxes/{len(scenes)}_held_out_scenes": round(recall, 4),
        "boxes_beside_the_teacher's/scene": round(extra, 2),
        "command": "python -m models.training.measure_people --scenes SCENES --scenes-labels FILE",
    }
    model = OnnxModel(args.weights, args.name)
    update = {"measured": measured, "accuracy": round(recall, 4)}
    card = with_cost(card.model_copy(update=update), model)
    write_card(path, card)
    print(measured | card.cost_ms)


if __name__ == "__main__":
    main()
