"""One prior and one small library, built once, for all tests of the library."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from library_store.backends import IndexSettings
from library_store.build import BuildSettings, build_library
from library_store.hnsw import HnswSettings
from library_store.library import Library, load
from library_store.prior import PosePrior

ONE_THREAD = IndexSettings(hnsw=HnswSettings(threads=1))
"""Of several threads, no two graphs are the same."""
SMALL = BuildSettings(name="small", n_poses=4_000, seed=7, index=ONE_THREAD)


@pytest.fixture(scope="session")
def prior() -> PosePrior:
    return PosePrior.load()


@pytest.fixture(scope="session")
def small_directory(prior: PosePrior, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("libraries") / "small"
    build_library(directory, prior, SMALL)
    return directory


@pytest.fixture(scope="session")
def small(small_directory: Path) -> Iterator[Library]:
    library = load(small_directory)
    yield library
    library.close()
