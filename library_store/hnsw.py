"""HNSW graph (hnswlib) for complete queries; masked ones go to the cells.

At 200,000 entries a complete query costs a third of what it does in the cells for 10 neighbours and
three quarters for 200; the graph takes 260 bytes an entry and most of the time of a build.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hnswlib
import numpy as np

from library_store.cell_index import CellIndex
from library_store.descriptor import DIMENSIONS, Float
from library_store.errors import LibraryError
from library_store.exact import ExactIndex
from library_store.neighbours import Descriptors, Neighbours, nearest_of, stack

HNSW_FILE = "index.hnsw"

_CHUNK = 4_096


@dataclass(frozen=True)
class HnswSettings:
    """How a graph is built: ``links`` is M, ``threads`` 0 means one per core.

    Only a graph built on one thread is the same at every build.
    """

    links: int = 16
    ef_construction: int = 150
    threads: int = 0

    def describe(self) -> dict[str, Any]:
        """What the manifest says about the graph."""
        return {
            "M": self.links,
            "ef_construction": self.ef_construction,
            "reproducible": self.threads == 1,
        }


class HnswIndex:
    """A graph held in memory.

    Read-only after construction: hnswlib must not add while it is queried, and its ``ef`` is one
    value for all threads, so both happen only here.
    """

    backend = "hnsw"

    def __init__(self, graph: Any, descriptors: Descriptors, cells: CellIndex) -> None:
        self._graph = graph
        self._descriptors = descriptors
        self._cells = cells
        # ef is not part of the saved file.
        graph.set_ef(ef_for(len(descriptors)))
        graph.set_num_threads(1)

    def __len__(self) -> int:
        return len(self._descriptors)

    @classmethod
    def load(cls, path: Path, descriptors: Descriptors, cells: CellIndex) -> HnswIndex:
        """Read a saved graph; ``LibraryError`` when it is not one of these descriptors."""
        graph = _new_graph()
        try:
            graph.load_index(str(path))
        except RuntimeError as error:
            raise LibraryError(f"{path} is not an index hnswlib can read: {error}") from error
        if graph.get_current_count() != len(descriptors):
            raise LibraryError(
                f"{path} indexes {graph.get_current_count()} exemplars instead of "
                f"{len(descriptors)}"
            )
        return cls(graph, descriptors, cells)

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        queries = np.ascontiguousarray(descriptors, dtype=np.float32)
        k = min(k, len(self))
        if not len(queries):
            return stack([], k)
        try:
            labels, _ = self._graph.knn_query(queries, k=k, num_threads=1)
        except RuntimeError:
            # The graph reached fewer than k entries; hnswlib gives none of them then.
            return ExactIndex(self._descriptors).query(queries, k)
        found = labels.astype(np.int64)
        return stack(
            [
                nearest_of(self._descriptors[entries], entries, query, k)
                for query, entries in zip(queries, found, strict=True)
            ],
            k,
        )

    def query_masked(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same for 2D poses (Q, 14, 2) with weights (Q, 14), by the masked distance."""
        return self._cells.query_masked(points, weights, k)

    def close(self) -> None:
        """Let go of graph and tables."""
        self._cells.close()
        self._descriptors = np.zeros((0, DIMENSIONS), dtype=np.float32)
        self._graph = None


def write_graph(
    path: Path,
    descriptors: Descriptors,
    settings: HnswSettings,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Build a graph over descriptors (E, 28) and save it; ``progress`` hears the fraction done."""
    graph = _new_graph()
    graph.init_index(
        max_elements=len(descriptors),
        M=settings.links,
        ef_construction=settings.ef_construction,
        random_seed=0,
    )
    threads = settings.threads or os.cpu_count() or 1
    for start in range(0, len(descriptors), _CHUNK):
        labels = np.arange(start, min(start + _CHUNK, len(descriptors)))
        graph.add_items(descriptors[labels], labels, num_threads=threads)
        if progress is not None:
            progress((labels[-1] + 1) / len(descriptors))
    graph.save_index(str(path))
    # hnswlib says nothing when the disk is full.
    missing = graph.index_file_size() - path.stat().st_size
    if missing:
        raise OSError(errno.ENOSPC, f"{missing} bytes could not be written", str(path))


def ef_for(n: int) -> int:
    """Width of the beam for ``n`` entries; at a fixed width recall falls as the library grows.

    64 at 200,000 entries gave a recall@10 of 0.999 on poses of other captures; docs/scale.md.
    """
    return int(np.clip(64.0 * (n / 200_000.0) ** 0.75, 64, 1024))


def _new_graph() -> Any:
    return hnswlib.Index(space="l2", dim=DIMENSIONS)
