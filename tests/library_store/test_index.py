from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from library_store.descriptor import describe
from library_store.errors import LibraryError
from library_store.index import ExactIndex, HnswIndex, HnswSettings, Index, ef_for
from library_store.library import Library


@pytest.fixture(scope="module")
def table(small: Library) -> np.ndarray:
    return small.descriptors(np.arange(len(small)))


@pytest.fixture(scope="module")
def exact(table: np.ndarray) -> ExactIndex:
    return ExactIndex(table)


@pytest.fixture(scope="module")
def graph(table: np.ndarray) -> HnswIndex:
    return HnswIndex.build(table, HnswSettings(threads=2))


@pytest.fixture(scope="module")
def queries(table: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(200, 28)) * 0.1
    return describe((table[::20] + noise).reshape(-1, 14, 2))


def test_exact_is_the_sorted_distance_matrix(
    exact: ExactIndex, table: np.ndarray, queries: np.ndarray
) -> None:
    found = exact.query(queries[:20], 10)
    difference = queries[:20, None].astype(np.float64) - table.astype(np.float64)
    matrix = np.linalg.norm(difference, axis=-1)
    assert_array_equal(found.entries, np.argsort(matrix, axis=1)[:, :10])
    assert_allclose(found.distances, np.sort(matrix, axis=1)[:, :10])


def test_hnsw_recall_at_10(exact: ExactIndex, graph: HnswIndex, queries: np.ndarray) -> None:
    truth, found = exact.query(queries, 10).entries, graph.query(queries, 10).entries
    recall = np.mean([len(np.intersect1d(a, b)) / 10 for a, b in zip(truth, found, strict=True)])
    assert recall >= 0.97


@pytest.mark.parametrize("backend", ["exact", "graph"])
def test_an_entry_is_nearest_to_itself(
    backend: str, request: pytest.FixtureRequest, table: np.ndarray
) -> None:
    index: Index = request.getfixturevalue(backend)
    found = index.query(table[::37], 2)
    assert_array_equal(found.entries[:, 0], np.arange(len(table))[::37])
    assert_array_equal(found.distances[:, 0], 0.0)


@pytest.mark.parametrize("backend", ["exact", "graph"])
def test_odd_requests(backend: str, request: pytest.FixtureRequest, table: np.ndarray) -> None:
    index: Index = request.getfixturevalue(backend)
    assert index.query(table[:0], 5).entries.shape == (0, 5)
    everything = index.query(table[:1], 10 * len(table))
    assert_array_equal(np.sort(everything.entries[0]), np.arange(len(table)))
    assert np.all(np.diff(everything.distances[0]) >= 0)


def test_a_saved_graph_answers_alike(
    graph: HnswIndex, table: np.ndarray, queries: np.ndarray, tmp_path: Path
) -> None:
    graph.save(tmp_path / "index.hnsw")
    again = HnswIndex.load(tmp_path / "index.hnsw", table)
    assert_array_equal(again.query(queries, 10).entries, graph.query(queries, 10).entries)


def test_a_graph_of_another_table_is_refused(
    graph: HnswIndex, table: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "index.hnsw"
    graph.save(path)
    with pytest.raises(LibraryError, match=r"index\.hnsw indexes 4000 exemplars instead of 10"):
        HnswIndex.load(path, table[:10])
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(LibraryError, match=r"index\.hnsw"):
        HnswIndex.load(path, table)


def test_one_thread_builds_the_same_bytes(table: np.ndarray, tmp_path: Path) -> None:
    for name in ("one", "two"):
        HnswIndex.build(table[:1000], HnswSettings(threads=1)).save(tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert HnswSettings(threads=1).describe()["reproducible"]
    assert not HnswSettings(threads=2).describe()["reproducible"]


def test_threads_may_query_at_once(graph: HnswIndex, queries: np.ndarray) -> None:
    alone = graph.query(queries, 10).entries
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: graph.query(queries, 10).entries, range(16)):
            assert_array_equal(found, alone)


def test_the_beam_widens_with_the_library() -> None:
    widths = [ef_for(n) for n in (1_000, 200_000, 600_000, 1_800_000)]
    assert widths == sorted(widths)
    assert widths[1] >= 64
