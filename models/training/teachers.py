"""Reference networks as teachers: whole scenes in, people's boxes out.

The two-network BlazePose pipeline (Apache-2.0, in ONNX, supplied by the user and never shipped): a
detector that gives mid-hip and a circle around each person, and a landmark network on the crop
turned upright. Scenes are searched whole and in tiles, so that small people are found too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, L_SHOULDER, R_HIP, R_SHOULDER
from models.crop import warped
from models.person_detector import iou
from models.training.dataset import Image

DETECTOR_SIZE = 224
LANDMARK_SIZE = 256
ROOM = 1.2
"""Radius of the circle around a person over the farthest joint's distance from the hips."""
_LEAST_TRUNK_PX = 1.0
_EARS, _SHOULDERS = (7, 8), (11, 12)
_BODY = (11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)


@dataclass(frozen=True)
class TeacherPerson:
    """``box_px`` (x0, y0, x1, y1) of the joints and ``landmarks_px`` (33, 2), in scene pixels."""

    box_px: NDArray[np.float64]
    landmarks_px: NDArray[np.float64]
    score: float


@dataclass(frozen=True)
class TeacherPose:
    """One person, and how sure the teacher is that somebody is there.

    ``landmarks_px`` (33, 2) in the image's pixels, ``depths_px`` (33,) less the hips', likewise;
    ``landmarks_mm`` (33, 3) about the hips, on axes of the crop turned upright.
    """

    landmarks_px: NDArray[np.float64]
    landmarks_mm: NDArray[np.float64]
    depths_px: NDArray[np.float64]
    score: float


def circle(
    joints_px: NDArray[np.floating], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Mid-hip (2,) and rim (2,), up along the trunk, of the circle about a person with a trunk.

    Of joints (14, 2) and which of them are known; None where the trunk has no length.
    """
    joints = joints_px.astype(np.float64)
    hips = 0.5 * (joints[R_HIP] + joints[L_HIP])
    trunk = 0.5 * (joints[R_SHOULDER] + joints[L_SHOULDER]) - hips
    length = float(np.linalg.norm(trunk))
    if length < _LEAST_TRUNK_PX:
        return None
    reach = ROOM * np.linalg.norm(joints[known] - hips, axis=1).max()
    return hips, hips + trunk * (reach / length)


def onnx_session(path: Path) -> ort.InferenceSession:
    """A single-threaded session on the CPU."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _anchors() -> NDArray[np.float64]:
    grids = []
    for stride, per_cell in ((8, 2), (16, 2), (32, 6)):
        n = DETECTOR_SIZE // stride
        y, x = np.mgrid[0:n, 0:n]
        centres = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) / n
        grids.append(np.repeat(centres, per_cell, 0))
    return np.concatenate(grids)


def _sigmoid(x: NDArray[np.float32]) -> NDArray[np.float64]:
    return 1 / (1 + np.exp(-np.clip(x.astype(np.float64), -50, 50)))


class BlazePose:
    """Detector and landmark network of one folder (``blazepose_*.onnx``)."""

    def __init__(self, folder: Path, variant: str = "heavy") -> None:
        self._detector = onnx_session(folder / "blazepose_detector.onnx")
        self._landmarks = onnx_session(folder / f"blazepose_{variant}.onnx")
        self._anchors = _anchors()

    def detect(
        self, image: Image, threshold: float
    ) -> list[tuple[NDArray[np.float64], NDArray[np.float64], float]]:
        """(mid-hip (2,), circle point (2,), score) of each person in a BGR image, in its pixels."""
        h, w = image.shape[:2]
        scale = DETECTOR_SIZE / max(h, w)
        matrix = np.array(
            [
                [scale, 0, (DETECTOR_SIZE - w * scale) / 2],
                [0, scale, (DETECTOR_SIZE - h * scale) / 2],
            ]
        )
        square = warped(image, matrix, (DETECTOR_SIZE, DETECTOR_SIZE))
        x = square[None, :, :, ::-1].astype(np.float32) / 127.5 - 1
        outputs = self._detector.run(None, {self._detector.get_inputs()[0].name: x})
        raw = next(o for o in outputs if o.shape[-1] == 12)[0]
        scores = _sigmoid(next(o for o in outputs if o.shape[-1] == 1)[0, :, 0])
        keep = np.flatnonzero(scores > threshold)
        keep = keep[np.argsort(-scores[keep])]
        points = raw[keep, 4:8].reshape(-1, 2, 2) / DETECTOR_SIZE + self._anchors[keep, None]
        points = (points * DETECTOR_SIZE - matrix[:, 2]) / scale
        found: list[tuple[NDArray[np.float64], NDArray[np.float64], float]] = []
        for (hip, rim), score in zip(points, scores[keep], strict=True):
            radius = np.linalg.norm(rim - hip)
            if all(np.linalg.norm(hip - other) > 0.35 * radius for other, _, _ in found):
                found.append((hip, rim, float(score)))
        return found

    def landmarks(
        self, image: Image, hip: NDArray[np.float64], rim: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float]:
        """(33, 2) landmarks in the image's pixels and the presence score."""
        seen = self.person(image, hip, rim)
        return seen.landmarks_px, seen.score

    def person(
        self, image: Image, hip: NDArray[np.float64], rim: NDArray[np.float64]
    ) -> TeacherPose:
        """Landmarks and depths of the person with this mid-hip, within a circle through ``rim``."""
        up = rim - hip
        side = 2 * 1.25 * float(np.linalg.norm(up))
        angle = np.arctan2(up[0], -up[1])
        scale = LANDMARK_SIZE / max(side, 1.0)
        cos, sin = scale * np.cos(angle), scale * np.sin(angle)
        linear = np.array([[cos, sin], [-sin, cos]])
        shift = LANDMARK_SIZE / 2 - linear @ hip
        matrix = np.concatenate([linear, shift[:, None]], 1)
        crop = cv2.warpAffine(image, matrix, (LANDMARK_SIZE, LANDMARK_SIZE))
        x = crop[None, :, :, ::-1].astype(np.float32) / 255
        names = ["Identity", "Identity_1", "Identity_4"]
        points, presence, metres = self._landmarks.run(
            names, {self._landmarks.get_inputs()[0].name: x}
        )
        at = points.reshape(39, 5)[:33, :2].astype(np.float64)
        world = metres.reshape(39, 3)[:33].astype(np.float64)
        # Pixels a metre: what best maps the limbs' metres onto their places in the crop.
        body = list(_BODY)
        here, there = (part[body, :2] - part[body, :2].mean(0) for part in (world, at))
        px_per_metre = (here * there).sum() / max(float((here * here).sum()), 1e-9)
        back: NDArray[np.float64] = (at - shift) @ np.linalg.inv(linear).T
        return TeacherPose(
            landmarks_px=back,
            landmarks_mm=1000 * world,
            depths_px=world[:, 2] * px_per_metre / scale,
            score=float(presence.reshape(-1)[0]),
        )

    def people(
        self, image: Image, threshold: float = 0.5, tiles: bool = True
    ) -> list[TeacherPerson]:
        """Everyone the teacher finds, each once, best first."""
        h, w = image.shape[:2]
        windows = [(0, 0, w, h)]
        if tiles:
            side = int(0.6 * max(h, w))
            xs = sorted({0, (w - side) // 2, w - side}) if w > side else [0]
            ys = sorted({0, h - side}) if h > side else [0]
            windows += [(x, y, min(x + side, w), min(y + side, h)) for x in xs for y in ys]
        people: list[TeacherPerson] = []
        for x0, y0, x1, y1 in windows:
            corner = np.array([x0, y0])
            tile = np.ascontiguousarray(image[y0:y1, x0:x1])
            for hip, rim, score in self.detect(tile, threshold):
                at, presence = self.landmarks(image, hip + corner, rim + corner)
                if presence > 0.5:
                    people.append(TeacherPerson(joint_box(at), at, score * presence))
        people.sort(key=lambda p: -p.score)
        kept: list[TeacherPerson] = []
        for person in people:
            boxes = np.array([k.box_px for k in kept]).reshape(-1, 4)
            if not kept or iou(person.box_px[None], boxes).max() < 0.5:
                kept.append(person)
        return kept


def joint_box(landmarks_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corner box (4,) of the lsp14 joints, the head top extrapolated from ears and shoulders."""
    ears = landmarks_px[list(_EARS)].mean(0)
    shoulders = landmarks_px[list(_SHOULDERS)].mean(0)
    points = np.concatenate([landmarks_px[list(_BODY)], (ears + 0.6 * (ears - shoulders))[None]])
    return np.concatenate([points.min(0), points.max(0)])
