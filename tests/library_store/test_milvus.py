"""The index in Milvus, against a real server: pushing, searching, and what happens when it is away.

The tests run in order: the library is pushed first and the server is killed at the end.
"""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pymilvus.exceptions import MilvusException

from library_store import milvus, milvus_push
from library_store.errors import IndexUnavailableError, LibraryError
from library_store.library import Library, load
from library_store.manifest import read_manifest
from library_store.milvus import MilvusSettings, collection_name, connect
from library_store.milvus_push import push_library
from tests.app.server import COMMAND, Server, environment, free_port
from tests.library_store.milvus_server import CannotInstallError, MilvusServer
from tests.library_store.test_masked import MASKS, noisy_queries, weights_without

EXAMPLE = Path(__file__).parents[2] / "app" / "examples" / "lift_request.json"
NOT_NEEDED = (
    "descriptors.npy",
    "index.cells.npz",
    "index.codes.npy",
    "index.entries.npy",
)


def nowhere(start_timeout_s: float = 0.3) -> MilvusSettings:
    return MilvusSettings(f"http://127.0.0.1:{free_port()}", start_timeout_s=start_timeout_s)


def test_a_server_that_is_not_there_is_named(small_directory: Path) -> None:
    with pytest.raises(LibraryError, match=r"127\.0\.0\.1.* does not answer.*POSEMATCH_INDEX=auto"):
        load(small_directory, backend="milvus", milvus=nowhere())


class Fleeting:
    """A client whose Milvus goes away as soon as it is asked something."""

    open = 0

    def __init__(self, _: MilvusSettings) -> None:
        Fleeting.open += 1

    def has_collection(self, name: str, timeout: float) -> bool:
        del timeout
        raise MilvusException(message=f"gone before {name}")

    def close(self) -> None:
        Fleeting.open -= 1


def test_every_client_that_was_opened_in_vain_is_closed(
    small_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(milvus, "connect", Fleeting)
    with pytest.raises(LibraryError, match=r"does not answer .*gone before posematch_small"):
        load(small_directory, backend="milvus", milvus=nowhere(0.5))
    assert Fleeting.open == 0


def test_a_push_to_nowhere_ends(small_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(milvus_push, "PATIENCE_S", 0.5)
    with pytest.raises(LibraryError, match=r"does not answer.*push again"):
        push_library(small_directory, nowhere())


def test_a_push_says_where_to(small_directory: Path) -> None:
    done = subprocess.run(
        [COMMAND, "library", "push", small_directory],
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "POSEMATCH_MILVUS_URI" in done.stderr


@pytest.fixture(scope="module")
def server(request: pytest.FixtureRequest) -> Iterator[MilvusServer]:
    try:
        started = MilvusServer()
    except CannotInstallError as error:
        why = f"NO MILVUS SERVER could be installed, its tests are skipped: {error}"
        request.config.get_terminal_writer().line(why, red=True)
        pytest.skip(why)
    with started:
        yield started


@pytest.fixture(scope="module")
def settings(server: MilvusServer) -> MilvusSettings:
    return MilvusSettings(server.uri, timeout_s=20.0)


@pytest.fixture(scope="module")
def pushed(small_directory: Path, settings: MilvusSettings) -> Path:
    push_library(small_directory, settings)
    return small_directory


@pytest.fixture(scope="module")
def replica(pushed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a replica needs of the library."""
    directory = tmp_path_factory.mktemp("replica") / "small"
    shutil.copytree(pushed, directory, ignore=shutil.ignore_patterns(*NOT_NEEDED))
    return directory


@pytest.fixture(scope="module")
def remote(replica: Path, settings: MilvusSettings) -> Iterator[Library]:
    library = load(replica, backend="milvus", milvus=settings)
    yield library
    library.close()


@pytest.fixture(scope="module")
def exact(small_directory: Path) -> Iterator[Library]:
    library = load(small_directory, backend="exact")
    yield library
    library.close()


@pytest.mark.slow
def test_a_push_goes_on_where_it_was_killed(
    small_directory: Path, settings: MilvusSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(milvus_push, "BATCH", 500)

    def interrupt(stage: str, done: float) -> None:
        if stage == "descriptors" and done >= 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        push_library(small_directory, settings, interrupt)
    with pytest.raises(LibraryError, match=r"of the 4000 exemplars.*posematch library push"):
        load(small_directory, backend="milvus", milvus=settings)
    # A run of which only a part arrived.
    client = connect(settings)
    collection = collection_name(read_manifest(small_directory))
    client.delete(collection, ids=[3, 77])
    client.close()
    done = push_library(small_directory, settings)
    assert (done.n_entries, done.n_before) == (4_000, 1_998)


@pytest.mark.slow
def test_a_second_push_changes_nothing(pushed: Path, settings: MilvusSettings) -> None:
    done = subprocess.run(
        [COMMAND, "library", "push", pushed],
        env=environment(milvus_uri=settings.uri),
        capture_output=True,
        text=True,
        check=True,
    )
    assert "4000 exemplars, 4000 of them were there" in done.stdout


@pytest.mark.slow
def test_what_milvus_finds_is_what_is_nearest(remote: Library, exact: Library) -> None:
    assert (remote.index_backend, len(remote)) == ("milvus", 4_000)
    queries = noisy_queries(exact.descriptors(np.arange(4_000)), 30)
    truth, found = exact.match(queries, None, 10), remote.match(queries, None, 10)
    assert recall(truth.entries, found.entries) >= 0.99
    same = truth.entries == found.entries
    # Of descriptors that are computed again, from poses and cameras.
    assert_allclose(found.distances[same], truth.distances[same], atol=1e-6)
    everybody = remote.match(queries[:1], None, 10 * len(remote))
    assert_array_equal(np.sort(everybody.entries[0]), np.arange(4_000))


@pytest.mark.slow
def test_a_library_that_is_closed_leaves_the_others_their_connection(
    remote: Library, exact: Library, replica: Path, settings: MilvusSettings
) -> None:
    """As when a reload is refused while the old library is in service."""
    load(replica, backend="milvus", milvus=settings).close()
    points = noisy_queries(exact.descriptors(np.arange(100)), 1)
    assert remote.match(points, None, 5).entries.shape == (1, 5)


@pytest.mark.slow
@pytest.mark.parametrize("mask", MASKS)
def test_masked(mask: str, remote: Library, exact: Library) -> None:
    queries = noisy_queries(exact.descriptors(np.arange(4_000)), 10)
    weights = weights_without(MASKS[mask], len(queries))
    truth, found = exact.match(queries, weights, 10), remote.match(queries, weights, 10)
    assert recall(truth.entries, found.entries) >= 0.95


def recall(truth: np.ndarray, found: np.ndarray) -> float:
    pairs = zip(truth, found, strict=True)
    return float(np.mean([len(np.intersect1d(a, b)) / len(a) for a, b in pairs]))


@pytest.mark.slow
def test_the_service_while_milvus_is_away(
    server: MilvusServer, replica: Path, remote: Library, tmp_path: Path
) -> None:
    query = noisy_queries(remote.descriptors(np.arange(100)), 1)
    with Server(
        tmp_path / "log",
        library_dir=replica,
        index="milvus",
        milvus_uri=server.uri,
        milvus_timeout_ms=3_000,
        deadline_ms=60_000,
    ) as service:
        assert lift(service).status_code == 200
        server.hang()
        for _ in range(3):
            refused(lift(service))
        started_s = time.monotonic()
        refused(lift(service))
        assert time.monotonic() - started_s < 1.0, "later ones are refused without waiting"
        server.wake()
        answers_again(service)

        server.kill()
        for _ in range(3):
            refused(lift(service))
        with pytest.raises(IndexUnavailableError, match=server.uri):
            remote.match(query, None, 5)
        assert service.client.get("/livez").status_code == 200
        assert service.metric('posematch_refused_total{reason="library"}') >= 6
    log = (tmp_path / "log").read_text()
    assert "Traceback" not in log
    assert f"Milvus at {server.uri}" in log


def lift(service: Server) -> httpx.Response:
    return service.client.post(
        "/v1/lift", content=EXAMPLE.read_bytes(), headers={"Content-Type": "application/json"}
    )


def refused(answer: httpx.Response) -> None:
    assert answer.status_code == 503
    assert answer.json()["type"] == "urn:posematch:problem:library-unavailable"
    assert int(answer.headers["retry-after"]) >= 1


def answers_again(service: Server) -> None:
    deadline_s = time.monotonic() + 90.0
    while (answer := lift(service)).status_code != 200:
        refused(answer)
        assert time.monotonic() < deadline_s
        time.sleep(0.2)
