"""Partition of descriptors into cells of near ones, by k-means in two levels.

The table is cut into groups and each group into cells, so that the cells near a query are found by
way of the groups near it. Nothing is drawn at random and one machine always gives the same cells;
another machine's linear algebra may round a row into the neighbouring cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from library_store.errors import LibraryError
from library_store.neighbours import Similarity, largest

Rows = NDArray[np.float32]
Labels = NDArray[np.int64]

_ROUNDS = 8
_SAMPLE_PER_GROUP, _SAMPLE_PER_CELL = 100, 40
"""Rows that place a centre; all rows are then assigned to the nearest centre."""
_BLOCK = 8_192  # rows whose distances to all centres stay in the second-level cache
_GROUP_REACH = 16
"""Groups are looked into until they hold so many times the rows that are wanted: with that, the
groups cost less than 1 in 1000 of the neighbours, complete or masked, at 200,000 and 1.8 million
entries."""


@dataclass(frozen=True)
class Cells:
    """A partition of a table (N, D) into C cells in G groups.

    ``entries`` (N,) int32 are the table's rows in the order of the cells: cell c is
    ``entries[starts[c]:starts[c + 1]]`` about ``centres[c]`` (C, D), group g the cells
    ``group_starts[g]`` to ``group_starts[g + 1]`` about ``group_centres[g]`` (G, D). Centres have
    the length of the rows, so that they compare as rows do.
    """

    entries: NDArray[np.int32]
    starts: Labels
    centres: Rows
    group_starts: Labels
    group_centres: Rows

    @property
    def sizes(self) -> Labels:
        """How many rows each cell holds, (C,)."""
        return np.diff(self.starts)

    def near(self, similarity: Similarity, n_rows: int) -> Labels:
        """The cells nearest to a query that together hold ``n_rows`` rows, in ascending order."""
        held = np.diff(self.starts[self.group_starts])
        groups = _nearest(similarity(self.group_centres), held, _GROUP_REACH * n_rows)
        if len(groups) == len(self.group_centres):
            cells = _nearest(similarity(self.centres), self.sizes, n_rows)
        else:
            groups.sort()
            spans = list(
                zip(
                    self.group_starts[groups].tolist(),
                    self.group_starts[groups + 1].tolist(),
                    strict=True,
                )
            )
            candidates = np.concatenate([np.arange(start, end) for start, end in spans])
            centres = np.concatenate([self.centres[start:end] for start, end in spans])
            sizes = self.starts[candidates + 1] - self.starts[candidates]
            cells = candidates[_nearest(similarity(centres), sizes, n_rows)]
        cells.sort()
        return cells

    def save(self, path: Path) -> None:
        """Write all but ``entries`` to ``path``, an npz file."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        del arrays["entries"]
        np.savez(path, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path, entries: NDArray[np.int32]) -> Cells:
        """Read what :meth:`save` wrote; ``LibraryError`` when it does not partition ``entries``."""
        with np.load(path, allow_pickle=False) as arrays:
            cells = cls(entries=entries, **{name: arrays[name] for name in arrays.files})
        if cells.starts[-1] != len(entries) or cells.group_starts[-1] != len(cells.centres):
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
    centres, sizes, cells_in = [table[:0]], [np.zeros(0, np.int64)], []
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
        cells_in.append(len(placed))
        if progress is not None:
            progress(end / len(table))
    return Cells(
        entries=order,
        starts=np.concatenate([[0], np.cumsum(np.concatenate(sizes))]),
        centres=_lengthened(np.concatenate(centres), table),
        group_starts=np.concatenate([[0], np.cumsum(cells_in, dtype=np.int64)]),
        group_centres=_lengthened(groups, table),
    )


def _nearest(similarity: NDArray[np.float32], sizes: Labels, n_rows: int) -> Labels:
    """The most similar of some sets that together hold ``n_rows`` rows, nearest first."""
    # Sorting them all would take longer than ranking them.
    share = n_rows / max(1, int(sizes.sum()))
    order = largest(similarity, int(2.0 * share * len(sizes)) + 8)
    order = order[np.argsort(-similarity[order])]
    held = np.cumsum(sizes[order])
    if held[-1] < n_rows and len(order) < len(sizes):
        order = np.argsort(-similarity)
        held = np.cumsum(sizes[order])
    return order[: np.searchsorted(held, n_rows) + 1]


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
