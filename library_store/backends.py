"""Which index answers: building the files of a library's own, and opening the one wanted.

========  ==========================================================================================
cells     k-means cells, of which the nearest are scanned; every library has them, the default
exact     every entry for every query
hnsw      a graph, where the library was built with one
milvus    a Milvus server, where the library was pushed to it
========  ==========================================================================================

``auto`` is the one that the library was built for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from library_store.cell_index import CELL_FILES, ROWS_PER_CELL, CellIndex, write_cells
from library_store.errors import LibraryError
from library_store.exact import ExactIndex
from library_store.hnsw import HNSW_FILE, HnswIndex, HnswSettings, write_graph
from library_store.manifest import CONTENT_FILES, Manifest
from library_store.milvus import Describe, MilvusSettings, open_milvus
from library_store.neighbours import Descriptors, Index

Backend = Literal["auto", "cells", "exact", "hnsw", "milvus"]

DESCRIPTORS_FILE = "descriptors.npy"

GRAPH_UP_TO = 1_000_000
"""Exemplars for which a graph is built unless told otherwise: beyond, the cells answer as soon, and
a graph takes them ten times as long to build."""


@dataclass(frozen=True)
class IndexSettings:
    """What a library's index is built with: a graph, and the cells that masked queries need."""

    rows_per_cell: int = ROWS_PER_CELL
    hnsw: HnswSettings | None = field(default_factory=HnswSettings)

    @property
    def files(self) -> tuple[str, ...]:
        """The files it is made of."""
        return (*CELL_FILES, HNSW_FILE) if self.hnsw else CELL_FILES


def index_settings(n: int, graph: bool | None = None) -> IndexSettings:
    """What ``n`` exemplars are indexed with: with a ``graph`` or not, ``None`` as their number.

    Beyond 1.8 million cells grow with the root of the number, for every query ranks them all.
    """
    rows_per_cell = round(ROWS_PER_CELL * max(1.0, n / 1_800_000.0) ** 0.5)
    wanted = n <= GRAPH_UP_TO if graph is None else graph
    return IndexSettings(rows_per_cell, hnsw=HnswSettings() if wanted else None)


def write_index(
    directory: Path,
    descriptors: Descriptors,
    settings: IndexSettings,
    progress: Callable[[float], None],
) -> dict[str, Any]:
    """Write the index's files over descriptors (E, 28); returns what the manifest says of it."""
    share = 0.1 if settings.hnsw else 1.0
    facts: dict[str, Any] = {"backend": CellIndex.backend, "files": list(settings.files)}
    facts |= write_cells(
        directory, descriptors, settings.rows_per_cell, lambda done: progress(share * done)
    )
    if settings.hnsw:
        write_graph(
            directory / HNSW_FILE,
            descriptors,
            settings.hnsw,
            lambda done: progress(share + (1.0 - share) * done),
        )
        facts |= {"backend": HnswIndex.backend, "hnsw": settings.hnsw.describe()}
    return facts


def resolve(backend: Backend, manifest: Manifest) -> Backend:
    """The backend meant by ``backend``; ``LibraryError`` when the library does not have it."""
    built: Mapping[str, Any] = manifest.index
    if backend == "auto":
        chosen: Backend = built["backend"]
        return chosen
    if backend == "hnsw" and HNSW_FILE not in manifest.files:
        raise LibraryError(
            f"the library {manifest.name} has no HNSW graph; build it without "
            "--no-hnsw, or serve it with POSEMATCH_INDEX=auto"
        )
    return backend


def needed_files(backend: Backend) -> tuple[str, ...]:
    """The files a library must have for a (resolved) backend; others may be left away."""
    if backend == "milvus":
        return tuple(name for name in CONTENT_FILES if name != DESCRIPTORS_FILE)
    if backend == "exact":
        return CONTENT_FILES
    return (*CONTENT_FILES, *CELL_FILES, *([HNSW_FILE] if backend == "hnsw" else []))


def open_index(
    backend: Backend,
    directory: Path,
    manifest: Manifest,
    *,
    descriptors: Descriptors | None,
    describe: Describe,
    milvus: MilvusSettings | None,
) -> Index:
    """Open the index for a (resolved) backend.

    ``descriptors`` (E, 28) is the table, which only Milvus does without; ``describe`` computes the
    descriptors of entries (n,). Raises ``LibraryError``.
    """
    if backend == "milvus":
        if milvus is None:
            raise LibraryError("the index is in Milvus: set POSEMATCH_MILVUS_URI")
        return open_milvus(manifest, milvus, describe)
    assert descriptors is not None
    if backend == "exact":
        return ExactIndex(descriptors)
    cells = CellIndex.load(directory, descriptors)
    if backend == "hnsw":
        return HnswIndex.load(directory / HNSW_FILE, descriptors, cells)
    return cells
