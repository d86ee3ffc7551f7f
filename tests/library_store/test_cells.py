from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store.cells import partition


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    rng = np.random.default_rng(3)
    middles = rng.normal(size=(40, 28)) * 3.0
    rows = middles[rng.integers(0, 40, 5_000)] + rng.normal(size=(5_000, 28))
    return rows.astype(np.float32)


def test_every_row_is_in_one_cell(table: np.ndarray) -> None:
    cells = partition(table, 50)
    assert_array_equal(np.sort(cells.entries), np.arange(len(table)))
    assert_array_equal(cells.rows, table[cells.entries])
    assert cells.sizes.sum() == len(table)
    assert len(cells.centres) == len(cells.sizes)
    assert 50 <= len(cells.sizes) <= 200


def test_cells_hold_near_rows(table: np.ndarray) -> None:
    cells = partition(table, 50)
    own = np.repeat(cells.centres, cells.sizes, axis=0)
    within = ((cells.rows - own) ** 2).sum(1).mean()
    assert within < 0.2 * table.var(axis=0).sum()


def test_the_same_table_gives_the_same_cells(table: np.ndarray) -> None:
    first, second = partition(table, 50), partition(table.copy(), 50)
    assert_array_equal(first.entries, second.entries)
    assert_array_equal(first.starts, second.starts)


@pytest.mark.parametrize("n", [0, 1, 7])
def test_tables_smaller_than_a_cell(n: int) -> None:
    table = np.ones((n, 28), dtype=np.float32)
    cells = partition(table, 50)
    assert len(cells.rows) == cells.sizes.sum() == n
