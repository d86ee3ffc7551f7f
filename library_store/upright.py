"""Which way up a person is in the picture.

Photos lie on their side, people lie down and turn cartwheels. All that changes a picture of a pose
but for the turn, and an exemplar that stands explains who lies as well. So whoever leans far, in
the photo or in front of a library camera, is turned upright before they are compared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store.skeleton import HEAD_TOP, L_HIP, L_SHOULDER, NECK, R_HIP, R_SHOULDER

Float = NDArray[np.float64]

MOST_LEAN = np.radians(30.0)
"""Who leans more than this is turned. Who leans less stays: how somebody leans tells their pose."""


def lean_rad(points: ArrayLike, present: ArrayLike | None = None) -> Float:
    """By how much people lean in the picture, clockwise from upright.

    Up is the sum of the vectors from each hip to the shoulder of its side, and from between the
    hips to neck and head top, as far as these joints are there.

    Args:
        points: (..., 14, 2), any unit, y down; those that are not present may be anything finite.
        present: (..., 14) bool; None: all.

    Returns:
        (...,) radians, -pi to pi; 0 where there is no such vector.

    """
    at = np.asarray(points, dtype=np.float64)
    there = np.ones(at.shape[:-1], dtype=bool) if present is None else np.asarray(present)
    hips = there[..., R_HIP] & there[..., L_HIP]
    middle = 0.5 * (at[..., R_HIP, :] + at[..., L_HIP, :])
    up = np.zeros((*at.shape[:-2], 2))
    for shoulder, hip in ((R_SHOULDER, R_HIP), (L_SHOULDER, L_HIP)):
        both = there[..., shoulder] & there[..., hip]
        up += both[..., None] * (at[..., shoulder, :] - at[..., hip, :])
    for joint in (NECK, HEAD_TOP):
        up += (hips & there[..., joint])[..., None] * (at[..., joint, :] - middle)
    lean: Float = np.arctan2(up[..., 0], -up[..., 1])
    return np.where((up == 0).all(-1), 0.0, lean)


def turn_rad(points: ArrayLike, present: ArrayLike | None = None) -> Float:
    """How far people must be turned counter-clockwise before they are compared, (...,) radians.

    As much as they lean, if that is more than ``MOST_LEAN``, else 0. Arguments of ``lean_rad``.
    """
    lean = lean_rad(points, present)
    return np.where(np.abs(lean) > MOST_LEAN, lean, 0.0)


def rotations_by(turn: ArrayLike) -> Float:
    """The camera's rolls (..., 3, 3) by which what it sees is turned so far, x right and y down."""
    angle = np.asarray(turn, dtype=np.float64)
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = [cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1.0]
    return np.stack(rows, axis=-1).reshape(*angle.shape, 3, 3)
