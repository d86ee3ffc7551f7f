"""The compiled scan against the same sums in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store.cells import Cells, partition
from library_store.descriptor import N_JOINTS, normalise
from library_store.errors import LibraryError
from library_store.library import Library
from library_store.masked import Correlation
from library_store.scan import LANES, Scan, encode, n_blocks

EQUAL = np.full(N_JOINTS, 1.0 / N_JOINTS)
WITHOUT_LEGS = np.where(np.isin(np.arange(N_JOINTS), [9, 10, 12, 13]), 0.0, 0.1)
UNSURE = np.linspace(1.0, 2.0, N_JOINTS) / 21.0


@pytest.fixture(scope="module")
def cells(small: Library) -> Cells:
    return partition(small.descriptors(np.arange(len(small))), 30)


@pytest.fixture(scope="module")
def rows(small: Library, cells: Cells) -> np.ndarray:
    """Descriptors in the order of the cells."""
    return small.descriptors(cells.entries)


@pytest.fixture(scope="module")
def scan(cells: Cells, rows: np.ndarray) -> Scan:
    return Scan(encode(rows), cells.starts, cells.centres)


@pytest.fixture(scope="module")
def queries(rows: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(4).normal(size=(20, N_JOINTS, 2)) * 0.1
    return rows[::200].reshape(-1, N_JOINTS, 2)[:20] + noise


def test_sixteen_rows_lie_side_by_side(rows: np.ndarray) -> None:
    codes = encode(rows[:21])
    assert codes.shape == (2, 28, LANES)
    for row in (0, 15, 16, 20):
        np.testing.assert_allclose(
            codes[row // LANES, :, row % LANES] / 42.0, rows[row], atol=0.012
        )
    assert_array_equal(codes[1, :, 5:], 0)
    assert encode(np.array([[9.0, -9.0] * 14], dtype=np.float32))[0, :2, 0].tolist() == [127, -127]


@pytest.mark.parametrize("portable", [False, True])
@pytest.mark.parametrize("share", [EQUAL, WITHOUT_LEGS, UNSURE])
def test_all_rows_are_ranked_as_in_numpy(
    share: np.ndarray, portable: bool, scan: Scan, rows: np.ndarray, queries: np.ndarray
) -> None:
    for query in normalise(queries, np.tile(share, (len(queries), 1))):
        found = scan.nearest(query, share, len(scan), 60, portable=portable)
        assert len(np.unique(found)) == 60
        similarity = Correlation(query, share)(rows)
        # But for what is rounded: the best 30 are among the 60, and none of these is far off.
        assert np.isin(np.argsort(-similarity)[:30], found).all()
        assert similarity[found].min() > np.sort(similarity)[-60] - 0.01


@pytest.mark.parametrize("share", [EQUAL, WITHOUT_LEGS])
def test_this_cpu_and_any_find_the_same(share: np.ndarray, scan: Scan, queries: np.ndarray) -> None:
    for query in normalise(queries, np.tile(share, (len(queries), 1))):
        here = scan.nearest(query, share, 1_000, 50)
        anywhere = scan.nearest(query, share, 1_000, 50, portable=True)
        # The last bits of their sums differ.
        assert len(np.intersect1d(here, anywhere)) >= 49


@pytest.mark.parametrize("n_scanned", [1, 200, 1_000])
def test_only_the_nearest_cells_are_scanned(
    n_scanned: int, scan: Scan, cells: Cells, queries: np.ndarray
) -> None:
    query = normalise(queries)[7]
    found = scan.nearest(query, EQUAL, n_scanned, len(scan))
    assert n_scanned <= len(found) < len(scan)
    order = np.argsort(-Correlation(query, EQUAL)(cells.centres))
    # Blocks hold the ends of neighbouring cells too, and centres are rounded.
    needed = np.searchsorted(np.cumsum(cells.sizes[order]), n_scanned) + 1
    for cell in order[: max(1, needed - 3)]:
        assert np.isin(np.arange(cells.starts[cell], cells.starts[cell + 1]), found).all()
    assert len(found) < n_scanned + (needed + 3) * 2 * LANES + 5 * cells.sizes.max()


def test_what_has_no_weight_is_not_read(scan: Scan, queries: np.ndarray) -> None:
    query = normalise(queries[3], WITHOUT_LEGS)
    other = np.where(WITHOUT_LEGS[:, None] > 0, query, 1e6)
    expected = scan.nearest(query, WITHOUT_LEGS, 500, 20)
    assert_array_equal(scan.nearest(other, WITHOUT_LEGS, 500, 20), expected)


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17])
def test_small_tables(n: int, rows: np.ndarray) -> None:
    cells = partition(rows[:n], 4)
    scan = Scan(encode(rows[cells.entries]), cells.starts, cells.centres)
    query = rows[0].reshape(N_JOINTS, 2).astype(np.float64)
    assert_array_equal(np.sort(scan.nearest(query, EQUAL, 100, 40)), np.arange(n))


def test_tables_that_do_not_fit_are_refused(cells: Cells, rows: np.ndarray) -> None:
    codes = encode(rows)
    assert len(codes) == n_blocks(len(rows))
    swapped = cells.starts.copy()
    swapped[[3, 4]] = swapped[[4, 3]]
    for wrong in (
        (codes[:-1], cells.starts, cells.centres),
        (codes, cells.starts, cells.centres[:-1]),
        (codes, swapped, cells.centres),
        (codes.astype(np.int16), cells.starts, cells.centres),
        (np.asfortranarray(codes), cells.starts, cells.centres),
        (codes, cells.starts.astype(np.int32), cells.centres),
    ):
        with pytest.raises(LibraryError, match="do not partition"):
            Scan(*wrong)
