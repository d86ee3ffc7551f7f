"""Which index answers: what a library was built for, and what is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from library_store.backends import (
    DESCRIPTORS_FILE,
    GRAPH_UP_TO,
    Backend,
    IndexSettings,
    index_settings,
)
from library_store.build import BuildSettings, build_library, verify_library
from library_store.errors import LibraryError
from library_store.hnsw import HNSW_FILE, HnswSettings
from library_store.library import load
from library_store.manifest import MANIFEST
from library_store.prior import PosePrior

WITH_GRAPH = BuildSettings(
    name="graph", n_poses=500, index=IndexSettings(hnsw=HnswSettings(threads=1))
)


@pytest.fixture(scope="module")
def graph_directory(prior: PosePrior, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("backends") / "graph"
    build_library(directory, prior, WITH_GRAPH)
    return directory


def test_a_library_built_with_a_graph_is_searched_with_it(graph_directory: Path) -> None:
    manifest = verify_library(graph_directory)
    assert manifest.index["backend"] == "hnsw"
    assert HNSW_FILE in manifest.index["files"]
    seen = np.load(graph_directory / DESCRIPTORS_FILE)[:20].reshape(20, 14, 2)
    queries = seen + np.random.default_rng(1).normal(0.0, 0.05, seen.shape)
    weights = np.ones((20, 14))
    weights[::2, 4] = 0.0
    truth = load(graph_directory, backend="exact").match(queries, weights, 5)
    backends: list[Backend] = ["auto", "hnsw", "cells"]
    for backend in backends:
        library = load(graph_directory, backend=backend)
        assert library.index_backend == ("hnsw" if backend == "auto" else backend)
        assert_array_equal(library.match(queries, weights, 5).entries, truth.entries)
        library.close()


def test_files_that_are_not_needed_may_be_damaged(graph_directory: Path, prior: PosePrior) -> None:
    damaged = graph_directory.parent / "damaged"
    build_library(damaged, prior, WITH_GRAPH)
    (damaged / HNSW_FILE).write_bytes(b"cut")
    load(damaged, backend="exact").close()
    load(damaged, backend="cells").close()
    with pytest.raises(LibraryError, match=r"index\.hnsw"):
        load(damaged)


def test_a_graph_that_was_not_built_is_not_searched(prior: PosePrior, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    without = IndexSettings(hnsw=None)
    manifest = build_library(plain, prior, BuildSettings(name="plain", n_poses=200, index=without))
    assert HNSW_FILE not in manifest.files
    load(plain).close()
    with pytest.raises(LibraryError, match=r"--no-hnsw.*POSEMATCH_INDEX=auto"):
        load(plain, backend="hnsw")


def test_a_graph_is_built_where_it_is_worth_it() -> None:
    assert index_settings(200_000).hnsw == index_settings(GRAPH_UP_TO).hnsw == HnswSettings()
    assert index_settings(GRAPH_UP_TO + 1).hnsw is None
    assert index_settings(GRAPH_UP_TO + 1, graph=True).hnsw == HnswSettings()
    assert index_settings(1, graph=False).hnsw is None


def test_cells_grow_only_in_very_large_libraries() -> None:
    assert index_settings(1_800_000).rows_per_cell == index_settings(1).rows_per_cell == 100
    assert index_settings(64_800_000).rows_per_cell == 600


def test_milvus_must_be_somewhere(small_directory: Path) -> None:
    with pytest.raises(LibraryError, match="POSEMATCH_MILVUS_URI"):
        load(small_directory, backend="milvus")


def test_a_library_of_another_version_is_to_be_built_again(
    prior: PosePrior, tmp_path: Path
) -> None:
    settings = BuildSettings(name="older", n_poses=50)
    build_library(tmp_path / "older", prior, settings)
    path = tmp_path / "older" / MANIFEST
    path.write_text(path.read_text().replace('"format": 4', '"format": 3'))
    with pytest.raises(LibraryError, match=r"another version.*format 3.*posematch library build"):
        load(tmp_path / "older")
    build_library(tmp_path / "older", prior, settings)
    load(tmp_path / "older").close()
