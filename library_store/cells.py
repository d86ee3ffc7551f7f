"""Partition of descriptors into cells of near ones, by k-means in two levels.

The table is kept once more in the order of the cells, so that scanning a cell reads one run of
memory. Nothing is drawn at random: the same table gives the same cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.float32]
Labels = NDArray[np.int64]

_ROUNDS = 3
_SAMPLE_PER_COARSE, _SAMPLE_PER_FINE = 64, 16
"""Rows that place a centre; all rows are then assigned to the nearest centre."""
_BLOCK = 8_192  # rows whose distances to all centres stay in the second-level cache


@dataclass(frozen=True)
class Cells:
    """A partition of a table (N, D) into C cells.

    ``centres`` (C, D); ``rows`` (N, D), a copy of the table sorted by cell; ``entries`` (N,), which
    row of the table each is; cell c is ``rows[starts[c]:starts[c + 1]]``, ``starts`` (C + 1,).
    """

    centres: Rows
    rows: Rows
    entries: Labels
    starts: Labels

    @property
    def sizes(self) -> Labels:
        """How many rows each cell holds, (C,)."""
        return np.diff(self.starts)


def partition(table: Rows, rows_per_cell: int) -> Cells:
    """Cells of ``rows_per_cell`` rows on average over a table (N, D)."""
    n_cells = max(1, round(len(table) / rows_per_cell))
    n_coarse = max(1, round(np.sqrt(2.0 * n_cells)))
    coarse = _assign(table, _centres(table, n_coarse, _SAMPLE_PER_COARSE))
    order = np.argsort(coarse, kind="stable")
    centres, fine = [], np.empty(len(table), dtype=np.int64)
    n = 0
    for members in np.split(order, np.cumsum(np.bincount(coarse, minlength=n_coarse))[:-1]):
        if len(members):
            rows = table[members]
            share = max(1, round(n_cells * len(members) / len(table)))
            centres.append(_centres(rows, share, _SAMPLE_PER_FINE))
            fine[members] = n + _assign(rows, centres[-1])
            n += len(centres[-1])
    entries = np.argsort(fine, kind="stable")
    return Cells(
        centres=np.concatenate(centres) if centres else table[:0],
        rows=table[entries],
        entries=entries,
        starts=np.searchsorted(fine[entries], np.arange(n + 1)),
    )


def _centres(rows: Rows, n: int, sample_per_centre: int) -> Rows:
    """At most n centres (n, D) by Lloyd's iteration on an even sample of the rows."""
    sample = rows[:: max(1, len(rows) // (n * sample_per_centre))]
    n = min(n, len(sample))
    centres = sample[np.linspace(0, len(sample) - 1, n).astype(np.int64)]
    for _ in range(_ROUNDS):
        member = (_assign(sample, centres)[:, None] == np.arange(n)).astype(np.float32)
        count = member.sum(axis=0)[:, None]
        centres = np.where(count > 0, member.T @ sample / np.maximum(count, 1.0), centres)
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
