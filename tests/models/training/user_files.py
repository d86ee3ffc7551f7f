"""A user's labelled images: a small COCO folder and a small Human3.6M."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
NAMES = ["nose", *(f"{side}_{limb}" for limb in LIMBS for side in ("left", "right"))]
FIGURE = {
    "nose": (0, -60),
    "shoulder": (16, -40),
    "elbow": (24, -15),
    "wrist": (28, 8),
    "hip": (10, 10),
    "knee": (12, 45),
    "ankle": (13, 80),
}
"""A standing person, half of it, in pixels about the middle."""


def place(name: str, x: float, y: float, scale: float) -> tuple[float, float]:
    """Where a keypoint of the figure lies; the person faces the camera."""
    side, _, part = name.rpartition("_")
    dx, dy = FIGURE[part]
    return x + scale * dx * (1 if side == "left" else -1), y + scale * dy


def draw(image: np.ndarray, points: dict[str, tuple[float, float]]) -> None:
    for side in ("left", "right"):
        for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("shoulder", "hip")):
            ends = [tuple(int(v) for v in points[f"{side}_{limb}"]) for limb in (a, b)]
            cv2.line(image, ends[0], ends[1], (40, 90, 200), 7)
        for a, b in (("hip", "knee"), ("knee", "ankle")):
            ends = [tuple(int(v) for v in points[f"{side}_{limb}"]) for limb in (a, b)]
            cv2.line(image, ends[0], ends[1], (160, 60, 40), 9)


def coco(folder: Path, n_images: int = 3, size: tuple[int, int] = (320, 240)) -> dict[str, Any]:
    """Write the images; the records of two people an image, the second without legs."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    width, height = size
    records: dict[str, Any] = {
        "images": [],
        "annotations": [],
        "categories": [{"id": 1, "name": "person", "keypoints": NAMES}],
    }
    for i in range(n_images):
        image = rng.integers(0, 80, (height, width, 3)).astype(np.uint8)
        for person, x in enumerate((90, 230)):
            at = {n: place(n, x + rng.normal(0, 5), 120, rng.uniform(0.9, 1.1)) for n in NAMES}
            draw(image, at)
            keypoints: list[float] = []
            for name, (px, py) in at.items():
                hidden = person == 1 and name.endswith(("knee", "ankle"))
                keypoints += [0, 0, 0] if hidden else [round(px, 1), round(py, 1), 2]
            records["annotations"].append(
                {
                    "id": 10 * i + person,
                    "image_id": i,
                    "category_id": 1,
                    "keypoints": keypoints,
                    "iscrowd": 0,
                }
            )
        cv2.imwrite(str(folder / f"{i}.png"), image)
        records["images"].append(
            {"id": i, "file_name": f"{i}.png", "width": width, "height": height}
        )
    return records


def write(path: Path, records: dict[str, Any]) -> Path:
    path.write_text(json.dumps(records))
    return path
