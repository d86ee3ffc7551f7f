from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store.cells import Cells, partition
from library_store.errors import LibraryError


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    rng = np.random.default_rng(3)
    middles = rng.normal(size=(40, 28)) * 3.0
    rows = middles[rng.integers(0, 40, 5_000)] + rng.normal(size=(5_000, 28))
    rows *= np.sqrt(14.0) / np.linalg.norm(rows, axis=1, keepdims=True)
    table: np.ndarray = rows.astype(np.float32)
    return table


def test_every_row_is_in_one_cell(table: np.ndarray) -> None:
    cells = partition(table, 50)
    assert_array_equal(np.sort(cells.entries), np.arange(len(table)))
    assert cells.sizes.sum() == len(table)
    assert len(cells.centres) == len(cells.sizes)
    assert 50 <= len(cells.sizes) <= 200


def test_cells_hold_near_rows(table: np.ndarray) -> None:
    cells = partition(table, 50)
    own = np.repeat(cells.centres, cells.sizes, axis=0)
    within = ((table[cells.entries] - own) ** 2).sum(1).mean()
    assert within < 0.3 * table.var(axis=0).sum()


def test_centres_are_as_long_as_rows(table: np.ndarray) -> None:
    cells = partition(table, 50)
    np.testing.assert_allclose(np.linalg.norm(cells.centres, axis=1), np.sqrt(14.0), rtol=1e-5)


def test_the_same_table_gives_the_same_cells(table: np.ndarray) -> None:
    first, second = partition(table, 50), partition(table.copy(), 50)
    assert_array_equal(first.entries, second.entries)
    assert_array_equal(first.starts, second.starts)


def test_progress_ends(table: np.ndarray) -> None:
    heard: list[float] = []
    partition(table, 50, heard.append)
    assert heard == sorted(heard)
    assert heard[-1] == 1.0


def test_there_and_back(table: np.ndarray, tmp_path: Path) -> None:
    cells = partition(table, 50)
    cells.save(tmp_path / "cells.npz")
    again = Cells.load(tmp_path / "cells.npz", cells.entries)
    assert_array_equal(again.starts, cells.starts)
    assert_array_equal(again.centres, cells.centres)
    with pytest.raises(LibraryError, match="does not partition 7 entries"):
        Cells.load(tmp_path / "cells.npz", cells.entries[:7])


@pytest.mark.parametrize("n", [0, 1, 7])
def test_tables_smaller_than_a_cell(n: int) -> None:
    cells = partition(np.ones((n, 28), dtype=np.float32), 50)
    assert cells.sizes.sum() == len(cells.entries) == n
