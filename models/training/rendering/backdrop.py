"""What is behind a rendered person: patches of photos, walls and floors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from models.training.rendering.body import Floats

Image = NDArray[np.uint8]

TRIES = 8
"""Patches looked at before the one with the fewest people is taken."""


@dataclass(frozen=True)
class Backgrounds:
    """Photos to cut from; ``people[i]`` (n, 4) boxes (x0, y0, x1, y1) to avoid in photo i."""

    photos: list[Image]
    people: list[Floats]

    def photo(self, rng: np.random.Generator) -> Image:
        """Any photo."""
        return self.photos[rng.integers(len(self.photos))]

    def square(self, rng: np.random.Generator, share: tuple[float, float]) -> Image:
        """A square whose side is this share of a photo's shorter side, with few people in it."""
        best, least = None, np.inf
        for _ in range(TRIES):
            k = int(rng.integers(len(self.photos)))
            photo, boxes = self.photos[k], self.people[k]
            h, w = photo.shape[:2]
            side = max(int(rng.uniform(*share) * min(h, w)), 8)
            y, x = (int(rng.integers(0, n - side + 1)) for n in (h, w))
            low = np.maximum(boxes[:, :2], (x, y))
            high = np.minimum(boxes[:, 2:], (x + side, y + side))
            covered = float(np.clip(high - low, 0, None).prod(1).sum()) / side**2
            if covered < least:
                best, least = photo[y : y + side, x : x + side], covered
            if covered < 0.02:
                break
        assert best is not None
        return best


def patch(
    rng: np.random.Generator, backgrounds: Backgrounds, size: int, share: tuple[float, float]
) -> Floats:
    """A piece of a photo, enlarged to (size, size, 3), 0..1."""
    square = cv2.resize(backgrounds.square(rng, share), (size, size)).astype(np.float32)
    if rng.random() < 0.5:
        square = square[:, ::-1]
    result: Floats = square / np.float32(255)
    return result


def backdrop(rng: np.random.Generator, backgrounds: Backgrounds, size: int) -> Floats:
    """A photo's patch, blurred or not, or a wall over a floor, (size, size, 3) 0..1."""
    if rng.random() < 0.7:
        canvas = patch(rng, backgrounds, size, (0.25, 0.95))
        if rng.random() < 0.35:
            canvas = cv2.GaussianBlur(canvas, (0, 0), rng.uniform(0.7, 4)).astype(np.float32)
        if rng.random() < 0.05:
            canvas = np.flipud(canvas).copy()
    else:
        canvas = np.empty((size, size, 3), np.float32)
        horizon = int(np.clip(rng.normal(0.6, 0.2), 0.1, 1.1) * size)
        for rows in (slice(0, horizon), slice(horizon, size)):
            textured = rng.random() < 0.45
            area = patch(rng, backgrounds, size, (0.08, 0.25)) if textured else _plain(rng, size)
            canvas[rows] = area[rows]
    return np.ascontiguousarray(np.clip(canvas, 0, 1), dtype=np.float32)


def _plain(rng: np.random.Generator, size: int) -> Floats:
    """A painted surface: one colour, a gradient, some grain."""
    ramp = np.linspace(-1, 1, size, dtype=np.float32)
    color = np.clip(rng.uniform(0.15, 0.95) + rng.normal(0, 0.08, 3), 0.02, 1)
    slope = rng.normal(0, 0.1, 2)
    area = color * (1 + slope[0] * ramp[:, None, None] + slope[1] * ramp[:, None])
    cells = max(int(size / rng.uniform(1.5, 12)), 2)
    coarse = rng.normal(0, rng.uniform(0, 0.03), (cells, cells)).astype(np.float32)
    grain = cv2.resize(coarse, (size, size)).astype(np.float32, copy=False)
    result: Floats = (area + grain[:, :, None]).astype(np.float32)
    return result
