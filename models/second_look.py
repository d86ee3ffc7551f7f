"""A second look at each crop, mirrored and turned until the trunk stands upright.

Networks confuse left and right, and more so on people who bend, lie or fall. The first look tells
which way up the trunk is; the second sees the person upright and in the mirror, where the same
mistake is seldom made again. Both looks' logits are averaged, in the first one's frame. Who is seen
clearly at once is not looked at again.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import L_HIP, L_SHOULDER, LSP14, R_HIP, R_SHOULDER

Floats = NDArray[np.float64]
Maps = NDArray[np.float32]
Images = NDArray[np.uint8]
"""(N, S, S, 3) uint8 BGR."""

MIRROR = (*LSP14.mirror, LSP14.n_joints)
"""Maps of the mirrored person, the background's last."""
SURE = 0.55
"""Mean belief at the joints' strongest cells from which the first look is enough: so it is for a
quarter of everyday photos, whose second looks would change nothing that could be measured."""
MOST_CHANNELS = 4
"""OpenCV warps that many at once with a constant border."""


def leans(maps: Maps) -> Floats:
    """Angle (N,) rad, clockwise as seen, by which each trunk leans, from (N, 15, h, w) maps."""
    width = maps.shape[-1]
    trunk = maps[:, (R_SHOULDER, L_SHOULDER, R_HIP, L_HIP)]
    best = trunk.reshape(*trunk.shape[:2], -1).argmax(-1)
    cells = np.stack([best % width, best // width], -1).astype(np.float64)
    right, down = np.moveaxis(cells[:, :2].mean(1) - cells[:, 2:].mean(1), -1, 0)
    angle: Floats = np.arctan2(right, -down)
    return angle


def mirrored_upright(lean_rad: float, size: int) -> Floats:
    """(2, 3) affine from a square to its mirrored, upright view, about the middle of ``size``."""
    cos, sin = np.cos(lean_rad), np.sin(lean_rad)
    linear = np.array([[-cos, -sin], [-sin, cos]])
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


def sure(maps: Maps) -> NDArray[np.bool_]:
    """Of which crops (N,) the logits (N, 15, h, w) believe in all that they show."""
    strongest = maps[:, : LSP14.n_joints].reshape(len(maps), LSP14.n_joints, -1).max(-1)
    clear: NDArray[np.bool_] = (1 / (1 + np.exp(-strongest))).mean(1) >= SURE
    return clear


def looked_at(run: Callable[[Images], Maps], images: Images, looks: int) -> Maps:
    """Logits (N, 15, h, w) of crops (N, S, S, 3) by the network ``run``, after up to two looks.

    Cells that the second look does not see keep the first one's values.
    """
    maps = run(images)
    again = np.flatnonzero(~sure(maps)) if looks > 1 else np.empty(0, np.int64)
    if not len(again):
        return maps
    size, cells = images.shape[1], maps.shape[-1]
    lean = leans(maps[again])
    turned = [
        cv2.warpAffine(image, mirrored_upright(angle, size), (size, size))
        for image, angle in zip(images[again], lean, strict=True)
    ]
    second = run(np.asarray(turned, np.uint8))[:, MIRROR]
    there = np.stack(
        [
            _warped(planes, mirrored_upright(angle, cells))
            for planes, angle in zip(second, lean, strict=True)
        ]
    )
    both = maps.copy()
    both[again] = np.where(np.isnan(there), maps[again], (maps[again] + there) / 2)
    return both
