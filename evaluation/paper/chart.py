"""Line charts over library size, as in figures 7 and 8, drawn with the product's own pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from app.drawing.picture import Colour, Disc, Mark, Picture, Stroke, Words

WIDTH, HEIGHT = 760, 440
_LEFT, _RIGHT, _TOP, _BOTTOM = 60.0, 150.0, 40.0, 50.0
_INK: Colour = (30, 28, 25)
_SOFT: Colour = (110, 104, 95)
_GRID: Colour = (226, 222, 214)
_COLOURS: tuple[Colour, ...] = (
    *((200, 70, 20), (230, 140, 60), (25, 100, 200), (110, 165, 230)),
    *((30, 130, 80), (120, 190, 140), (130, 60, 150), (190, 140, 205)),
    *((120, 115, 105), (175, 168, 155)),
)


def chart(title: str, sizes: Sequence[int], lines: Mapping[str, Sequence[float]]) -> Picture:
    """Errors in mm (from 0 up) over sizes (logarithmic), a line of each name, labelled at its end.

    Dashed lines are those whose name ends in ``|x``.
    """
    top = 10.0 * np.ceil(max(max(values) for values in lines.values()) / 10.0)
    low, high = np.log10(sizes[0]), np.log10(max(sizes[-1], 1.001 * sizes[0]))

    def at(size: float, error: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        x = _LEFT + (np.log10(size) - low) / (high - low) * (WIDTH - _LEFT - _RIGHT)
        return np.array([x, HEIGHT - _BOTTOM - error / top * (HEIGHT - _TOP - _BOTTOM)])

    marks: list[Mark] = [Words(f"{title}, mm", np.array([_LEFT, 24.0]), _INK, 16)]
    for error in np.arange(0.0, top + 1.0, 20.0):
        marks.append(Stroke(np.stack([at(sizes[0], error), at(sizes[-1], error)]), _GRID, 1))
        marks.append(Words(f"{error:.0f}", at(sizes[0], error) - np.array([34.0, -4.0]), _SOFT, 12))
    for size in sizes:
        marks.append(Stroke(np.stack([at(size, 0), at(size, top)]), _GRID, 1))
        marks.append(Words(_short(size), at(size, 0) - np.array([12.0, -18.0]), _SOFT, 12))
    marks.append(Words("exemplars", np.array([_LEFT, HEIGHT - 12.0]), _SOFT, 12))
    heights = _apart([at(sizes[-1], values[-1])[1] for values in lines.values()], 16.0)
    for (name, values), y, colour in zip(lines.items(), heights, _cycle(len(lines)), strict=True):
        points = np.stack([at(size, value) for size, value in zip(sizes, values, strict=True)])
        marks.append(Stroke(points, colour, 2, dashed=name.endswith("|x")))
        marks += [Disc(point, 3, colour) for point in points]
        end = np.array([points[-1, 0] + 10, y + 4])
        marks.append(Words(f"{name} {values[-1]:.0f}", end, colour, 13))
    return Picture(WIDTH, HEIGHT, (255, 255, 255), tuple(marks))


def _short(size: int) -> str:
    return f"{size / 1e6:g}M" if size >= 1e6 else f"{size / 1e3:.3g}k" if size >= 1e3 else str(size)


def _apart(heights: Sequence[float], gap: float) -> list[float]:
    """The heights moved so that labels do not overlap, in the same order."""
    order = np.argsort(heights)
    moved = np.array(heights, dtype=np.float64)
    for before, after in pairwise(order):
        moved[after] = max(moved[after], moved[before] + gap)
    over = max(0.0, float(moved.max()) - (HEIGHT - _BOTTOM))
    for after, before in pairwise(order[::-1]):
        if over:
            moved[after] = min(moved[after], HEIGHT - _BOTTOM)
            moved[before] = min(moved[before], moved[after] - gap)
    return [float(height) for height in moved]


def _cycle(n: int) -> list[Colour]:
    return [_COLOURS[i % len(_COLOURS)] for i in range(n)]
