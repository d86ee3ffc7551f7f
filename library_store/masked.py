"""Nearest neighbours of 2D poses with missing or unsure joints.

The index knows complete descriptors only, and a missing wrist could be in many places; guesses of
it send the search to one after the other. So masked queries have an index of their own, which every
mask can use: the entries lie in cells (:mod:`library_store.cells`).

1. The cells are ranked by the masked distance of their centres.
2. All entries of the nearest cells are ranked by the masked distance in float32.
3. The best of them are ranked again in float64.

The more of the person is missing, the more cells are nearly equal and the more are scanned.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from library_store.cells import partition
from library_store.descriptor import (
    N_JOINTS,
    Float,
    distance_from_normalised,
    normalise,
)
from library_store.index import Descriptors, Neighbours

Entries = NDArray[np.int64]

_BLOCK, _SCAN_BLOCK = 8_192, 4_096  # float32 rows that stay in the second-level cache
_SPARE = 8  # ranked in float64 beyond k, for float32 may confuse the last places


@dataclass(frozen=True)
class MaskedSettings:
    """How hard a masked search tries.

    ``rows_per_cell``: entries in a cell on average; ``share``: the part of the library that is
    scanned when nothing is missing, ``share_per_joint``: more of it for every missing joint;
    ``least_scanned``: entries that are scanned however small the library is.
    """

    rows_per_cell: int = 100
    share: float = 0.03
    share_per_joint: float = 0.0175
    least_scanned: int = 6_000


class MaskedSearch:
    """Masked and weighted queries over a descriptor table; safe to use from several threads."""

    def __init__(self, descriptors: Descriptors, settings: MaskedSettings | None = None) -> None:
        self._descriptors = descriptors
        self._settings = settings or MaskedSettings()
        self._cells = partition(descriptors, self._settings.rows_per_cell)
        self._sizes = self._cells.sizes
        self._centres = Moments(self._cells.centres)

    def query(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The k nearest entries of one 2D pose (14, 2) with weights (14,); Neighbours of (k,).

        Raises ``ValueError`` when joints of positive weight are fewer than two or coincide.
        """
        query = normalise(points, weights)
        cells = np.argsort(-self._centres.similarity(query, weights))
        sizes = self._sizes[cells]
        ends = np.cumsum(sizes)
        n = np.searchsorted(ends, max(self._n_scanned(weights), k + _SPARE)) + 1
        cells, sizes, ends = cells[:n], sizes[:n], ends[:n]
        starts = self._cells.starts[cells]
        runs = [slice(start, end) for start, end in zip(starts, starts + sizes, strict=True)]
        # A few runs at a time, so that they are still in the cache when they are ranked.
        cuts = [*np.searchsorted(ends, np.arange(0, ends[-1], _SCAN_BLOCK)).tolist(), len(runs)]
        similarity = np.concatenate(
            [
                Moments(
                    np.concatenate([self._cells.rows[run] for run in runs[cut:after]])
                ).similarity(query, weights)
                for cut, after in pairwise(cuts)
                if cut < after
            ]
        )
        best = _largest(similarity, k + _SPARE)
        run_of = np.searchsorted(ends, best, side="right")
        rows = best - ends[run_of] + sizes[run_of] + starts[run_of]
        return self._best(query, weights, np.sort(self._cells.entries[rows]), k)

    def exact(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same by brute force: the oracle."""
        query = normalise(points, weights)
        kept = [
            start
            + _largest(
                Moments(self._descriptors[start : start + _BLOCK]).similarity(query, weights),
                k + _SPARE,
            )
            for start in range(0, len(self._descriptors), _BLOCK)
        ]
        return self._best(query, weights, np.sort(np.concatenate(kept)), k)

    def _n_scanned(self, weights: Float) -> int:
        """How many entries to rank: a joint of weight 1/2 or more is hardly missing."""
        missing = float(np.clip(1.0 - 2.0 * weights, 0.0, 1.0).sum())
        share = self._settings.share + self._settings.share_per_joint * missing
        return max(self._settings.least_scanned, int(share * len(self._descriptors)))

    def _best(self, query: Float, weights: Float, entries: Entries, k: int) -> Neighbours:
        """The k best of ``entries``, ascending, by the masked distance in float64."""
        poses = self._descriptors[entries].reshape(-1, N_JOINTS, 2)
        distances = distance_from_normalised(query, weights, poses)
        order = np.argsort(distances, kind="stable")[:k]
        return Neighbours(entries=entries[order], distances=distances[order])


def _largest(values: NDArray[np.float32], n: int) -> Entries:
    """Where the n largest values are, in no order."""
    if len(values) <= n:
        return np.arange(len(values))
    return np.argpartition(values, len(values) - n)[len(values) - n :]


class Moments:
    """A block of descriptors, ready for masked similarities."""

    def __init__(self, descriptors: Descriptors) -> None:
        self._flat = np.asarray(descriptors, dtype=np.float32)
        self._squares = self._flat * self._flat

    def similarity(self, query: Float, weights: Float) -> NDArray[np.float32]:
        """Weighted correlation in [-1, 1] of a normalised query (14, 2) with each pose: (n,).

        D² = 28 (1 - similarity): the order is that of the masked distance.
        """
        share = weights / weights.sum()
        loads = np.zeros((N_JOINTS, 2, 3))
        loads[:, 0, 0] = loads[:, 1, 1] = share
        # What has no weight may be anything, even infinite.
        loads[:, :, 2] = np.where(share[:, None] > 0, share[:, None] * query, 0.0)
        sums = self._flat @ loads.reshape(2 * N_JOINTS, 3).astype(np.float32)
        spread = self._squares @ np.repeat(share, 2).astype(np.float32)
        spread -= sums[:, 0] ** 2 + sums[:, 1] ** 2
        similarity: NDArray[np.float32] = sums[:, 2] / np.sqrt(np.maximum(spread, 1e-12))
        return similarity
