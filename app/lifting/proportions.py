"""Body proportions: what they do to a pose seen from its camera, and that left equals right.

The library's people are built as its mocap subjects were, and its skeletons put the joints where
that mocap put them; the person in the photo has other proportions, and other joint definitions look
just like it. A pose is linear in its segment lengths: ``X = Σ_g λ_g X_g``, with ``X_g`` what the
segments of one kind contribute. So ignorance of the eight lengths is a few directions in which
image positions and depths move together. Without them narrow shoulders can only be explained by
turning the trunk.

Overall size is left out: it changes no image.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from app.lifting.geometry import Floats, Integers
from library_store.skeleton import (
    HEAD_TOP,
    L_ANKLE,
    L_ELBOW,
    L_HIP,
    L_KNEE,
    L_SHOULDER,
    L_WRIST,
    LSP14,
    NECK,
    R_ANKLE,
    R_ELBOW,
    R_HIP,
    R_KNEE,
    R_SHOULDER,
    R_WRIST,
)

_ROOT = -1
# Kinds of segments, each as chains of joints from the root outwards.
_CHAINS: tuple[tuple[int, ...], ...] = (
    (_ROOT, NECK, HEAD_TOP),
    (NECK, R_SHOULDER, R_ELBOW, R_WRIST),
    (NECK, L_SHOULDER, L_ELBOW, L_WRIST),
    (_ROOT, R_HIP, R_KNEE, R_ANKLE),
    (_ROOT, L_HIP, L_KNEE, L_ANKLE),
)
_KINDS: tuple[tuple[int, ...], ...] = (
    (NECK,),
    (HEAD_TOP,),
    (R_SHOULDER, L_SHOULDER),
    (R_ELBOW, L_ELBOW),
    (R_WRIST, L_WRIST),
    (R_HIP, L_HIP),
    (R_KNEE, L_KNEE),
    (R_ANKLE, L_ANKLE),
)
"""Segments of one length, by the joint each ends at: trunk, head, shoulder, upper arm, forearm,
hip, thigh, shank."""
_STATURE = (0.33, 0.15, 0.0, 0.0, 0.0, 0.0, 0.25, 0.27)
"""Shares of the kinds in standing height."""


def _contributions() -> Floats:
    """(8, J, J): row j of matrix g, times a root-centred pose: what segments g add to joint j."""
    parent = {child: start for chain in _CHAINS for start, child in pairwise(chain)}
    matrices = np.zeros((len(_KINDS), LSP14.n_joints, LSP14.n_joints))
    for joint in range(LSP14.n_joints):
        end = joint
        while end != _ROOT:
            kind = next(number for number, ends in enumerate(_KINDS) if end in ends)
            matrices[kind, joint, end] += 1.0
            if parent[end] != _ROOT:
                matrices[kind, joint, parent[end]] -= 1.0
            end = parent[end]
    return matrices


def _directions() -> Floats:
    """(7, J, J): independent directions of unit spread in log lengths, at one size."""
    n = len(_KINDS)
    share = np.array(_STATURE)
    covariance = np.eye(n) - np.outer(share, share) / (share @ share)
    values, vectors = np.linalg.eigh(covariance)
    kept = vectors[:, values > 0.5].T
    directions: Floats = np.einsum("dg,gij->dij", kept, _contributions())
    return directions


_DIRECTIONS = _directions()


def proportion_directions(poses_mm: Floats) -> Floats:
    """How a root-centred pose (J, 3) moves with its proportions: (7, J, 3) mm a unit of log length.

    Lengths are equal on both sides; the directions are those that keep the standing height.
    """
    return _DIRECTIONS @ poses_mm


SYMMETRIC_SEGMENTS: tuple[tuple[tuple[int, int], tuple[int, int]], ...] = (
    ((NECK, R_SHOULDER), (NECK, L_SHOULDER)),
    ((R_SHOULDER, R_ELBOW), (L_SHOULDER, L_ELBOW)),
    ((R_ELBOW, R_WRIST), (L_ELBOW, L_WRIST)),
    ((R_HIP, R_KNEE), (L_HIP, L_KNEE)),
    ((R_KNEE, R_ANKLE), (L_KNEE, L_ANKLE)),
)
_STARTS: Integers = np.array([[a, b] for (a, _), (b, _) in SYMMETRIC_SEGMENTS])
_ENDS: Integers = np.array([[a, b] for (_, a), (_, b) in SYMMETRIC_SEGMENTS])


def asymmetry(joints_mm: Floats) -> tuple[Floats, Floats]:
    """Log ratios right to left of the five paired segments of a pose (J, 3), and their derivative.

    Returns (5,) and (5, J, 3) a mm.
    """
    segment = joints_mm[_ENDS] - joints_mm[_STARTS]
    squared = np.maximum((segment**2).sum(-1), 1.0)
    ratio = 0.5 * np.log(squared[:, 0] / squared[:, 1])
    slope = segment / squared[..., None] * np.array([1.0, -1.0])[:, None]
    derivative = np.zeros((len(segment), *joints_mm.shape))
    rows = np.arange(len(segment))[:, None]
    np.add.at(derivative, (rows, _ENDS), slope)
    np.add.at(derivative, (rows, _STARTS), -slope)
    return ratio, derivative
