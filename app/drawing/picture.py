"""A picture as a list of marks, in the order in which they are drawn; pixels, y down."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]
"""Red, green, blue."""


@dataclass(frozen=True)
class Stroke:
    """A line through (N, 2) points, round at its ends."""

    points: Floats
    colour: Colour
    width: float
    opacity: float = 1.0
    dashed: bool = False


@dataclass(frozen=True)
class Disc:
    """A filled circle around a (2,) centre, with an outline where ``outline`` is given."""

    centre: Floats
    radius: float
    colour: Colour
    outline: Colour | None = None


@dataclass(frozen=True)
class Area:
    """A filled polygon of (N, 2) corners."""

    corners: Floats
    colour: Colour
    opacity: float = 1.0


@dataclass(frozen=True)
class Words:
    """A line of text whose baseline begins at a (2,) point; ``size`` is its height in pixels."""

    text: str
    at: Floats
    colour: Colour
    size: float = 15.0


@dataclass(frozen=True)
class Photograph:
    """(H, W, 3) uint8 BGR pixels, scaled to ``width`` x ``height`` with the corner at ``at``."""

    pixels_bgr: Pixels
    at: Floats
    width: float
    height: float


Mark = Stroke | Disc | Area | Words | Photograph


@dataclass(frozen=True)
class Picture:
    """Marks on a ground of one colour."""

    width: int
    height: int
    ground: Colour
    marks: tuple[Mark, ...] = field(default=())

    def beside(self, other: Picture) -> Picture:
        """Both pictures, of one height, the other one at the right."""
        shift = np.array([self.width, 0.0])
        ground = np.array(
            [[0, 0], [other.width, 0], [other.width, other.height], [0, other.height]]
        )
        moved = [_moved(mark, shift) for mark in (Area(ground, other.ground), *other.marks)]
        return replace(self, width=self.width + other.width, marks=(*self.marks, *moved))


def _moved(mark: Mark, shift: Floats) -> Mark:
    if isinstance(mark, Stroke):
        return replace(mark, points=mark.points + shift)
    if isinstance(mark, Disc):
        return replace(mark, centre=mark.centre + shift)
    if isinstance(mark, Area):
        return replace(mark, corners=mark.corners + shift)
    return replace(mark, at=mark.at + shift)
