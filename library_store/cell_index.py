"""The default index: k-means cells, of which the nearest are scanned.

One structure serves complete queries and every mask:

1. The cells are ranked by the (masked) similarity of their centres.
2. All entries of the nearest cells are ranked by their similarity in float32.
3. The best of them are put in exact order in float64.

The more of the person is missing, the more cells are nearly equal and the more are scanned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from library_store.cells import Cells, partition
from library_store.descriptor import DIMENSIONS, Float, normalise
from library_store.errors import LibraryError
from library_store.masked import Correlation, missing_limbs, nearest_masked
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
from library_store.tables import TableWriter, open_table

CELLS_FILE, ROWS_FILE, ENTRIES_FILE = "index.cells.npz", "index.rows.npy", "index.entries.npy"
ROWS_PER_CELL = 100
"""Entries in a cell on average: fewer make ranking the cells, more scanning them slower."""

CELL_FILES = (CELLS_FILE, ROWS_FILE, ENTRIES_FILE)

_YES = np.ones(1, dtype=np.bool_)
_SCAN_BLOCK = 4_096  # rows that stay in the second-level cache
_WRITE_BLOCK = 65_536


@dataclass(frozen=True)
class ScanSettings:
    """How many entries a query scans.

    ``scanned`` and ``per_neighbour`` times k in a library of 200,000, growing with the fourth root
    of its size. Masked queries begin with the share ``masked`` of that, for a recall@10 of 0.95 is
    wanted of them and 0.99 of complete ones. Every missing elbow, wrist, knee or ankle multiplies
    it by ``per_limb``, which itself grows with the power ``limb_growth`` of the size, for the
    neighbours spread in more dimensions. docs/scale.md has the recall these give.
    """

    scanned: int = 5_000
    per_neighbour: int = 15
    masked: float = 0.6
    per_limb: float = 1.5
    limb_growth: float = 0.09

    def n_scanned(self, n: int, weights: Float | None, k: int) -> int:
        """How many of ``n`` entries a query scans."""
        size = n / 200_000.0
        effort = (self.scanned + self.per_neighbour * k) * size**0.25
        if weights is not None:
            per_limb = self.per_limb * max(size, 1.0) ** self.limb_growth
            effort *= self.masked * per_limb ** missing_limbs(weights)
        return min(n, int(effort))


class CellIndex:
    """Scans the nearest cells of a partition of the library."""

    backend = "cells"

    def __init__(self, cells: Cells, rows: Descriptors, settings: ScanSettings) -> None:
        self._cells = cells
        self._rows = rows
        self._settings = settings

    def __len__(self) -> int:
        return len(self._rows)

    @classmethod
    def build(
        cls,
        descriptors: Descriptors,
        rows_per_cell: int = ROWS_PER_CELL,
        settings: ScanSettings | None = None,
    ) -> CellIndex:
        """The index in memory, of descriptors (E, 28)."""
        cells = partition(descriptors, rows_per_cell)
        return cls(cells, descriptors[cells.entries], settings or ScanSettings())

    @classmethod
    def load(cls, directory: Path, n: int, settings: ScanSettings | None = None) -> CellIndex:
        """Open what :func:`write_cells` wrote, memory-mapped; ``LibraryError`` if not of n rows."""
        entries = open_table(directory / ENTRIES_FILE).astype(np.int32, copy=False)
        rows = open_table(directory / ROWS_FILE).astype(np.float32, copy=False)
        cells = Cells.load(directory / CELLS_FILE, entries)
        if rows.shape != (n, DIMENSIONS) or entries.shape != (n,):
            raise LibraryError(f"{directory / ROWS_FILE} does not hold {n} exemplars")
        return cls(cells, rows, settings or ScanSettings())

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        k = min(k, len(self))
        n_rows = self._settings.n_scanned(len(self), None, k)
        found = []
        for descriptor in np.asarray(descriptors, dtype=np.float32):
            rows = self._scan(product_with(descriptor), n_rows, k)
            found.append(nearest_of(self._rows[rows], self._entries(rows), descriptor, k))
        return stack(found, k)

    def query_masked(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same for 2D poses (Q, 14, 2) with weights (Q, 14), by the masked distance."""
        k = min(k, len(self))
        found = []
        for query, share in zip(normalise(points, weights), weights, strict=True):
            n_rows = self._settings.n_scanned(len(self), share, k)
            rows = self._scan(Correlation(query, share), n_rows, k)
            entries = self._entries(rows)
            found.append(nearest_masked(self._rows[rows], entries, query, share, k))
        return stack(found, k)

    def close(self) -> None:
        """Let go of the maps."""
        self._rows = np.zeros((0, DIMENSIONS), dtype=np.float32)
        self._cells = partition(self._rows, 1)

    def _entries(self, rows: Entries) -> Entries:
        return self._cells.entries[rows].astype(np.int64)

    def _scan(self, similarity: Similarity, n_rows: int, k: int) -> Entries:
        """The rows most similar among those of the nearest cells: k and a few more, unordered."""
        near = self._cells.near(similarity, max(n_rows, k + SPARE))
        starts, stops = self._cells.starts[near], self._cells.starts[near + 1]
        # Cells that lie side by side are read in one piece.
        apart = starts[1:] != stops[:-1]
        starts = starts[np.concatenate([_YES, apart])]
        stops = stops[np.concatenate([apart, _YES])]
        ends = np.cumsum(stops - starts)
        runs = [self._rows[a:b] for a, b in zip(starts.tolist(), stops.tolist(), strict=True)]
        # A few runs at a time, so that they are still in the cache when they are ranked.
        blocks = np.searchsorted(ends, np.arange(0, ends[-1], _SCAN_BLOCK)).tolist()
        values = [
            similarity(np.concatenate(runs[first:after]))
            for first, after in pairwise([*blocks, len(runs)])
            if first < after
        ]
        best = largest(np.concatenate(values), k + SPARE)
        run_of = np.searchsorted(ends, best, side="right")
        rows: NDArray[np.int64] = best - ends[run_of] + stops[run_of]
        return rows


def write_cells(
    directory: Path,
    descriptors: Descriptors,
    rows_per_cell: int = ROWS_PER_CELL,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Write the index's files; returns what the manifest says about it."""
    report = progress or (lambda _: None)
    cells = partition(descriptors, rows_per_cell, lambda done: report(0.9 * done))
    cells.save(directory / CELLS_FILE)
    np.save(directory / ENTRIES_FILE, cells.entries, allow_pickle=False)
    with TableWriter(directory / ROWS_FILE, descriptors.shape, np.float32) as table:
        for start in range(0, len(descriptors), _WRITE_BLOCK):
            table.append(descriptors[cells.entries[start : start + _WRITE_BLOCK]])
    report(1.0)
    return {"cells": len(cells.centres), "rows_per_cell": rows_per_cell}
