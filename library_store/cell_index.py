"""The index for every mask: k-means cells, of which the nearest are scanned.

One structure serves complete queries and every mask:

1. The cells are ranked by the (masked) similarity of their centres.
2. All rows of the nearest cells are ranked by their similarity (:mod:`library_store.scan`).
3. The best of them are put in exact order, by their descriptors in float64.

The more of the person is missing, the more cells are nearly equal and the more are scanned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from library_store.cells import Cells, partition
from library_store.descriptor import DIMENSIONS, N_JOINTS, Float, normalise
from library_store.errors import LibraryError
from library_store.masked import missing_limbs, nearest_masked
from library_store.neighbours import Descriptors, Entries, Neighbours, nearest_of, stack
from library_store.scan import LANES, Scan, encode, n_blocks
from library_store.tables import TableWriter, open_table

CELLS_FILE, CODES_FILE, ENTRIES_FILE = "index.cells.npz", "index.codes.npy", "index.entries.npy"
ROWS_PER_CELL = 100
"""Entries in a cell on average: fewer make ranking the cells, more scanning them slower."""

CELL_FILES = (CELLS_FILE, CODES_FILE, ENTRIES_FILE)

_RANKED, _RANKED_PER_NEIGHBOUR = 30, 2
"""Rows put in exact order, and more for each neighbour: the scan sees them rounded."""
_EQUAL = np.full(N_JOINTS, 1.0 / N_JOINTS)
_WRITE_BLOCK = 4_096 * LANES


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
    """Scans the nearest cells of a partition of the library's descriptors (E, 28)."""

    backend = "cells"

    def __init__(
        self, cells: Cells, scan: Scan, descriptors: Descriptors, settings: ScanSettings
    ) -> None:
        self._entries = cells.entries
        self._scan = scan
        self._descriptors = descriptors
        self._settings = settings

    def __len__(self) -> int:
        return len(self._descriptors)

    @classmethod
    def build(
        cls,
        descriptors: Descriptors,
        rows_per_cell: int = ROWS_PER_CELL,
        settings: ScanSettings | None = None,
    ) -> CellIndex:
        """The index in memory, of descriptors (E, 28)."""
        cells = partition(descriptors, rows_per_cell)
        scan = Scan(encode(descriptors[cells.entries]), cells.starts, cells.centres)
        return cls(cells, scan, descriptors, settings or ScanSettings())

    @classmethod
    def load(
        cls, directory: Path, descriptors: Descriptors, settings: ScanSettings | None = None
    ) -> CellIndex:
        """Open what :func:`write_cells` wrote, memory-mapped; ``LibraryError`` if of other rows."""
        entries = open_table(directory / ENTRIES_FILE).astype(np.int32, copy=False)
        codes = open_table(directory / CODES_FILE).astype(np.int8, copy=False)
        if entries.shape != (len(descriptors),):
            raise LibraryError(
                f"{directory / ENTRIES_FILE} does not hold {len(descriptors)} exemplars"
            )
        cells = Cells.load(directory / CELLS_FILE, entries)
        scan = Scan(codes, cells.starts, cells.centres)
        return cls(cells, scan, descriptors, settings or ScanSettings())

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28)."""
        k = min(k, len(self))
        n_scanned = self._settings.n_scanned(len(self), None, k)
        found = []
        for descriptor in np.asarray(descriptors, dtype=np.float32):
            entries = self._near(descriptor.reshape(N_JOINTS, 2), _EQUAL, n_scanned, k)
            found.append(nearest_of(self._descriptors[entries], entries, descriptor, k))
        return stack(found, k)

    def query_masked(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same for 2D poses (Q, 14, 2) with weights (Q, 14), by the masked distance."""
        k = min(k, len(self))
        found = []
        for query, given in zip(normalise(points, weights), weights, strict=True):
            n_scanned = self._settings.n_scanned(len(self), given, k)
            entries = self._near(query, given / given.sum(), n_scanned, k)
            found.append(nearest_masked(self._descriptors[entries], entries, query, given, k))
        return stack(found, k)

    def close(self) -> None:
        """Let go of the maps."""
        self._descriptors = np.zeros((0, DIMENSIONS), dtype=np.float32)
        self._scan = Scan(encode(self._descriptors), np.zeros(1, np.int64), self._descriptors)
        self._entries = np.zeros(0, dtype=np.int32)

    def _near(self, query: Float, share: Float, n_scanned: int, k: int) -> Entries:
        """The entries of the rows most similar to a query, more than k, in no order."""
        ranked = min(_RANKED + _RANKED_PER_NEIGHBOUR * k, len(self))
        rows = self._scan.nearest(query, share, max(n_scanned, ranked), ranked)
        return self._entries[rows].astype(np.int64)


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
    shape = (n_blocks(len(descriptors)), DIMENSIONS, LANES)
    with TableWriter(directory / CODES_FILE, shape, np.int8) as table:
        for start in range(0, len(descriptors), _WRITE_BLOCK):
            table.append(encode(descriptors[cells.entries[start : start + _WRITE_BLOCK]]))
    report(1.0)
    return {"cells": len(cells.centres), "rows_per_cell": rows_per_cell}
