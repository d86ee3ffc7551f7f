"""Every index against the sorted distances, and against brute force where it is approximate."""

from __future__ import annotations

import resource
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.cell_index import CELL_FILES, CellIndex, ScanSettings, write_cells
from library_store.descriptor import describe, weighted_distance
from library_store.errors import LibraryError
from library_store.exact import ExactIndex
from library_store.hnsw import HNSW_FILE, HnswIndex, HnswSettings, ef_for, write_graph
from library_store.library import Library
from library_store.neighbours import Index
from library_store.skeleton import L_KNEE, R_WRIST

BACKENDS = ["exact", "cells", "hnsw"]
SCAN = ScanSettings(scanned=2_000, per_neighbour=0)
"""Scans a third of the small library, whose neighbours are far apart."""


@pytest.fixture(scope="module")
def table(small: Library) -> np.ndarray:
    return small.descriptors(np.arange(len(small)))


@pytest.fixture(scope="module")
def exact(table: np.ndarray) -> ExactIndex:
    return ExactIndex(table)


@pytest.fixture(scope="module")
def directory(table: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("indices")
    write_cells(directory, table, 20)
    write_graph(directory / HNSW_FILE, table, HnswSettings(threads=2))
    return directory


@pytest.fixture(scope="module")
def cells(directory: Path, table: np.ndarray) -> CellIndex:
    return CellIndex.load(directory, table, SCAN)


@pytest.fixture(scope="module")
def hnsw(directory: Path, table: np.ndarray, cells: CellIndex) -> HnswIndex:
    return HnswIndex.load(directory / HNSW_FILE, table, cells)


@pytest.fixture
def index(request: pytest.FixtureRequest) -> Index:
    chosen: Index = request.getfixturevalue(request.param)
    return chosen


@pytest.fixture(scope="module")
def queries(table: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(200, 28)) * 0.1
    return describe((table[::20] + noise).reshape(-1, 14, 2))


def masked(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The queries as poses, without a wrist and with an unsure knee."""
    weights = np.ones((len(queries), 14))
    weights[:, R_WRIST], weights[:, L_KNEE] = 0.0, 0.4
    return 300.0 + 90.0 * queries.reshape(-1, 14, 2).astype(np.float64), weights


def test_exact_is_the_sorted_distance_matrix(
    exact: ExactIndex, table: np.ndarray, queries: np.ndarray
) -> None:
    found = exact.query(queries[:20], 10)
    difference = queries[:20, None].astype(np.float64) - table.astype(np.float64)
    matrix = np.linalg.norm(difference, axis=-1)
    assert_array_equal(found.entries, np.argsort(matrix, axis=1)[:, :10])
    assert_allclose(found.distances, np.sort(matrix, axis=1)[:, :10])


def test_exact_is_the_sorted_masked_distance(
    exact: ExactIndex, table: np.ndarray, queries: np.ndarray
) -> None:
    points, weights = masked(queries[:5])
    found = exact.query_masked(points, weights, 25)
    for row in range(5):
        distances = weighted_distance(points[row], weights[row], table.reshape(-1, 14, 2))
        assert_array_equal(found.entries[row], np.argsort(distances, kind="stable")[:25])
        assert_allclose(found.distances[row], np.sort(distances)[:25])


@pytest.mark.parametrize("index", ["cells", "hnsw"], indirect=True)
def test_recall_at_10(index: Index, exact: ExactIndex, queries: np.ndarray) -> None:
    truth, found = exact.query(queries, 10).entries, index.query(queries, 10).entries
    recall = np.mean([len(np.intersect1d(a, b)) / 10 for a, b in zip(truth, found, strict=True)])
    assert recall >= 0.99


@pytest.mark.parametrize("index", BACKENDS, indirect=True)
def test_an_entry_is_nearest_to_itself(index: Index, table: np.ndarray) -> None:
    found = index.query(table[::37], 2)
    assert_array_equal(found.entries[:, 0], np.arange(len(table))[::37])
    assert_array_equal(found.distances[:, 0], 0.0)
    points, weights = masked(table[::37])
    assert_array_equal(index.query_masked(points, weights, 1).entries, found.entries[:, :1])


@pytest.mark.parametrize("index", BACKENDS, indirect=True)
def test_odd_requests(index: Index, table: np.ndarray) -> None:
    assert index.query(table[:0], 5).entries.shape == (0, 5)
    points, weights = masked(table[:1])
    assert index.query_masked(points[:0], weights[:0], 5).entries.shape == (0, 5)
    for everything in (
        index.query(table[:1], 10 * len(table)),
        index.query_masked(points, weights, 10 * len(table)),
    ):
        assert_array_equal(np.sort(everything.entries[0]), np.arange(len(table)))
        assert np.all(np.diff(everything.distances[0]) >= 0)


@pytest.mark.parametrize("index", BACKENDS, indirect=True)
def test_company_does_not_change_an_answer(index: Index, queries: np.ndarray) -> None:
    together = index.query(queries[:30], 10)
    points, weights = masked(queries[:30])
    masked_together = index.query_masked(points, weights, 10)
    for row in range(30):
        one = slice(row, row + 1)
        alone = index.query(queries[one], 10)
        assert_array_equal(alone.distances[0], together.distances[row])
        alone = index.query_masked(points[one], weights[one], 10)
        assert_array_equal(alone.entries[0], masked_together.entries[row])
        assert_array_equal(alone.distances[0], masked_together.distances[row])


@pytest.mark.parametrize("index", BACKENDS, indirect=True)
def test_threads_may_query_at_once(index: Index, queries: np.ndarray) -> None:
    queries = queries[:50]
    alone = index.query(queries, 10).entries
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: index.query(queries, 10).entries, range(8)):
            assert_array_equal(found, alone)


def test_cells_on_disk_answer_as_those_in_memory(
    cells: CellIndex, table: np.ndarray, queries: np.ndarray
) -> None:
    in_memory = CellIndex.build(table, 20, SCAN)
    assert_array_equal(in_memory.query(queries, 10).entries, cells.query(queries, 10).entries)


def test_cells_are_the_same_bytes_at_every_build(
    directory: Path, table: np.ndarray, tmp_path: Path
) -> None:
    write_cells(tmp_path, table, 20)
    for name in CELL_FILES:
        assert (tmp_path / name).read_bytes() == (directory / name).read_bytes()


def test_files_of_another_table_are_refused(
    directory: Path, table: np.ndarray, cells: CellIndex, tmp_path: Path
) -> None:
    with pytest.raises(LibraryError, match="10 exemplars"):
        CellIndex.load(directory, table[:10])
    with pytest.raises(LibraryError, match=r"index\.hnsw indexes 4000 exemplars instead of 10"):
        HnswIndex.load(directory / HNSW_FILE, table[:10], cells)
    cut = tmp_path / HNSW_FILE
    cut.write_bytes((directory / HNSW_FILE).read_bytes()[:100])
    with pytest.raises(LibraryError, match=r"index\.hnsw"):
        HnswIndex.load(cut, table, cells)


def test_a_graph_that_the_disk_does_not_take_is_an_error(table: np.ndarray, tmp_path: Path) -> None:
    """Files of more than 50 kB are refused, as on a full disk. hnswlib alone says nothing."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(OSError, match=r"bytes could not be written.*graph"):
            write_graph(tmp_path / "graph", table, HnswSettings(threads=1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def test_one_thread_builds_the_same_graph(table: np.ndarray, tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_graph(tmp_path / name, table[:1000], HnswSettings(threads=1))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert HnswSettings(threads=1).describe()["reproducible"]
    assert not HnswSettings(threads=2).describe()["reproducible"]


def test_effort_grows_with_library_and_mask() -> None:
    beams = [ef_for(n) for n in (1_000, 200_000, 600_000, 1_800_000)]
    assert beams == sorted(beams)
    settings = ScanSettings()
    sizes = [settings.n_scanned(n, None, 10) for n in (1_000, 200_000, 1_800_000)]
    assert sizes == sorted(sizes)
    assert sizes[0] == 1_000
    arm_gone = np.ones(14)
    arm_gone[[3, 4]] = 0.0
    assert settings.n_scanned(10**6, arm_gone, 10) > settings.n_scanned(10**6, None, 10)
