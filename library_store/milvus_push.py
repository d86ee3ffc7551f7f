"""Pushing a library into Milvus: batched, resumable, and the same however often it is run.

Entries go up in runs of ``BATCH``, one call each, keyed by entry. A push that was killed is run
again: runs that are wholly there are passed over, all others are written again, which replaces what
is there. At the end everything is counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from library_store.descriptor import DIMENSIONS
from library_store.errors import LibraryError
from library_store.manifest import Manifest, check_files, steadily
from library_store.milvus import (
    CONSISTENCY,
    INDEX,
    KEY,
    VECTOR,
    MilvusSettings,
    collection_name,
    connect,
    count,
    failures,
)
from library_store.neighbours import Descriptors
from library_store.tables import open_table

T = TypeVar("T")
Progress = Callable[[str, float], None]

BATCH = 10_000
"""Entries in one call: 1.2 MB."""

_TIMEOUT_S = 60.0
PATIENCE_S = 180.0
"""How long a call is tried again while Milvus is away: a restart takes less."""
_POLL_S = 1.0


@dataclass(frozen=True)
class Pushed:
    """What a push did: the collection, its entries, and how many of them were there before."""

    collection: str
    n_entries: int
    n_before: int


def push_library(
    directory: Path, settings: MilvusSettings, progress: Progress | None = None
) -> Pushed:
    """Bring the library in ``directory`` into Milvus, indexed and loaded.

    A call that fails is tried again with backoff; ``LibraryError`` when Milvus stays away, when
    the library is not whole, or when the count is wrong at the end.
    """
    report = progress or (lambda _stage, _fraction: None)

    def open_it(manifest: Manifest) -> tuple[str, Descriptors]:
        check_files(directory, manifest, sums=True)
        table = open_table(directory / "descriptors.npy").astype(np.float32, copy=False)
        return collection_name(manifest), table

    collection, table = steadily(directory, open_it)
    report("waiting for Milvus", 0.0)
    try:
        with closing(patiently(connect, settings)) as client:
            report("waiting for Milvus", 1.0)
            resumed = prepare(client, collection)
            n_before = write(
                client, collection, table, resumed, lambda done: report("descriptors", done)
            )
            finish(client, collection, len(table), lambda done: report("index", done))
    except failures() as error:
        raise LibraryError(
            f"Milvus at {settings.uri} does not answer ({error}); push again when it does: what "
            "is there is passed over"
        ) from error
    return Pushed(collection, len(table), n_before)


def prepare(client: Any, collection: str) -> bool:
    """Have an indexed and loaded collection; returns whether there was one already."""
    from pymilvus import DataType, MilvusClient

    resumed = bool(patiently(client.has_collection, collection, timeout=_TIMEOUT_S))
    if not resumed:
        schema = MilvusClient.create_schema(auto_id=False, enable_dynamic_field=False)
        schema.add_field(KEY, DataType.INT64, is_primary=True)
        schema.add_field(VECTOR, DataType.FLOAT_VECTOR, dim=DIMENSIONS)
        patiently(
            client.create_collection,
            collection,
            schema=schema,
            consistency_level=CONSISTENCY,
            timeout=_TIMEOUT_S,
        )
    index = client.prepare_index_params()
    index.add_index(field_name=VECTOR, **INDEX)
    patiently(client.create_index, collection, index, timeout=_TIMEOUT_S)
    patiently(client.load_collection, collection, timeout=_TIMEOUT_S)
    return resumed


def write(
    client: Any,
    collection: str,
    table: Descriptors,
    resumed: bool,
    progress: Callable[[float], None],
) -> int:
    """Write the runs that are not wholly there; returns how many entries were there before."""
    n_before = 0
    for start in range(0, len(table), BATCH):
        stop = min(start + BATCH, len(table))
        there = 0
        if resumed:
            where = f"{KEY} >= {start} and {KEY} < {stop}"
            there = patiently(count, client, collection, _TIMEOUT_S, where)
            n_before += there
        if there < stop - start:
            rows = [
                {KEY: entry, VECTOR: vector}
                for entry, vector in zip(range(start, stop), table[start:stop], strict=True)
            ]
            patiently(client.upsert, collection, rows, timeout=_TIMEOUT_S)
        progress(stop / len(table))
    return n_before


def finish(client: Any, collection: str, n: int, progress: Callable[[float], None]) -> None:
    """Have everything on disk, indexed and loaded, and count it."""
    patiently(client.flush, collection, timeout=_TIMEOUT_S)
    pending = n
    while pending:
        state = patiently(client.describe_index, collection, VECTOR, timeout=_TIMEOUT_S)
        pending, total = int(state["pending_index_rows"]), max(1, int(state["total_rows"]))
        progress(1.0 - min(pending, total) / total)
        if pending:
            time.sleep(_POLL_S)
    found = patiently(count, client, collection, _TIMEOUT_S)
    if found != n:
        raise LibraryError(
            f"Milvus counts {found} instead of {n} entries in {collection}; drop that collection "
            "and push again"
        )


def patiently(call: Callable[..., T], *arguments: Any, **named: Any) -> T:
    """The result of a call, tried again with backoff for a few minutes while Milvus is away."""
    deadline_s = time.monotonic() + PATIENCE_S
    pause_s = 0.5
    while True:
        try:
            return call(*arguments, **named)
        except failures():
            if time.monotonic() + pause_s > deadline_s:
                raise
            time.sleep(pause_s)
            pause_s = min(2.0 * pause_s, 10.0)
