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


H36M = {13: "nose", 15: "nose", 17: "left_shoulder", 18: "left_elbow", 19: "left_wrist"}
H36M |= {25: "right_shoulder", 26: "right_elbow", 27: "right_wrist", 1: "right_hip"}
H36M |= {2: "right_knee", 3: "right_ankle", 6: "left_hip", 7: "left_knee", 8: "left_ankle"}
"""Which of Human3.6M's 32 joints the figure has."""


def human36m_clip(root: Path, name: str, n_frames: int) -> np.ndarray:
    """Write the video of S1 walking to the right; returns the poses (F, 32, 2) in pixels."""
    (root / "S1" / "MyPoseFeatures" / "D2_Positions").mkdir(parents=True, exist_ok=True)
    videos = root / "S1" / "Videos"
    videos.mkdir(exist_ok=True)
    pose = np.full((n_frames, 32, 2), 50.0)
    writer = cv2.VideoWriter(
        str(videos / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 50, (320, 240)
    )
    for i in range(n_frames):
        at = {n: place(n, 80 + 5 * i, 120, 1.0) for n in NAMES}
        image = np.zeros((240, 320, 3), np.uint8)
        draw(image, at)
        writer.write(image)
        for index, joint in H36M.items():
            pose[i, index] = at[joint]
    writer.release()
    return pose


def write(path: Path, records: dict[str, Any]) -> Path:
    path.write_text(json.dumps(records))
    return path
