"""Which way up a person is in the picture.

Photos lie on their side, people lie down and turn cartwheels. All that changes a picture of a pose
but for the turn, and an exemplar that stands explains who lies as well. So whoever leans far, in
the photo or in front of a library camera, is turned upright before they are compared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store.skeleton import HEAD_TOP, L_HIP, L_SHOULDER, LSP14, NECK, R_HIP, R_SHOULDER

Float = NDArray[np.float64]

MOST_LEAN = np.radians(30.0)
"""Who leans more than this is turned. Who leans less stays: how somebody leans tells their pose."""


def _upwards() -> Float:
    """Vectors that point up in somebody upright, (4, 14): a joint's share in each."""
    vectors = np.zeros((4, LSP14.n_joints))
    vectors[[0, 1], [R_SHOULDER, L_SHOULDER]] = 1.0
    vectors[[0, 1], [R_HIP, L_HIP]] = -1.0
    vectors[[2, 3], [NECK, HEAD_TOP]] = 1.0
    vectors[2:, [R_HIP, L_HIP]] = -0.5
    return vectors


_UPWARDS = _upwards()
_NEEDED = (_UPWARDS != 0).astype(np.float64)


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
    if present is None:
        shares = _UPWARDS.sum(0)
    else:
        shares = (np.asarray(present) @ _NEEDED.T == _NEEDED.sum(1)) @ _UPWARDS
    up = np.einsum("...j,...jc->...c", shares, at)
    lean: Float = np.arctan2(up[..., 0], 0.0 - up[..., 1])
    return lean


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
