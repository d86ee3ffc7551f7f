"""Nearest neighbours of descriptors behind one interface: exact, or approximate by HNSW.

Every backend answers ``query(descriptors, k)`` with the k nearest entries by Euclidean distance in
ascending order, is built once from a descriptor table, and is safe to query from several threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import hnswlib
import numpy as np
from numpy.typing import NDArray

from library_store.descriptor import DIMENSIONS
from library_store.errors import LibraryError

Descriptors = NDArray[np.float32]

_BLOCK = 16_384


@dataclass(frozen=True)
class Neighbours:
    """``entries`` (Q, k) int64 and their Euclidean ``distances`` (Q, k) float64, ascending."""

    entries: NDArray[np.int64]
    distances: NDArray[np.float64]


class Index(Protocol):
    """A nearest-neighbour index over the descriptors of a library."""

    backend: str

    def __len__(self) -> int:
        """How many entries there are."""
        ...

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        ...


class ExactIndex:
    """Brute force over the descriptor table: the oracle, and the fallback."""

    backend = "exact"

    def __init__(self, descriptors: Descriptors) -> None:
        self._descriptors = descriptors

    def __len__(self) -> int:
        return len(self._descriptors)

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        queries = np.asarray(descriptors, dtype=np.float32)
        k = min(k, len(self))
        best = np.zeros((len(queries), 0), dtype=np.int64)
        best_squared = np.zeros((len(queries), 0), dtype=np.float32)
        for start in range(0, len(self), _BLOCK):
            block = self._descriptors[start : start + _BLOCK]
            # |e|² - 2 q·e orders as |q - e|² does; the exact distances come last.
            squared = (block * block).sum(axis=1) - 2.0 * queries @ block.T
            if squared.shape[1] > k:
                chosen = np.argpartition(squared, k - 1, axis=1)[:, :k]
                squared = np.take_along_axis(squared, chosen, axis=1)
            else:
                chosen = np.broadcast_to(np.arange(squared.shape[1]), squared.shape)
            best = np.concatenate([best, chosen + start], axis=1)
            best_squared = np.concatenate([best_squared, squared], axis=1)
            keep = np.argsort(best_squared, axis=1, kind="stable")[:, :k]
            best = np.take_along_axis(best, keep, axis=1)
            best_squared = np.take_along_axis(best_squared, keep, axis=1)
        return sort_exactly(self._descriptors, queries, best)


@dataclass(frozen=True)
class HnswSettings:
    """How an HNSW graph is built: ``links`` is M, ``threads`` 0 means one per core.

    Only a graph built on one thread is the same at every build.
    """

    links: int = 16
    ef_construction: int = 150
    threads: int = 0

    def describe(self) -> dict[str, Any]:
        """What the manifest says about the index."""
        return {
            "backend": HnswIndex.backend,
            "M": self.links,
            "ef_construction": self.ef_construction,
            "reproducible": self.threads == 1,
        }


class HnswIndex:
    """Hierarchical navigable small world graph (hnswlib), held in memory.

    Read-only after construction: hnswlib must not add while it is queried, and its ``ef`` is one
    value for all threads, so both happen only here.
    """

    backend = "hnsw"

    def __init__(self, graph: hnswlib.Index, descriptors: Descriptors) -> None:
        self._graph = graph
        self._descriptors = descriptors
        # ef is not part of the saved file.
        graph.set_ef(ef_for(len(descriptors)))
        graph.set_num_threads(1)

    def __len__(self) -> int:
        return len(self._descriptors)

    @classmethod
    def build(
        cls,
        descriptors: Descriptors,
        settings: HnswSettings,
        progress: Callable[[float], None] | None = None,
    ) -> HnswIndex:
        """Build the graph over descriptors (E, 28); ``progress`` hears the fraction done."""
        graph = hnswlib.Index(space="l2", dim=DIMENSIONS)
        graph.init_index(
            max_elements=len(descriptors),
            M=settings.links,
            ef_construction=settings.ef_construction,
            random_seed=0,
        )
        threads = settings.threads or os.cpu_count() or 1
        for start in range(0, len(descriptors), _BLOCK // 4):
            labels = np.arange(start, min(start + _BLOCK // 4, len(descriptors)))
            graph.add_items(descriptors[labels], labels, num_threads=threads)
            if progress is not None:
                progress((labels[-1] + 1) / len(descriptors))
        return cls(graph, descriptors)

    @classmethod
    def load(cls, path: Path, descriptors: Descriptors) -> HnswIndex:
        """Read a saved graph; ``LibraryError`` when it is not one of these descriptors."""
        graph = hnswlib.Index(space="l2", dim=DIMENSIONS)
        try:
            graph.load_index(str(path))
        except RuntimeError as error:
            raise LibraryError(f"{path} is not an index hnswlib can read: {error}") from error
        if graph.get_current_count() != len(descriptors):
            raise LibraryError(
                f"{path} indexes {graph.get_current_count()} exemplars instead of "
                f"{len(descriptors)}"
            )
        return cls(graph, descriptors)

    def save(self, path: Path) -> None:
        """Write the graph to ``path``."""
        self._graph.save_index(str(path))

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        queries = np.ascontiguousarray(descriptors, dtype=np.float32)
        k = min(k, len(self))
        if not len(queries):
            return Neighbours(np.zeros((0, k), dtype=np.int64), np.zeros((0, k)))
        try:
            labels, _squared = self._graph.knn_query(queries, k=k, num_threads=1)
        except RuntimeError:
            # The graph reached fewer than k entries; hnswlib gives none of them then.
            return ExactIndex(self._descriptors).query(queries, k)
        return sort_exactly(self._descriptors, queries, labels.astype(np.int64))


def ef_for(n: int) -> int:
    """Width of the HNSW beam for ``n`` entries.

    96 at 200,000 entries gave a recall@10 of 1.0 and a recall@30 of 0.998 against exact search on
    1,500 poses of another capture; at a fixed width recall falls as the library grows.
    """
    return int(np.clip(96.0 * (n / 200_000.0), 64, 1024))


def sort_exactly(
    table: Descriptors, queries: Descriptors, entries: NDArray[np.int64]
) -> Neighbours:
    """Order candidate entries (Q, k) by their distance in float64, ties by entry."""
    entries = np.sort(entries, axis=1)
    difference = np.subtract(table[entries], queries[:, None], dtype=np.float64)
    distances = np.sqrt(np.einsum("qkd,qkd->qk", difference, difference))
    order = np.argsort(distances, axis=1, kind="stable")
    return Neighbours(
        entries=np.take_along_axis(entries, order, axis=1),
        distances=np.take_along_axis(distances, order, axis=1),
    )
