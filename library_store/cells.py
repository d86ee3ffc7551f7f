"""Partition of descriptors into cells of near ones, by k-means in two levels.

The table is cut into groups and each group into cells, which is quicker than at once. Nothing is
drawn at random and one machine always gives the same cells; another machine's linear algebra may
round a row into the neighbouring cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.errors import LibraryError

Rows = NDArray[np.float32]
Labels = NDArray[np.int64]

_ROUNDS = 8
_SAMPLE_PER_GROUP, _SAMPLE_PER_CELL = 100, 40
"""Rows that place a centre; all rows are then assigned to the nearest centre."""
_BLOCK = 8_192  # rows whose distances to all centres stay in the second-level cache


@dataclass(frozen=True)
class Cells:
    """A partition of a table (N, D) into C cells.

    ``entries`` (N,) int32 are the table's rows in the order of the cells: cell c is
    ``entries[starts[c]:starts[c + 1]]`` about ``centres[c]`` (C, D). Centres have the length of the
    rows, so that they compare as rows do.
    """

    entries: NDArray[np.int32]
    starts: Labels
    centres: Rows

    @property
    def sizes(self) -> Labels:
        """How many rows each cell holds, (C,)."""
        return np.diff(self.starts)

    def save(self, path: Path) -> None:
        """Write all but ``entries`` to ``path``, an npz file."""
        np.savez(path, allow_pickle=False, starts=self.starts, centres=self.centres)

    @classmethod
    def load(cls, path: Path, entries: NDArray[np.int32]) -> Cells:
        """Read what :meth:`save` wrote; ``LibraryError`` when it does not partition ``entries``."""
        with np.load(path, allow_pickle=False) as arrays:
            cells = cls(entries=entries, starts=arrays["starts"], centres=arrays["centres"])
        if cells.starts[-1] != len(entries):
            raise LibraryError(f"{path} does not partition {len(entries)} entries")
        return cells


def partition(
    table: Rows, rows_per_cell: int, progress: Callable[[float], None] | None = None
) -> Cells:
    """Cells of ``rows_per_cell`` rows on average; ``progress`` hears the fraction done."""
    n_cells = max(1, round(len(table) / rows_per_cell))
    n_groups = max(1, round(np.sqrt(2.0 * n_cells)))
    groups = _centres(table, n_groups, _SAMPLE_PER_GROUP)
    group_of = _assign(table, groups)
    order = np.argsort(group_of, kind="stable").astype(np.int32)
    ends = [0, *np.cumsum(np.bincount(group_of, minlength=len(groups))).tolist()]
    centres, sizes = [table[:0]], [np.zeros(0, np.int64)]
    for start, end in pairwise(ends):
        # Ascending, so that a table on disk is read from front to back.
        members = order[start:end]
        rows = table[members]
        share = max(1, round(n_cells * len(rows) / len(table))) if len(rows) else 0
        placed = _centres(rows, share, _SAMPLE_PER_CELL)
        cell_of = _assign(rows, placed)
        order[start:end] = members[np.argsort(cell_of, kind="stable")]
        centres.append(placed)
        sizes.append(np.bincount(cell_of, minlength=len(placed)))
        if progress is not None:
            progress(end / len(table))
    return Cells(
        entries=order,
        starts=np.concatenate([[0], np.cumsum(np.concatenate(sizes))]),
        centres=_lengthened(np.concatenate(centres), table),
    )


def _lengthened(centres: Rows, rows: Rows) -> Rows:
    """Centres of the length that all rows have."""
    length = np.linalg.norm(rows[:1])
    factors = length / np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-12)
    longer: Rows = (centres * factors).astype(np.float32)
    return longer


def _centres(rows: Rows, n: int, sample_per_centre: int) -> Rows:
    """At most n centres (n, D) by Lloyd's iteration on an even sample of the rows."""
    n = min(n, len(rows))
    if n == 0:
        return rows[:0]
    sample = rows[:: max(1, len(rows) // (n * sample_per_centre))]
    centres = sample[np.linspace(0, len(sample) - 1, n).astype(np.int64)]
    for _ in range(_ROUNDS):
        nearest = _assign(sample, centres)
        order = np.argsort(nearest, kind="stable")
        taken, first = np.unique(nearest[order], return_index=True)
        sums = np.add.reduceat(sample[order], first, axis=0, dtype=np.float64)
        centres[taken] = sums / np.diff([*first, len(sample)])[:, None]
    return centres


def _assign(rows: Rows, centres: Rows) -> Labels:
    """The nearest centre of each row, (N,)."""
    half_squares = 0.5 * (centres * centres).sum(axis=1)
    nearest = np.empty(len(rows), dtype=np.int64)
    for start in range(0, len(rows), _BLOCK):
        nearness = rows[start : start + _BLOCK] @ centres.T
        nearness -= half_squares
        nearest[start : start + _BLOCK] = nearness.argmax(axis=1)
    return nearest
