"""The index in Milvus, for libraries beyond one machine.

Milvus holds one row per exemplar: its entry as the primary key and its descriptor, 120 bytes in
all. Poses and cameras stay in the library's memory-mapped files, of which a replica needs all but
the descriptors and the local index (28 bytes an exemplar where 36 cameras see each pose); the
descriptors of what Milvus finds are computed from them again, for exact distances. A collection is
named after the library and the digest of its content, so that a new version is pushed beside the
old one and a replica never searches another library's. :mod:`library_store.milvus_push` fills it.

Reads have Bounded consistency: a library does not change once it is pushed.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from library_store.breaker import Breaker
from library_store.descriptor import Float, normalise
from library_store.errors import LibraryError
from library_store.hnsw import ef_for
from library_store.imputation import SAMPLE, guesses, n_guesses
from library_store.manifest import Manifest
from library_store.masked import nearest_masked
from library_store.neighbours import (
    SPARE,
    Descriptors,
    Entries,
    Neighbours,
    nearest_of,
    stack,
)

KEY, VECTOR = "entry", "descriptor"
CONSISTENCY = "Bounded"
INDEX = {
    "index_type": "HNSW",
    "metric_type": "L2",
    "params": {"M": 16, "efConstruction": 150},
}
LARGEST_LIMIT = 16_384
"""Most neighbours Milvus gives for a query."""

_PER_GUESS = 128  # neighbours of each guess of a masked query
_CHUNK = 8_192

Describe = Callable[[Entries], Descriptors]


@dataclass(frozen=True)
class MilvusSettings:
    """Where Milvus is and how long to wait for it.

    ``timeout_s``: a search, with the client's own retries (exponential backoff from 10 ms) within
    it; ``start_timeout_s``: until it must answer when the library is opened.
    """

    uri: str
    token: str = field(default="", repr=False)
    timeout_s: float = 1.0
    start_timeout_s: float = 60.0


class MilvusIndex:
    """Searches the collection of one library; see :func:`open_milvus`."""

    backend = "milvus"

    def __init__(
        self, client: Any, manifest: Manifest, settings: MilvusSettings, describe: Describe
    ) -> None:
        self._client = client
        self._collection = collection_name(manifest)
        self._n = manifest.n_exemplars
        self._timeout_s = settings.timeout_s
        self._describe = describe
        self._breaker = Breaker(f"Milvus at {settings.uri}")
        self._failures = failures()
        chosen = np.linspace(0, self._n - 1, min(self._n, SAMPLE)).astype(np.int64)
        self._sample = np.concatenate(
            [describe(chosen[at : at + _CHUNK]) for at in range(0, len(chosen), _CHUNK)]
        )

    def __len__(self) -> int:
        return self._n

    def query(self, descriptors: Descriptors, k: int) -> Neighbours:
        """The ``min(k, len)`` nearest entries of each descriptor (Q, 28), in one call."""
        queries = np.asarray(descriptors, dtype=np.float32)
        k = self._clamped(k)
        if not len(queries):
            return stack([], k)
        found = self._search(queries, min(k + SPARE, self._n), least=k)
        return stack(
            [
                nearest_of(self._describe(entries), entries, query, k)
                for query, entries in zip(queries, found, strict=True)
            ],
            k,
        )

    def query_masked(self, points: Float, weights: Float, k: int) -> Neighbours:
        """The same for 2D poses (Q, 14, 2) with weights (Q, 14), by the masked distance.

        All guesses of all queries are one call (:mod:`library_store.imputation`).
        """
        k = self._clamped(k)
        queries = normalise(points, weights)
        guessed = [
            guesses(self._sample, query, share, n_guesses(self._n, share))
            for query, share in zip(queries, weights, strict=True)
        ]
        if not guessed:
            return stack([], k)
        limit = min(max(k, _PER_GUESS) + SPARE, self._n)
        # A guess off the beaten track may reach fewer neighbours through the graph than others.
        found = iter(self._search(np.concatenate(guessed), limit, least=1))
        answers = []
        for query, share, own in zip(queries, weights, guessed, strict=True):
            entries = np.unique(np.concatenate([next(found) for _ in own]))
            if len(entries) < k:
                raise self._breaker.refusal(f"found {len(entries)} instead of {k} exemplars")
            table = self._describe(entries)
            answers.append(nearest_masked(table, entries, query, share, k))
        return stack(answers, k)

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def _clamped(self, k: int) -> int:
        if k > LARGEST_LIMIT - SPARE:
            raise ValueError(f"Milvus gives at most {LARGEST_LIMIT - SPARE} neighbours, not {k}")
        return min(k, self._n)

    def _search(self, queries: Descriptors, limit: int, *, least: int) -> list[Entries]:
        """At most ``limit`` nearest entries of each query (Q, 28), approximately.

        ``IndexUnavailableError`` when they are fewer than ``least``.
        """

        def work() -> list[Entries]:
            hits = self._client.search(
                self._collection,
                data=list(queries),
                anns_field=VECTOR,
                limit=limit,
                search_params={"params": {"ef": max(ef_for(self._n), limit)}},
                consistency_level=CONSISTENCY,
                timeout=self._timeout_s,
            )
            found = [np.asarray(one.ids, dtype=np.int64) for one in hits]
            if any(len(entries) < least for entries in found):
                # Milvus just started has no rows, or not all of them, yet.
                raise IncompleteError(f"{self._collection} is not wholly loaded")
            return found

        return self._breaker.call(work, self._failures)


class IncompleteError(Exception):
    """Milvus answered with fewer neighbours than there are."""


def open_milvus(manifest: Manifest, settings: MilvusSettings, describe: Describe) -> MilvusIndex:
    """Connect and check that the whole library is there.

    ``describe`` gives the descriptors of entries (n,). Waits ``start_timeout_s`` for a Milvus that
    is not there yet. Raises ``LibraryError``.
    """
    name = collection_name(manifest)
    deadline_s = time.monotonic() + settings.start_timeout_s
    pause_s = 0.2
    while True:
        client = None
        try:
            client = connect(settings)
            present = client.has_collection(name, timeout=settings.start_timeout_s)
            if present:
                client.load_collection(name, timeout=settings.start_timeout_s)
            n = count(client, name, settings.start_timeout_s) if present else 0
            break
        except failures() as error:
            if client is not None:
                client.close()
            if time.monotonic() + pause_s > deadline_s:
                raise LibraryError(
                    f"Milvus at {settings.uri} does not answer ({error}); start it, or search "
                    "locally with POSEMATCH_INDEX=auto"
                ) from error
            time.sleep(pause_s)
            pause_s = min(2.0 * pause_s, 5.0)
    if n != manifest.n_exemplars:
        client.close()
        raise LibraryError(
            f"Milvus at {settings.uri} holds {n} of the {manifest.n_exemplars} exemplars of "
            f"{manifest.name} (collection {name}); run `posematch library push`"
        )
    return MilvusIndex(client, manifest, settings, describe)


def connect(settings: MilvusSettings) -> Any:
    """A connected ``pymilvus.MilvusClient``; ``LibraryError`` without the extra ``milvus``.

    Clients of one server share a connection, which closing one of them leaves to the others (of
    pymilvus 2.6 it did not: a reload that was refused took it from the library in service).
    """
    try:
        from pymilvus import MilvusClient
    except ImportError:
        raise LibraryError(
            "a library in Milvus needs the package pymilvus: pip install 'posematch[milvus]'"
        ) from None
    # It logs every failure with a traceback; they are raised too, and ours to report.
    logging.getLogger("pymilvus").setLevel(logging.CRITICAL)
    return MilvusClient(
        uri=settings.uri,
        token=settings.token,
        timeout=settings.start_timeout_s,
        # Found again seconds after it comes back; by default that may take two minutes.
        grpc_options={"grpc.max_reconnect_backoff_ms": 2_000},
    )


def failures() -> tuple[type[Exception], ...]:
    """What pymilvus raises when Milvus is away or in trouble; ``LibraryError`` without it."""
    try:
        import grpc
        from pymilvus.exceptions import MilvusException
    except ImportError:
        raise LibraryError(
            "a library in Milvus needs the package pymilvus: pip install 'posematch[milvus]'"
        ) from None
    return MilvusException, grpc.RpcError, IncompleteError


def collection_name(manifest: Manifest) -> str:
    """The collection of a library: its name and the beginning of its content's digest."""
    safe = re.sub(r"[^A-Za-z0-9_]", "_", manifest.name)
    return f"posematch_{safe[:200]}_{manifest.sha256[:16]}"


def count(client: Any, collection: str, timeout_s: float, where: str = "") -> int:
    """How many entries a loaded collection holds, all writes up to now included."""
    rows = client.query(
        collection,
        filter=where,
        output_fields=["count(*)"],
        consistency_level="Strong",
        timeout=timeout_s,
    )
    return int(rows[0]["count(*)"])
