"""2D from the photo: frames of Human3.6M's videos through the pose network that would serve.

``S*/Videos/<action>.<camera>.mp4`` shows the clip of that subject, action and camera, frame by
frame. The network is given the box of the true joints, as the paper's is given the person.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from app.engine import chosen_networks
from app.settings import load_settings
from evaluation.paper.datasets import h36m_column
from evaluation.paper.systems import Seen2D
from evaluation.paper.views import Scene, Views
from evaluation.progress import followed
from models.person_detector import PersonBox
from models.pose_estimator import PoseEstimator

Key = tuple[str, str, str, str]
"""Subject, column of the table, number of the trial, camera."""


def find_videos(root: Path) -> dict[Key, Path]:
    """The videos under ``root``, whichever way their actions are spelt."""
    found = {}
    for path in sorted(root.rglob("*.mp4")):
        subject = next((p for p in reversed(path.parts) if re.fullmatch(r"S\d{1,2}", p)), "")
        action, _, camera = path.stem.partition(".")
        column = h36m_column(action)
        if subject and column and camera:
            found[subject, column, _trial(action), camera] = path
    return found


def look_at_videos(views: Views, videos: dict[Key, Path]) -> tuple[Views, Seen2D, list[str]]:
    """The views whose video is there and can be read, what the network sees, and what is missing.

    ``ModelError`` when the network cannot be loaded.
    """
    settings = load_settings()
    pose, _ = chosen_networks(settings)
    estimator = PoseEstimator(pose, weights_dir=settings.weights_dir, provider=settings.provider)
    truth = views.points_px()
    missing: list[str] = []
    rows: list[int] = []
    points, confidence, covariance, depths = [], [], [], []
    for camera, own in followed(views.by_camera(), "videos"):
        scene = views.scenes[int(views.scene[own[0]])]
        key = (scene.clip.subject, scene.action, _trial(scene.clip.action), camera.name)
        if key not in videos:
            missing.append(f"video of {scene.clip.name}, camera {camera.name}")
            continue
        order = own[np.argsort(views.at[own])]
        read = 0
        for row, image in _frames(videos[key], scene, views, order):
            low, high = truth[row].min(0), truth[row].max(0)
            box = PersonBox(
                x_px=float(low[0]),
                y_px=float(low[1]),
                width_px=float(high[0] - low[0]),
                height_px=float(high[1] - low[1]),
                score=1.0,
            )
            (joints,) = estimator.estimate(image, [box])
            points.append(joints.positions_px)
            confidence.append(joints.belief)
            covariance.append(joints.covariance_px2)
            depths.append(joints.depths_px)
            rows.append(row)
            read += 1
        if read < len(own):
            missing.append(f"{videos[key]}: {len(own) - read} of {len(own)} frames")
    if not rows:
        return views[:0], Seen2D(np.zeros((0, 14, 2))), missing
    seen = Seen2D(
        np.array(points, np.float64),
        np.array(confidence, np.float64),
        np.array(covariance, np.float64),
        depths_px=None if depths[0] is None else np.array(depths, np.float64),
    )
    return views[np.array(rows)], seen, missing


def _frames(
    path: Path, scene: Scene, views: Views, rows: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """(row, picture) of ascending rows, as far as the video goes."""
    capture = cv2.VideoCapture(str(path))
    try:
        index = -1
        for row in rows.tolist():
            wanted = int(scene.clip.frames[views.at[row]])
            while index < wanted:
                if not capture.grab():
                    return
                index += 1
            ok, frame = capture.retrieve()
            if not ok:
                return
            yield row, np.asarray(frame, np.uint8)
    finally:
        capture.release()


def _trial(action: str) -> str:
    """``Walking 1`` -> 1; the other trial has no number or another one."""
    number = re.search(r"[ _](\d)$", action)
    return number[1] if number else ""
