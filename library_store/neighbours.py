"""What every nearest-neighbour index answers, and the exact order of what was found.

Descriptors all have the length sqrt(14), so the nearest to a query is the one with the largest
product. Indices rank by it in float32 and order the best again in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from library_store.descriptor import Float

Descriptors = NDArray[np.float32]
Entries = NDArray[np.int64]
Similarity = Callable[[Descriptors], NDArray[np.float32]]
"""How near descriptors (n, 28) are to one query, larger is nearer: (n,)."""

SPARE = 8
"""Entries put in exact order beyond the k wanted, for float32 may confuse the last places."""


@dataclass(frozen=True)
class Neighbours:
    """``entries`` (..., k) int64 and their ``distances`` (..., k) float64, ascending."""

    entries: Entries
    distances: Float


class Index(Protocol):
    """A nearest-neighbour index over the descriptors of a library.

    Read-only and safe to query from several threads. A query's answer does not depend on those it
    is asked together with. Raises ``IndexUnavailableError`` while its engine is away.
    """

    backend: str

    def __len__(self) -> int:
        """How many entries there are."""
        ...

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` entries nearest to each descriptor (Q, 28): Neighbours of (Q, k)."""
        ...

    def query_masked(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same for 2D poses (Q, 14, 2) with weights (Q, 14), by the masked distance.

        Raises ``ValueError`` when joints of positive weight are fewer than two or coincide.
        """
        ...

    def close(self) -> None:
        """Let go of memory and connections; the index must not be used afterwards."""
        ...


def product_with(descriptor: Descriptors) -> Similarity:
    """Similarity to a complete descriptor (28,)."""
    return lambda rows: rows @ descriptor


def nearest_of(table: Descriptors, entries: Entries, descriptor: Descriptors, k: int) -> Neighbours:
    """The k entries nearest to a descriptor (28,), in float64, ascending, ties by entry.

    ``entries`` (n,) are those of the rows of ``table`` (n, 28). Neighbours of (k,).
    """
    difference = table.astype(np.float64) - descriptor
    distances = np.sqrt(np.einsum("nd,nd->n", difference, difference))
    best = np.lexsort((entries, distances))[:k]
    return Neighbours(entries=entries[best], distances=distances[best])


def largest(values: NDArray[np.float32], n: int) -> Entries:
    """Where the n largest values are, in no order."""
    if len(values) <= n:
        return np.arange(len(values))
    return np.argpartition(values, len(values) - n)[len(values) - n :]


def stack(found: list[Neighbours], k: int) -> Neighbours:
    """Answers to single queries, (k,) each, one under the other: (Q, k)."""
    if not found:
        return Neighbours(np.zeros((0, k), dtype=np.int64), np.zeros((0, k)))
    return Neighbours(
        entries=np.stack([one.entries for one in found]),
        distances=np.stack([one.distances for one in found]),
    )
