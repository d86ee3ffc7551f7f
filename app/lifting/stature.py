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


_SEGMENTS = np.stack([_difference(*ends) for ends in (*_TRUNK, *_LEGS)])
_SHARES = STATURE_PER_SEGMENTS * np.array([1.0, 1.0, *_HALF])


def stature_mm(joints_mm: Floats) -> Floats:
    """Standing height of poses (..., 14, 3) in any posture: (...) mm.

    The sum of the segments head top - neck - hip midpoint - knee - ankle, legs averaged over the
    two sides, times :data:`STATURE_PER_SEGMENTS`.
    """
    height: Floats = np.sqrt(((_SEGMENTS @ joints_mm) ** 2).sum(-1)) @ _SHARES
    return height


def expected_stature_mm(joints_mm: Floats, covariance_mm2: Floats) -> float:
    """Stature of a pose that is known only so far.

    The mean of many poses has shorter segments than any of them: what it lacks is their spread,
    ``E|s|² = |E s|² + tr Cov s``.

    Args:
        joints_mm: (14, 3) the mean pose.
        covariance_mm2: (3, 14, 14) between joints, along each axis.

    """
    spread = ((_SEGMENTS @ covariance_mm2) * _SEGMENTS).sum(-1).sum(0)
    squared = ((_SEGMENTS @ joints_mm) ** 2).sum(-1) + np.maximum(spread, 0.0)
    return float(np.sqrt(squared) @ _SHARES)
