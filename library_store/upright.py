"""Which way up a person is in the picture.

Photos lie on their side, people lie down and turn cartwheels. All that changes a picture of a pose
but for the turn, and an exemplar that stands explains who lies as well. So whoever leans far, in
the photo or in front of a library camera, is turned upright before they are compared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    LSP14,
    NECK,
    R_ANKLE,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
)

Float = NDArray[np.float64]

MOST_LEAN = np.radians(30.0)
"""Who leans more than this is turned. Who leans less stays: how somebody leans tells their pose."""
MOST_LEAN_OF_HALF = np.radians(45.0)
"""The same of people of whom trunk and hips are not both seen: head and legs tell it less well."""


def _upwards() -> Float:
    """Vectors that point up in somebody upright, (4, 14): a joint's share in each."""
    vectors = np.zeros((4, LSP14.n_joints))
    vectors[[0, 1], [R_SHOULDER, L_SHOULDER]] = 1.0
    vectors[[0, 1], [R_HIP, L_HIP]] = -1.0
    vectors[[2, 3], [NECK, HEAD_TOP]] = 1.0
    vectors[2:, [R_HIP, L_HIP]] = -0.5
    return vectors


def _stand_ins() -> Float:
    """The same of people cut off at the waist, (3, 14): the head's, the thighs' and the legs'."""
    vectors = np.zeros((3, LSP14.n_joints))
    vectors[0, [HEAD_TOP, NECK]] = 1.0
    vectors[0, [R_SHOULDER, L_SHOULDER]] = -1.0
    vectors[1:, [R_HIP, L_HIP]] = 0.5
    vectors[1, [R_KNEE, L_KNEE]] = vectors[2, [R_ANKLE, L_ANKLE]] = -0.5
    return vectors


_UPWARDS, _STAND_INS = _upwards(), _stand_ins()


def _shares(vectors: Float, present: ArrayLike) -> Float:
    """Each joint's share (..., 14) in the sum of those ``vectors`` whose joints are all there."""
    needed = (vectors != 0).astype(np.float64)
    shares: Float = (np.asarray(present) @ needed.T == needed.sum(1)) @ vectors
    return shares


def lean_rad(points: ArrayLike, present: ArrayLike | None = None) -> Float:
    """By how much people lean in the picture, clockwise from upright.

    Up is the sum of the vectors from each hip to the shoulder of its side, and from between the
    hips to neck and head top, as far as these joints are there. Where none is, it is that of the
    vectors from the shoulders to neck and head top, if all are there, and from knees and ankles to
    the hips.

    Args:
        points: (..., 14, 2), any unit, y down; those that are not present may be anything finite.
        present: (..., 14) bool; None: all.

    Returns:
        (...,) radians, -pi to pi; 0 where there is no such vector.

    """
    return _lean_and_most(points, present)[0]


def turn_rad(points: ArrayLike, present: ArrayLike | None = None) -> Float:
    """How far people must be turned counter-clockwise before they are compared, (...,) radians.

    As much as they lean, if that is more than ``MOST_LEAN``, or ``MOST_LEAN_OF_HALF`` of people who
    are cut off at the waist, else 0. Arguments of ``lean_rad``.
    """
    lean, most = _lean_and_most(points, present)
    turn: Float = np.where(np.abs(lean) > most, lean, 0.0)
    return turn


def _lean_and_most(points: ArrayLike, present: ArrayLike | None) -> tuple[Float, Float]:
    """The lean of each person (...,), and how much of it is let be, (...,)."""
    at = np.asarray(points, dtype=np.float64)
    shares = _UPWARDS.sum(0) if present is None else _shares(_UPWARDS, present)
    whole: NDArray[np.bool_] = np.any(shares, axis=-1)
    if present is not None and not whole.all():
        shares = np.where(whole[..., None], shares, _shares(_STAND_INS, present))
    up = np.einsum("...j,...jc->...c", shares, at)
    lean: Float = np.arctan2(up[..., 0], 0.0 - up[..., 1])
    most: Float = np.array([MOST_LEAN_OF_HALF, MOST_LEAN])[whole.astype(np.int64)]
    return lean, most


def rotations_by(turn: ArrayLike) -> Float:
    """The camera's rolls (..., 3, 3) by which what it sees is turned so far, x right and y down."""
    angle = np.asarray(turn, dtype=np.float64)
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = [cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1.0]
    return np.stack(rows, axis=-1).reshape(*angle.shape, 3, 3)
