"""Brute force over the descriptor table: the oracle, and the fallback."""

from __future__ import annotations

import numpy as np

from library_store.descriptor import DIMENSIONS, Float, normalise
from library_store.masked import Correlation, nearest_masked
from library_store.neighbours import (
    SPARE,
    Descriptors,
    Entries,
    Neighbours,
    Similarity,
    largest,
    nearest_of,
    product_with,
    stack,
)

_BLOCK = 8_192  # rows that stay in the second-level cache


class ExactIndex:
    """Ranks every entry for every query."""

    backend = "exact"

    def __init__(self, descriptors: Descriptors) -> None:
        self._descriptors = descriptors

    def __len__(self) -> int:
        return len(self._descriptors)

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        k = min(k, len(self))
        found = []
        for descriptor in np.asarray(descriptors, dtype=np.float32):
            entries = self._best(product_with(descriptor), k)
            found.append(nearest_of(self._descriptors[entries], entries, descriptor, k))
        return stack(found, k)

    def query_masked(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same for 2D poses (Q, 14, 2) with weights (Q, 14), by the masked distance."""
        k = min(k, len(self))
        found = []
        for query, share in zip(normalise(points, weights), weights, strict=True):
            entries = self._best(Correlation(query, share), k)
            found.append(nearest_masked(self._descriptors[entries], entries, query, share, k))
        return stack(found, k)

    def close(self) -> None:
        """Let go of the table."""
        self._descriptors = np.zeros((0, DIMENSIONS), dtype=np.float32)

    def _best(self, similarity: Similarity, k: int) -> Entries:
        """The k most similar entries and a few more, in no order."""
        best = np.zeros(0, dtype=np.int64)
        values = np.zeros(0, dtype=np.float32)
        for start in range(0, len(self), _BLOCK):
            block = similarity(self._descriptors[start : start + _BLOCK])
            chosen = largest(block, k + SPARE)
            best = np.concatenate([best, chosen + start])
            values = np.concatenate([values, block[chosen]])
            kept = largest(values, k + SPARE)
            best, values = best[kept], values[kept]
        return best
