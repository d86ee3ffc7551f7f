"""Finding the people in a photo: one pass of the person network over the whole, shrunk photo.

Where nobody is found, a second pass from further away may find somebody who fills the photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from models.card import WEIGHTS_DIR, DetectorOutput, ModelCard
from models.errors import ModelError
from models.providers import ProviderChoice, Runtime
from models.session import OnnxModel

Floats = NDArray[np.float64]
GRID_PX = 32
"""Sides of the network's input are multiples of this: the pyramid halves five times."""
MAX_OVERLAP = 0.5
"""Two boxes that overlap more (IoU) are one person."""
WEAK, SURE, MAX_WITHIN = 0.45, 0.7, 0.25
"""A box of less score than the first adds nobody if more than the last of its own area lies within
one of at least the second: a face before foliage may pass for somebody who lies there. Of held-out
people it costs one in 1,241 (docs/experiments.md)."""

CLOSE_MARGIN, CLOSE_SHARE = 0.17, 0.5
"""The second pass' margin around the photo, of the canvas; the least share of the photo's width or
height that a box must span to count in it."""


@dataclass(frozen=True)
class PersonBox:
    """The box around a person's joints, in the photo's pixels, and how sure we are of it."""

    x_px: float
    y_px: float
    width_px: float
    height_px: float
    score: float


def corners(boxes: Sequence[PersonBox]) -> Floats:
    """(n, 4) x0, y0, x1, y1."""
    rows = [(b.x_px, b.y_px, b.x_px + b.width_px, b.y_px + b.height_px) for b in boxes]
    return np.array(rows, np.float64).reshape(-1, 4)


def _intersection(a: Floats, b: Floats) -> Floats:
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    area: Floats = np.clip(high - low, 0, None).prod(-1)
    return area


def iou(a: Floats, b: Floats) -> Floats:
    """Intersection over union of corner boxes (N, 4) and (M, 4), (N, M)."""
    overlap = _intersection(a, b)
    area_a = (a[:, 2:] - a[:, :2]).prod(-1)
    area_b = (b[:, 2:] - b[:, :2]).prod(-1)
    ratio: Floats = overlap / np.maximum(area_a[:, None] + area_b[None] - overlap, 1e-9)
    return ratio


def decode(
    maps: NDArray[np.float32], stride: float, unit_px: float, threshold: float
) -> tuple[Floats, Floats]:
    """(5, h, w) maps -> corner boxes (n, 4) in input px and scores (n,), best first.

    A person is a local maximum of the centre map; of boxes that overlap by more than MAX_OVERLAP
    the best stays, and a weak one beside a sure one only if it lies elsewhere.
    """
    centre = np.ascontiguousarray(maps[0], np.float32)
    y, x = np.nonzero(centre >= cv2.dilate(centre, np.ones((3, 3), np.uint8)))
    score = 1 / (1 + np.exp(-np.clip(centre[y, x].astype(np.float64), -30, 30)))
    likely = score > threshold
    y, x, score = y[likely], x[likely], score[likely]
    sides = np.exp(np.clip(maps[1:, y, x].astype(np.float64), -4, 4)) * unit_px
    cx, cy = (x + 0.5) * stride - 0.5, (y + 0.5) * stride - 0.5
    boxes = np.stack([cx - sides[0], cy - sides[1], cx + sides[2], cy + sides[3]], 1)
    order = np.argsort(-score, kind="stable")
    boxes, scores = boxes[order], score[order]
    kept: list[int] = []
    for i in range(len(boxes)):
        box = boxes[i : i + 1]
        if iou(box, boxes[kept]).max(initial=0) >= MAX_OVERLAP:
            continue
        sure = [k for k in kept if scores[k] >= SURE]
        within = _intersection(box, boxes[sure]).max(initial=0) / (box[0, 2:] - box[0, :2]).prod()
        if scores[i] >= WEAK or within <= MAX_WITHIN:
            kept.append(i)
    return boxes[kept], scores[kept]


def shrunk(
    image: NDArray[np.uint8], long_side_px: int, margin: float = 0.0
) -> tuple[NDArray[np.uint8], tuple[int, int], int]:
    """The network's view of a photo: shrunk, on a black canvas ``long_side_px`` long.

    Returns the canvas, the photo's (width, height) there, and the pixels left free above it and
    beside it: ``margin`` of the long side.
    """
    height, width = image.shape[:2]
    free = int(margin * long_side_px)
    scale = (long_side_px - 2 * free) / max(height, width)
    small_w, small_h = max(1, round(width * scale)), max(1, round(height * scale))
    # Halving is ten times as fast as other averages over areas; what is left to shrink, less than
    # by half, needs none. An odd last row or column is dropped: less than a pixel of the canvas.
    while min(height / small_h, width / small_w) >= 2:
        height, width = height // 2, width // 2
        even = image[: 2 * height, : 2 * width]
        image = np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA))
    rows, columns = (-(-(side + 2 * free) // GRID_PX) * GRID_PX for side in (small_h, small_w))
    canvas = np.zeros((rows, columns, 3), np.uint8)
    canvas[free : free + small_h, free : free + small_w] = cv2.resize(image, (small_w, small_h))
    return canvas, (small_w, small_h), free


class PersonDetector:
    """The person network with its card. Thread-safe."""

    def __init__(
        self,
        name: str = "person",
        *,
        weights_dir: Path = WEIGHTS_DIR,
        provider: ProviderChoice = "auto",
        concurrency: int = 1,
    ) -> None:
        self._model = OnnxModel(weights_dir, name, provider=provider, concurrency=concurrency)
        output = self._model.card.output
        if not isinstance(output, DetectorOutput):
            raise ModelError(f"model {name} is no person detector: its card says {output.kind}")
        self._output = output

    @property
    def card(self) -> ModelCard:
        """The network's model card."""
        return self._model.card

    @property
    def runtime(self) -> Runtime:
        """The provider in use and the precision it runs the network in."""
        return self._model.runtime

    def warm_up(self) -> None:
        """Run every shape of photo there is: all but the CPU's provider compile each anew."""
        if self.runtime.provider == "cpu":
            return
        long = -(-self._output.long_side_px // GRID_PX) * GRID_PX
        for short in range(GRID_PX, long + 1, GRID_PX):
            for height, width in {(short, long), (long, short)}:
                self._model.warm_up(np.zeros((1, height, width, 3), np.uint8))

    def detect(
        self, image: NDArray[np.uint8], max_people: int, *, threshold: float | None = None
    ) -> list[PersonBox]:
        """People in a photo (H, W, 3) uint8 BGR, most certain first, at most ``max_people``.

        ``threshold`` is the least score, the card's by default.
        """
        return self._found(image, 0.0, threshold)[:max_people]

    def detect_close(self, image: NDArray[np.uint8], max_people: int) -> list[PersonBox]:
        """The same, only people who fill at least half of the photo's width or height.

        For photos in which :meth:`detect` leads to nobody: those who fill the canvas from one edge
        to the other are found from further away, with black around the photo.
        """
        height, width = image.shape[:2]
        return [
            box
            for box in self._found(image, CLOSE_MARGIN, None)
            if max(box.width_px / width, box.height_px / height) >= CLOSE_SHARE
        ][:max_people]

    def _found(
        self, image: NDArray[np.uint8], margin: float, threshold: float | None
    ) -> list[PersonBox]:
        height, width = image.shape[:2]
        canvas, (small_w, small_h), free = shrunk(image, self._output.long_side_px, margin)
        maps = self._model.run(canvas[None])[0]
        least = self._output.threshold if threshold is None else threshold
        boxes, scores = decode(maps, self._output.stride_px, self._output.unit_px, least)
        ratio = np.array([width / small_w, height / small_h] * 2)
        photo = (boxes - free + 0.5) * ratio - 0.5
        limit = np.array([width, height] * 2) - 1.0
        photo = np.clip(photo, 0.0, limit)
        size = photo[:, 2:] - photo[:, :2]
        return [
            PersonBox(
                x_px=float(box[0]),
                y_px=float(box[1]),
                width_px=float(wh[0]),
                height_px=float(wh[1]),
                score=float(score),
            )
            for box, wh, score in zip(photo, size, scores, strict=True)
            if wh.min() > 1
        ]
