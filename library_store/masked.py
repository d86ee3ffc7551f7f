"""Nearest neighbours of 2D poses with missing or unsure joints.

The index knows complete descriptors only, and a single guess of a missing wrist sends the search to
one of the many places where it could be. So: impute → search → exact re-rank, with many guesses.

1. *Pilots*, an even subset of the entries, are ranked by the exact masked distance.
2. Each of the best pilots, shifted and scaled onto the visible joints, lends the query its joints
   where the query has none: coordinate w q + (1 - w) e for weight w.
3. The completed queries are searched in the index.
4. What they find is ranked by the exact masked distance. The best of it complete the query afresh
   and steps 3 and 4 are repeated, for they are nearer than any pilot.

The more of the person is missing, the more guesses are needed; where those would cost more than
ranking every entry by brute force, brute force answers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from library_store.descriptor import N_JOINTS, Float, describe, normalise, weighted_distance
from library_store.index import Descriptors, Index, Neighbours

Entries = NDArray[np.int64]

_BLOCK = 8_192  # float32 rows that stay in the second-level cache


@dataclass(frozen=True)
class MaskedSettings:
    """How hard a masked search tries.

    ``n_pilots``: how many pilots there are; ``guesses_per_joint``: completions in the first round
    for every missing joint, half as many again in the second; ``width``: neighbours searched per
    completion, as a multiple of k; ``entries_per_guess``: how many entries brute force ranks in
    the time of one guess (measured: 0.25 ms against 12 ms for 200,000).
    """

    n_pilots: int = 8_192
    guesses_per_joint: float = 8.0
    width: int = 2
    entries_per_guess: int = 4_000


class MaskedSearch:
    """Masked and weighted queries over an index; safe to use from several threads."""

    def __init__(
        self, index: Index, descriptors: Descriptors, settings: MaskedSettings | None = None
    ) -> None:
        self._index = index
        self._descriptors = descriptors
        self._settings = settings or MaskedSettings()
        stride = max(1, len(descriptors) // self._settings.n_pilots)
        self._pilots: Entries = np.arange(0, len(descriptors), stride, dtype=np.int64)
        self._pilot_moments = Moments(descriptors[self._pilots])

    def query(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The k nearest entries of one 2D pose (14, 2) with weights (14,); Neighbours of (k,).

        Raises ``ValueError`` when joints of positive weight are fewer than two or coincide.
        """
        query = normalise(points, weights)
        rounds = self._guesses(weights)
        if len(self._descriptors) <= self._settings.entries_per_guess * sum(rounds):
            return self.exact(points, weights, k)
        similarity = self._pilot_moments.similarity(query, weights)
        entries = self._pilots[np.argpartition(-similarity, rounds[0])[: rounds[0]]]
        width = max(32, self._settings.width * k)
        found = entries
        for guesses in rounds:
            completed = self._complete(query, weights, entries[:guesses])
            fresh = self._index.query(describe(completed), width).entries
            found = np.unique(np.concatenate([found, fresh.ravel()]))
            entries = self._best(query, weights, found, max(k, *rounds)).entries
        return self._best(query, weights, found, k)

    def _guesses(self, weights: Float) -> tuple[int, int]:
        """Completions in each round: a joint of weight 1/2 or more is hardly missing."""
        missing = float(np.clip(1.0 - 2.0 * weights, 0.0, 1.0).sum())
        first = 2 + int(np.ceil(self._settings.guesses_per_joint * missing))
        return first, first + first // 2

    def exact(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same by brute force: the oracle."""
        query = normalise(points, weights)
        kept: list[Entries] = []
        for start in range(0, len(self._descriptors), _BLOCK):
            block = np.asarray(self._descriptors[start : start + _BLOCK])
            similarity = Moments(block).similarity(query, weights)
            # A few more than k, for float32 may confuse the last places.
            n = min(len(block), k + 8)
            kept.append(start + np.argpartition(-similarity, n - 1)[:n].astype(np.int64))
        return self._best(query, weights, np.sort(np.concatenate(kept)), k)

    def _best(self, query: Float, weights: Float, entries: Entries, k: int) -> Neighbours:
        """The k best of ``entries`` by the masked distance in float64."""
        poses = self._descriptors[entries].reshape(-1, N_JOINTS, 2)
        distances = weighted_distance(query, weights, poses)
        order = np.argsort(distances, kind="stable")[:k]
        return Neighbours(entries=entries[order], distances=distances[order])

    def _complete(self, query: Float, weights: Float, entries: Entries) -> Float:
        """The query completed by each of the entries: (n, 14, 2)."""
        poses = self._descriptors[entries].reshape(-1, N_JOINTS, 2)
        lent = normalise(poses, np.broadcast_to(weights, (1, N_JOINTS)))
        share = weights[:, None]
        completed: Float = share * query + (1.0 - share) * lent
        return completed


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
        loads[:, :, 2] = share[:, None] * query
        sums = self._flat @ loads.reshape(2 * N_JOINTS, 3).astype(np.float32)
        spread = self._squares @ np.repeat(share, 2).astype(np.float32)
        spread -= sums[:, 0] ** 2 + sums[:, 1] ** 2
        similarity: NDArray[np.float32] = sums[:, 2] / np.sqrt(np.maximum(spread, 1e-12))
        return similarity
