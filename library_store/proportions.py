"""Limb proportions of poses: changing them bone by bone, and drawing those of other people."""

from __future__ import annotations

import numpy as np

from library_store.anatomy import LENGTHS, Float
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

ROOT = -1
BONES = tuple(
    (LENGTHS.index(name), parent, child)
    for name, parent, child in (
        ("trunk", ROOT, NECK),
        ("hips", ROOT, R_HIP),
        ("hips", ROOT, L_HIP),
        ("head", NECK, HEAD_TOP),
        ("shoulder", NECK, R_SHOULDER),
        ("shoulder", NECK, L_SHOULDER),
        ("upper_arm", R_SHOULDER, R_ELBOW),
        ("upper_arm", L_SHOULDER, L_ELBOW),
        ("forearm", R_ELBOW, R_WRIST),
        ("forearm", L_ELBOW, L_WRIST),
        ("thigh", R_HIP, R_KNEE),
        ("thigh", L_HIP, L_KNEE),
        ("shank", R_KNEE, R_ANKLE),
        ("shank", L_KNEE, L_ANKLE),
    )
)
"""The segments as (length in ``anatomy.LENGTHS``, parent joint, child joint), parents first; the
parent of those that start at the origin is ROOT."""


def resize(poses: Float, factors: Float) -> Float:
    """Poses (n, 14, 3) with every bone scaled by the factor (n, 8) of its length.

    The poses are root-centred and so is the result; directions of bones stay. Factors are in the
    order of ``anatomy.LENGTHS``.
    """
    resized = np.zeros_like(poses)
    for length, parent, child in BONES:
        start = 0.0 if parent == ROOT else poses[:, parent]
        placed = 0.0 if parent == ROOT else resized[:, parent]
        resized[:, child] = placed + factors[:, length, None] * (poses[:, child] - start)
    return resized


def draw_factors(n: int, rng: np.random.Generator, *, stature_sd: float, bone_sd: float) -> Float:
    """Factors (n, 8) to other people: the whole person's and each length's, log-normal."""
    stature = rng.normal(0.0, stature_sd, (n, 1))
    bones = rng.normal(0.0, bone_sd, (n, len(LENGTHS)))
    factors: Float = np.exp(stature + bones)
    return factors
