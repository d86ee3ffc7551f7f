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

import numpy as np

from app.lifting.geometry import Floats
from library_store.anatomy import LENGTHS
from library_store.proportions import BONES, ROOT
from library_store.skeleton import LSP14

_SHARE_OF_HEIGHT = {
    "trunk": 0.33,
    "head": 0.15,
    "shoulder": 0.0,
    "upper_arm": 0.0,
    "forearm": 0.0,
    "hips": 0.0,
    "thigh": 0.25,
    "shank": 0.27,
}
"""The kinds of segments, and what each adds to the standing height."""


def _contributions() -> Floats:
    """(8, J, J): row j of matrix g, times a root-centred pose: what segments g add to joint j."""
    kinds = list(_SHARE_OF_HEIGHT)
    chain = {child: (kinds.index(LENGTHS[length]), parent) for length, parent, child in BONES}
    matrices = np.zeros((len(kinds), LSP14.n_joints, LSP14.n_joints))
    for joint in range(LSP14.n_joints):
        end = joint
        while end != ROOT:
            kind, start = chain[end]
            matrices[kind, joint, end] += 1.0
            if start != ROOT:
                matrices[kind, joint, start] -= 1.0
            end = start
    return matrices


def _directions() -> Floats:
    """(7, J, J): independent directions of unit spread in log lengths, at one size."""
    share = np.array(list(_SHARE_OF_HEIGHT.values()))
    covariance = np.eye(len(share)) - np.outer(share, share) / (share @ share)
    values, vectors = np.linalg.eigh(covariance)
    kept = vectors[:, values > 0.5].T
    directions: Floats = np.einsum("dg,gij->dij", kept, _contributions())
    return directions


PROPORTION_DIRECTIONS = _directions()
"""(7, J, J): times a root-centred pose (J, 3), how it moves with its proportions, mm a unit of log
length. Lengths are equal on both sides; the directions are those that keep the standing height."""

Segment = tuple[int, int]


def _paired_segments() -> tuple[tuple[Segment, Segment], ...]:
    """The right and the left of each kind of limb, and of the shoulders: (parent, child)."""
    pairs = []
    for kind in ("shoulder", "upper_arm", "forearm", "thigh", "shank"):
        right, left = ((a, b) for length, a, b in BONES if LENGTHS[length] == kind)
        pairs.append((right, left))
    return tuple(pairs)


SYMMETRIC_SEGMENTS = _paired_segments()
