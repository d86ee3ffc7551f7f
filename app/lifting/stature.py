"""How tall a 14-joint pose is: for ``subject_height_mm``, and for the size of an answer."""

from __future__ import annotations

import numpy as np

from app.lifting.geometry import Floats
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_HIP,
    L_KNEE,
    LSP14,
    NECK,
    R_ANKLE,
    R_HIP,
    R_KNEE,
)

STATURE_PER_SEGMENTS = 1.05
"""Standing height over the segment sum: the ankle's height above the sole is missing from it.

Median ankle height of upright mocap frames over their segment sum is 0.050.
"""


_TRUNK = ((HEAD_TOP, NECK), (NECK, None))
_LEGS = ((R_KNEE, R_HIP), (R_ANKLE, R_KNEE), (L_KNEE, L_HIP), (L_ANKLE, L_KNEE))
_HALF = (0.5,) * len(_LEGS)


def _difference(end: int, start: int | None) -> Floats:
    """(J,) what takes joints to a segment; a segment without a start begins between the hips."""
    joints = np.eye(LSP14.n_joints)
    origin = 0.5 * (joints[R_HIP] + joints[L_HIP]) if start is None else joints[start]
    row: Floats = joints[end] - origin
    return row


STATURE_SEGMENTS = np.stack([_difference(*ends) for ends in (*_TRUNK, *_LEGS)])
"""(6, J): times joints, the segments that the standing height is the sum of."""
STATURE_SHARES = STATURE_PER_SEGMENTS * np.array([1.0, 1.0, *_HALF])
"""(6,): what the length of each adds to it."""


def stature_mm(joints_mm: Floats) -> Floats:
    """Standing height of poses (..., 14, 3) in any posture: (...) mm.

    The sum of the segments head top - neck - hip midpoint - knee - ankle, legs averaged over the
    two sides, times :data:`STATURE_PER_SEGMENTS`.
    """
    height: Floats = np.sqrt(((STATURE_SEGMENTS @ joints_mm) ** 2).sum(-1)) @ STATURE_SHARES
    return height
