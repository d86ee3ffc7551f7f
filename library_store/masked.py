"""2D poses with missing or unsure joints: ranking many by the masked distance, and their order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from library_store.descriptor import N_JOINTS, Float, distance_from_normalised
from library_store.neighbours import Descriptors, Entries, Neighbours
from library_store.skeleton import (
    L_ANKLE,
    L_ELBOW,
    L_KNEE,
    L_WRIST,
    R_ANKLE,
    R_ELBOW,
    R_KNEE,
    R_WRIST,
)

_LIMBS = [R_ELBOW, R_WRIST, L_ELBOW, L_WRIST, R_KNEE, R_ANKLE, L_KNEE, L_ANKLE]


def missing_limbs(weights: Float) -> float:
    """How many of elbows, wrists, knees and ankles are missing, 0 to 8.

    The other joints tell little of these, so that without them many poses look alike; a missing
    head or hip hardly matters. A joint of weight 1/2 or more is hardly missing.
    """
    return float(np.clip(1.0 - 2.0 * weights[_LIMBS], 0.0, 1.0).sum())


def nearest_masked(
    table: Descriptors, entries: Entries, query: Float, weights: Float, k: int
) -> Neighbours:
    """The k entries nearest to a query by the masked distance, in float64, ties by entry.

    ``entries`` (n,) are those of the rows of ``table`` (n, 28); ``query`` (14, 2) is normalised on
    its ``weights`` (14,). Neighbours of (k,).
    """
    order = np.argsort(entries)
    poses = table[order].reshape(-1, N_JOINTS, 2)
    distances = distance_from_normalised(query, weights, poses)
    best = np.argsort(distances, kind="stable")[:k]
    return Neighbours(entries=entries[order][best], distances=distances[best])


class Correlation:
    """Weighted correlation of a normalised query (14, 2) with poses, the larger the nearer.

    D² = 28 (1 - correlation): its order is that of the masked distance. Descriptors sum to zero and
    have the length sqrt(14), so that their weighted mean and spread follow from the joints that
    have less than the full weight, which are few.
    """

    def __init__(self, query: Float, weights: Float) -> None:
        full = weights.max()
        share = weights / weights.sum()
        # What has no weight may be anything, even infinite.
        load = np.where(share[:, None] > 0, share[:, None] * query, 0.0)
        self._load = load.ravel().astype(np.float32)
        unsure = np.flatnonzero(weights < full)
        lack = ((full - weights[unsure]) / weights.sum()).astype(np.float32)
        self._columns = (2 * unsure[:, None] + np.arange(2)).ravel()
        self._means = (lack[:, None, None] * np.eye(2, dtype=np.float32)).reshape(-1, 2)
        self._lack = np.repeat(lack, 2)
        self._whole = np.float32(N_JOINTS * full / weights.sum())

    def __call__(self, descriptors: Descriptors) -> NDArray[np.float32]:
        """Of descriptors (n, 28): (n,) in [-1, 1]."""
        unsure = descriptors[:, self._columns]
        means = unsure @ self._means
        spread = self._whole - (unsure * unsure) @ self._lack
        spread -= means[:, 0] ** 2 + means[:, 1] ** 2
        correlation: NDArray[np.float32] = descriptors @ self._load
        correlation /= np.sqrt(np.maximum(spread, 1e-12))
        return correlation
