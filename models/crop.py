"""Cutting a square out of a photo, scaling it to a network's input: without aliasing."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def square_crop(
    image: NDArray[np.uint8],
    center_px: tuple[float, float],
    side_px: float,
    size: int,
    border_grey: int = 0,
) -> tuple[NDArray[np.uint8], float, tuple[float, float]]:
    """Square of ``side_px`` around ``center_px`` as (size, size, 3); grey beyond the photo.

    Returns the crop, its pixels' size in the photo's pixels (``scale``) and the photo position of
    its pixel (0, 0) (``origin``): photo = origin + scale * crop, integers being pixel centres.
    """
    scale = side_px / size
    origin = (
        center_px[0] - (size - 1) / 2 * scale,
        center_px[1] - (size - 1) / 2 * scale,
    )
    height, width = image.shape[:2]
    source, shrink, left, top = image, 1, 0, 0
    if scale >= 2:
        # A plain warp would skip pixels: average whole blocks first, over the square alone.
        shrink = int(scale)
        left = max(0, int(origin[0] - scale))
        top = max(0, int(origin[1] - scale))
        right = min(width, int(origin[0] + side_px + scale) + 1)
        bottom = min(height, int(origin[1] + side_px + scale) + 1)
        if right - left >= shrink and bottom - top >= shrink:
            source = _block_means(image[top:bottom, left:right], shrink)
        else:
            shrink, left, top = 1, 0, 0
    # Block b averages photo pixels whose centre is left + (b + 0.5) * shrink - 0.5.
    step = scale / shrink
    matrix = np.array(
        [
            [step, 0, (origin[0] - left + 0.5) / shrink - 0.5],
            [0, step, (origin[1] - top + 0.5) / shrink - 0.5],
        ]
    )
    crop = cv2.warpAffine(
        source,
        matrix,
        (size, size),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderValue=(border_grey,) * 3,
    )
    return np.asarray(crop, np.uint8), scale, origin


def warped(
    image: NDArray[Any],
    matrix: NDArray[np.floating],
    size: tuple[int, int],
    *,
    border: int = cv2.BORDER_CONSTANT,
    value: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> NDArray[Any]:
    """``image`` (H, W, ...) after an affine map (2, 3) of its pixels, on a canvas ``size`` (w, h).

    What shrinks to less than half is averaged over whole blocks first; cv2.warpAffine alone skips
    pixels, whatever interpolation it is asked for.
    """
    height, width = image.shape[:2]
    linear, shift = matrix[:, :2].astype(np.float64), matrix[:, 2].astype(np.float64)
    shrink = min(int(1 / max(float(np.sqrt(abs(np.linalg.det(linear)))), 1e-6)), height, width)
    if shrink >= 2:
        image = _block_means(image, shrink)
        # Block b averages pixels whose centre is (b + 0.5) * shrink - 0.5.
        shift = shift + linear.sum(1) * (shrink - 1) / 2
        linear = linear * shrink
    placed = np.concatenate([linear, shift[:, None]], axis=1)
    return cv2.warpAffine(image, placed, size, borderMode=border, borderValue=value)


def _block_means(image: NDArray[Any], side: int) -> NDArray[Any]:
    """Means of whole blocks of ``side`` by ``side`` pixels; what is left at the end is left out."""
    rows, columns = image.shape[0] // side, image.shape[1] // side
    window = image[: rows * side, : columns * side]
    return cv2.resize(window, (columns, rows), interpolation=cv2.INTER_AREA)
