"""People whom the photo's edge cuts off, for the pose network.

The crop that the service makes of them holds what the photo shows, at a larger scale than that of
whole people, and black beyond the edge; or, where little is believed in that, the whole person's
place, most of it black (``models/truncation.py``). The network meets both here. What ends a person
may also be a table or a wall: then there is something else than black.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from library_store.skeleton import LSP14
from library_store.upright import MOST_LEAN, lean_rad
from models.training.dataset import Image, LabelledCrop

LEAST_JOINTS = 4
"""Of whom less can be seen nobody can say whether they are to be found."""
FEWEST, MOST = 5, 12
"""Joints that the photo is left with."""
BELOW = 0.75
"""Of people who are upright, how many the lower edge cuts off; the others any of the other three,
and those who are not any of the four."""
AS_SEEN = 0.6
"""Of the views, those at the scale of what is seen."""
SMALLEST_GROWTH, LARGEST_GROWTH = 1.3, 2.4
"""How much longer than that the others are."""
FURNISHED = 0.35
"""Of the views, those where something else stands before what is gone."""
GUESSED = 0.3
"""Trust in places beyond the edge, of that in the label."""
Floats = NDArray[np.float64]

_EDGES = np.array(LSP14.edges)
_ALONG = np.linspace(0.0, 1.0, 33)[:, None, None]


@dataclass(frozen=True)
class Shortened:
    """A person whose picture ends too early.

    ``crop`` is black, or another picture, beyond the edge; ``center_px`` (2,) and ``extent_px`` are
    of what a view is to show, ``beyond`` (14,) says which joints cannot be seen for the edge.
    """

    crop: LabelledCrop
    center_px: NDArray[np.float32]
    extent_px: float
    beyond: NDArray[np.bool_]


def seen_box(joints_px: Floats, known: NDArray[np.bool_], photo: Floats) -> Floats | None:
    """The corner box (4,) about what ``photo`` (x0, y0, x1, y1) shows of the known bones.

    ``joints_px`` (14, 2); None of whom fewer than ``LEAST_JOINTS`` joints are in it.
    """
    inside = ((joints_px >= photo[:2]) & (joints_px <= photo[2:])).all(1) & known
    if inside.sum() < LEAST_JOINTS:
        return None
    bones = _EDGES[known[_EDGES].all(1)]
    start, end = joints_px[bones[:, 0]], joints_px[bones[:, 1]]
    points = np.concatenate([(start + _ALONG * (end - start)).reshape(-1, 2), joints_px[inside]])
    shown = points[((points >= photo[:2]) & (points <= photo[2:])).all(1)]
    return np.concatenate([shown.min(0), shown.max(0)])


def piece_of(picture: Image, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """A random part of a picture, at its own proportions, as width x height pixels."""
    height, width = picture.shape[:2]
    scale = min(width / size[0], height / size[1], float(rng.uniform(0.5, 2.0)))
    w, h = (max(1, int(scale * side)) for side in size)
    x, y = int(rng.integers(width - w + 1)), int(rng.integers(height - h + 1))
    piece: Image = cv2.resize(picture[y : y + h, x : x + w], size, interpolation=cv2.INTER_LINEAR)
    return piece


def shortened(crop: LabelledCrop, other: Image, rng: np.random.Generator) -> Shortened | None:
    """``crop`` cut off by a random edge; None of whom too little is known to be cut.

    ``other`` (h, w, 3) uint8 lends what may stand before the rest.
    """
    known = crop.weight > 0
    height, width = crop.image.shape[:2]
    joints = crop.joints_px.astype(np.float64)
    within = known & ((joints >= 0) & (joints <= (width - 1, height - 1))).all(1)
    upright = crop.has_torso and abs(lean_rad(joints)) < MOST_LEAN
    # (axis, whether what lies further along it is cut off): lower, upper, right and left edge.
    edges = ((1, True), (1, False), (0, True), (0, False))
    others = (1 - BELOW) / 3
    axis, further = edges[rng.choice(4, p=(BELOW, others, others, others) if upright else None)]
    along = np.sort(joints[within, axis] * (1 if further else -1))
    if len(along) <= FEWEST:
        return None
    left = int(rng.integers(FEWEST, min(MOST, len(along) - 1) + 1))
    end = float(rng.uniform(along[left - 1], along[left])) * (1 if further else -1)
    row = int(np.clip(round(end), 1, (height, width)[axis] - 1))
    photo = np.array([0.0, 0.0, width - 1.0, height - 1.0])
    photo[axis + 2 if further else axis] = row - 1 if further else row
    box = seen_box(joints, known, photo)
    if box is None:
        return None
    image = crop.image.copy()
    gone = slice(row, None) if further else slice(0, row)
    rest = image[gone if axis == 1 else (slice(None), gone)]  # a view
    rest[:] = piece_of(other, rest.shape[1::-1], rng) if rng.random() < FURNISHED else 0
    outside = (joints < photo[:2] - 0.5) | (joints > photo[2:] + 0.5)
    beyond: NDArray[np.bool_] = np.any(outside, axis=1)
    if rng.random() >= AS_SEEN:
        growth = np.exp(rng.uniform(np.log(SMALLEST_GROWTH), np.log(LARGEST_GROWTH)))
        more = (growth - 1) * (box[axis + 2] - box[axis])
        box[axis + 2 if further else axis] += more if further else -more
    return Shortened(
        replace(
            crop,
            image=image,
            weight=np.where(beyond, GUESSED * crop.weight, crop.weight).astype(np.float32),
            visible=np.where(beyond, 0, crop.visible).astype(np.float32),
        ),
        ((box[:2] + box[2:]) / 2).astype(np.float32),
        float((box[2:] - box[:2]).max()),
        beyond,
    )
