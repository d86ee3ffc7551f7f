"""How tall a 14-joint pose is, for ``subject_height_mm``."""

from __future__ import annotations

import numpy as np

from app.lifting.geometry import Floats
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_HIP,
    L_KNEE,
    NECK,
    R_ANKLE,
    R_HIP,
    R_KNEE,
)

STATURE_PER_SEGMENTS = 1.05
"""Standing height over the segment sum: the ankle's height above the sole is missing from it.

Median ankle height of upright mocap frames over their segment sum is 0.050.
"""


def stature_mm(joints_mm: Floats) -> Floats:
    """Standing height of poses (..., 14, 3) in any posture: (...) mm.

    The sum of the segments head top - neck - hip midpoint - knee - ankle, legs averaged over the
    two sides, times :data:`STATURE_PER_SEGMENTS`.
    """
    hips = 0.5 * (joints_mm[..., R_HIP, :] + joints_mm[..., L_HIP, :])

    def length(a: Floats, b: Floats) -> Floats:
        norm: Floats = np.sqrt(((a - b) ** 2).sum(-1))
        return norm

    def joint(index: int) -> Floats:
        return joints_mm[..., index, :]

    trunk = length(joint(HEAD_TOP), joint(NECK)) + length(joint(NECK), hips)
    right = length(joint(R_HIP), joint(R_KNEE)) + length(joint(R_KNEE), joint(R_ANKLE))
    left = length(joint(L_HIP), joint(L_KNEE)) + length(joint(L_KNEE), joint(L_ANKLE))
    return STATURE_PER_SEGMENTS * (trunk + 0.5 * (right + left))
