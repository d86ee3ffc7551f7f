"""Cutting a labelled person out of a crop, by thick strokes along the bones."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    L_WRIST,
    NECK,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)
from models.crop import warped
from models.training.dataset import Image, LabelledCrop

Mask = NDArray[np.float32]
STROKES = (
    (R_SHOULDER, R_ELBOW, 0.34),
    (R_ELBOW, R_WRIST, 0.3),
    (L_SHOULDER, L_ELBOW, 0.34),
    (L_ELBOW, L_WRIST, 0.3),
    (R_HIP, R_KNEE, 0.46),
    (R_KNEE, R_ANKLE, 0.38),
    (L_HIP, L_KNEE, 0.46),
    (L_KNEE, L_ANKLE, 0.38),
)
"""Two joints and how wide the limb between them is cut, over the trunk's size. Generous: a seam
within the clothes would cost more than a rim of background."""
TRUNK = (R_SHOULDER, L_SHOULDER, L_HIP, R_HIP)


def whole(crop: LabelledCrop) -> bool:
    """Whether all of the limbs' and the trunk's joints are labelled."""
    return bool((crop.weight[NECK + 1 :] > 0).all())


def silhouette(crop: LabelledCrop) -> Mask:
    """Roughly where the person is, (h, w) float32 in 0..1, soft at the edge.

    Takes joints without a label as not there: nothing is cut out around them.
    """
    known = crop.weight > 0
    at = np.rint(crop.joints_px * 16).astype(np.int32)
    mask = np.zeros(crop.image.shape[:2], np.uint8)
    trunk_px = crop.joints_px[list(TRUNK)]
    sizes = [np.linalg.norm(trunk_px[a] - trunk_px[b]) for a, b in ((0, 2), (1, 3))]
    size = max(float(max(sizes)), 0.25 * crop.extent_px[1])
    for a, b, width in STROKES:
        if known[a] and known[b]:
            thick = max(2, round(width * size))
            cv2.line(mask, at[a].tolist(), at[b].tolist(), 255, thick, cv2.LINE_8, 4)
    corners = at[[j for j in TRUNK if known[j]]]
    if len(corners) >= 2:
        cv2.fillPoly(mask, [corners], 255, cv2.LINE_8, 4)
        cv2.polylines(mask, [corners], True, 255, max(2, round(0.34 * size)), cv2.LINE_8, 4)
    if known[HEAD_TOP] and known[NECK]:
        head = np.linalg.norm(crop.joints_px[HEAD_TOP] - crop.joints_px[NECK])
        middle = (0.55 * at[HEAD_TOP] + 0.45 * at[NECK]).astype(np.int32)
        cv2.circle(mask, middle.tolist(), max(2, round(0.55 * head * 16)), 255, -1, cv2.LINE_8, 4)
        cv2.line(mask, at[NECK].tolist(), middle.tolist(), 255, max(2, round(0.4 * head)), 8, 4)
    return (cv2.GaussianBlur(mask, (0, 0), 1.5) / 255).astype(np.float32)


def place(
    image: Image,
    size: tuple[int, int],
    scale: float,
    shift: NDArray[np.float64],
    flip: bool,
    fill: NDArray[np.float64],
) -> tuple[Image, NDArray[np.float32]]:
    """An image on a canvas of ``size`` (w, h), and the (2, 3) affine that put it there."""
    matrix = np.array([[-scale if flip else scale, 0, shift[0]], [0, scale, shift[1]]])
    return warped(image, matrix, size, value=tuple(fill)), matrix.astype(np.float32)


def over(image: Image, front: Image, mask: Mask) -> Image:
    """``front`` laid over ``image`` where ``mask`` (h, w) says so, all of one size."""
    blend = mask[..., None]
    mixed: Image = (image * (1 - blend) + front * blend + 0.5).astype(np.uint8)
    return mixed
