"""Further looks at a crop: mirrored, then from further away, the trunk upright in both.

Networks confuse left and right, and more so on people who bend, lie or fall. The first look tells
which way up the trunk is; the others see the person upright, in the mirror and smaller, where the
same mistake is seldom made again. The looks' logits are averaged, in the first one's frame, and so
are the depths of joints if the network reads any. Who is seen clearly by now is not looked at
again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, L_SHOULDER, LSP14, R_HIP, R_SHOULDER

Floats = NDArray[np.float64]
Maps = NDArray[np.float32]
Images = NDArray[np.uint8]
"""(N, S, S, 3) uint8 BGR."""


@dataclass(frozen=True)
class Look:
    """A look after the first, its view turned until the trunk stands upright.

    ``zoom`` is the size of things in it, 1 as in the crop; it is taken at crops whose joints'
    strongest cells are believed less than ``below`` on average (see ``belief``): at ``share`` of
    the people in everyday photos, with the shipped weights.
    """

    mirrored: bool
    zoom: float
    below: float
    share: float


@dataclass(frozen=True)
class Seen:
    """What a pose network makes of N crops.

    ``maps`` (N, 15, h, w) of the joints, the background's last; ``depths`` (N, 14) of the joints
    less the hip midpoint's, over the crop's side, or None where the network reads none.
    """

    maps: Maps
    depths: Maps | None = None


FURTHER = (
    Look(mirrored=True, zoom=1.0, below=0.46, share=0.41),
    Look(mirrored=False, zoom=0.5**0.5, below=0.19, share=0.06),
)
"""Who is spared a look would gain next to nothing by it (docs/experiments.md). The third sees the
corners of a turned crop too."""
MIRROR = (*LSP14.mirror, LSP14.n_joints)
"""Maps of the mirrored person, the background's last."""
MOST_CHANNELS = 4
"""OpenCV warps that many at once with a constant border."""


def leans(maps: Maps) -> Floats:
    """Angle (N,) rad, clockwise as seen, by which each trunk leans, from (N, 15, h, w) maps.

    0 where shoulders and hips are at one place: seen along the trunk.
    """
    width = maps.shape[-1]
    trunk = maps[:, (R_SHOULDER, L_SHOULDER, R_HIP, L_HIP)]
    best = trunk.reshape(*trunk.shape[:2], -1).argmax(-1)
    cells = np.stack([best % width, best // width], -1).astype(np.float64)
    right, down = np.moveaxis(cells[:, :2].mean(1) - cells[:, 2:].mean(1), -1, 0)
    angle: Floats = np.arctan2(right, 0.0 - down)  # not -down: of -0.0 the angle is half a turn
    return angle


def upright(look: Look, lean_rad: float, size: int) -> Floats:
    """(2, 3) affine from a square to ``look``'s view of it, about the middle of ``size``."""
    cos, sin = look.zoom * np.cos(lean_rad), look.zoom * np.sin(lean_rad)
    linear = np.array([[cos, sin], [-sin, cos]])
    if look.mirrored:
        linear[0] *= -1
    middle = np.full(2, (size - 1) / 2)
    return np.concatenate([linear, (middle - linear @ middle)[:, None]], 1)


def _warped(planes: Maps, matrix: Floats) -> Maps:
    """(C, h, w) maps, each cell from where ``matrix`` sends it; nan from beyond the border."""
    height, width = planes.shape[1:]
    parts = [
        cv2.warpAffine(
            np.ascontiguousarray(planes[start : start + MOST_CHANNELS].transpose(1, 2, 0)),
            matrix,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(np.nan,) * MOST_CHANNELS,
        ).reshape(height, width, -1)
        for start in range(0, len(planes), MOST_CHANNELS)
    ]
    return np.asarray(np.concatenate(parts, -1).transpose(2, 0, 1), np.float32)


def belief(maps: Maps) -> NDArray[np.float32]:
    """How far logits (N, 15, h, w) believe in all joints: mean over their strongest cells (N,)."""
    strongest = maps[:, : LSP14.n_joints].reshape(len(maps), LSP14.n_joints, -1).max(-1)
    mean: NDArray[np.float32] = (1 / (1 + np.exp(-np.clip(strongest, -30, 30)))).mean(1)
    return mean


def usual(looks: int) -> float:
    """How often the network runs for a person of an everyday photo, of at most ``looks``."""
    return 1 + sum(look.share for look in FURTHER[: looks - 1])


def looked_at(
    see: Callable[[Images], Seen], images: Images, looks: int, first: Seen | None = None
) -> Seen:
    """What the network ``see`` makes of crops (N, S, S, 3) in up to ``looks``: logits, depths.

    ``first``: what it made of them already. Cells that a further look does not see keep what the
    earlier ones say. What a look shows smaller is shallower in it too.
    """
    first = see(images) if first is None else first
    maps, depths = first.maps, first.depths
    size, cells = images.shape[1], maps.shape[-1]
    for before, look in enumerate(FURTHER[: looks - 1], 1):
        again = np.flatnonzero(belief(maps) < look.below)
        if not len(again):
            break
        lean = leans(maps[again])
        turned = [
            cv2.warpAffine(image, upright(look, angle, size), (size, size))
            for image, angle in zip(images[again], lean, strict=True)
        ]
        seen = see(np.asarray(turned, np.uint8))
        seen_maps = seen.maps[:, MIRROR] if look.mirrored else seen.maps
        there = np.stack(
            [
                _warped(planes, upright(look, angle, cells))
                for planes, angle in zip(seen_maps, lean, strict=True)
            ]
        )
        mean = (before * maps[again] + there) / (before + 1)
        maps = maps.copy()
        maps[again] = np.where(np.isnan(there), maps[again], mean)
        if depths is not None and seen.depths is not None:
            deep = seen.depths[:, LSP14.mirror] if look.mirrored else seen.depths
            depths = depths.copy()
            depths[again] = (before * depths[again] + deep / look.zoom) / (before + 1)
    return Seen(maps, depths)
