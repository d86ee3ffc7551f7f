"""SIGHUP under requests: a new library takes over, a bad one does not."""

from __future__ import annotations

import json
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from library_store.build import BuildSettings, build_library
from library_store.manifest import read_manifest
from library_store.prior import PosePrior
from library_store.publish import put_in_place
from tests.app.server import Server

EXAMPLE = Path(__file__).parents[2] / "app" / "examples" / "lift_request.json"
SETTINGS = BuildSettings(name="own", n_poses=1_500)


@dataclass
class Load:
    """What clients saw: statuses, and the libraries that answered."""

    statuses: list[int] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)


@contextmanager
def clients(url: str, photo: bytes) -> Iterator[Load]:
    """Three clients that ask without pause: photos, joints, and what is served."""
    load, stop = Load(), threading.Event()
    body = EXAMPLE.read_bytes()
    requests = (
        lambda c: c.post("/v1/poses", content=photo),
        lambda c: c.post("/v1/lift", content=body, headers={"Content-Type": "application/json"}),
        lambda c: c.get("/v1/info"),
    )

    def ask(number: int) -> None:
        with httpx.Client(base_url=url, timeout=60.0) as client:
            while not stop.is_set():
                answer = requests[number](client)
                load.statuses.append(answer.status_code)
                if answer.status_code == 200:
                    load.libraries.append(answer.json()["library"]["sha256"])

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    try:
        yield load
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def wait_until(said: str, log: Path) -> str:
    """The log, once it says that."""
    deadline = time.monotonic() + 60.0
    while said not in log.read_text():
        assert time.monotonic() < deadline, f"never said {said!r}:\n{log.read_text()}"
        time.sleep(0.05)
    return log.read_text()


def served(server: Server) -> str:
    sha256: str = server.client.get("/v1/info").json()["library"]["sha256"]
    return sha256


def deleted_maps(server: Server) -> list[str]:
    """Files of libraries that are gone from the folder but not from the server's memory."""
    maps = Path(f"/proc/{server.process.pid}/maps").read_text().splitlines()
    return [line for line in maps if ".npy" in line and "(deleted)" in line]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    build_library(tmp_path / "own", PosePrior.load(), SETTINGS)
    settings = {"library_dir": tmp_path / "own", "deadline_ms": 60_000, "queue_size": 64}
    with Server(tmp_path / "log", **settings) as running:
        yield running


def test_no_request_fails_while_the_library_changes(
    server: Server, tmp_path: Path, photo: bytes
) -> None:
    old = served(server)
    with clients(server.url, photo) as load:
        while len(load.statuses) < 6:
            time.sleep(0.01)
        settings = BuildSettings(name="own", n_poses=900, seed=1)
        new = build_library(tmp_path / "own", PosePrior.load(), settings).sha256
        assert served(server) == old, "nothing changes before the signal"
        for _ in range(3):  # a second and third signal during the reload do no harm
            server.process.send_signal(signal.SIGHUP)
        wait_until("library reloaded", server.log)
        seen = len(load.statuses)
        while len(load.statuses) < seen + 6:
            time.sleep(0.01)
    assert set(load.statuses) == {200}
    assert set(load.libraries) == {old, new}
    assert served(server) == new
    wait_until("old library let go", server.log)
    assert deleted_maps(server) == []
    assert server.metric('posematch_library_reloads_total{outcome="done"}') == 1
    assert "Traceback" not in server.log.read_text()


def test_a_bad_library_leaves_the_old_one_in_service(
    server: Server, tmp_path: Path, photo: bytes
) -> None:
    old = served(server)
    pristine = shutil.copytree(tmp_path / "own", tmp_path / "pristine")
    bad = shutil.copytree(tmp_path / "own", tmp_path / "bad")
    manifest = json.loads((bad / "manifest.json").read_text())
    (bad / "manifest.json").write_text(json.dumps(manifest | {"version": "bad"}))
    with (bad / "poses.npy").open("r+b") as file:
        file.seek(5_000)
        file.write(b"oops")
    put_in_place(bad, tmp_path / "own")
    server.process.send_signal(signal.SIGHUP)
    log = wait_until("reload refused", server.log)
    assert "poses.npy is corrupt" in log
    assert "the library in service stays" in log
    assert served(server) == old
    assert server.client.post("/v1/poses", content=photo).status_code == 200
    assert server.metric('posematch_library_reloads_total{outcome="refused"}') == 1

    shutil.rmtree(tmp_path / "own")
    server.process.send_signal(signal.SIGHUP)
    wait_until("there is no pose library in", server.log)
    assert server.client.post("/v1/poses", content=photo).status_code == 200

    pristine.rename(tmp_path / "own")
    server.process.send_signal(signal.SIGHUP)
    wait_until("library reloaded", server.log)
    assert read_manifest(tmp_path / "own").sha256 == served(server) == old


@pytest.mark.parametrize("replaced", [True, False])
def test_files_that_were_written_to_are_read_again(
    server: Server, tmp_path: Path, photo: bytes, replaced: bool
) -> None:
    """Though the manifest is the same: damage is named, and what mends it taken into service."""
    own = tmp_path / "own"
    server.process.send_signal(signal.SIGHUP)
    wait_until("the library is the one in service", server.log)
    assert server.metric('posematch_library_reloads_total{outcome="unchanged"}') == 1

    pristine = shutil.copytree(own, tmp_path / "pristine")
    damaged = own / "poses.npy"
    if replaced:
        damaged = Path(shutil.copy(damaged, tmp_path))
    with damaged.open("r+b") as file:
        file.seek(5_000)
        file.write(b"oops")
    damaged.replace(own / "poses.npy")
    server.process.send_signal(signal.SIGHUP)
    assert "poses.npy is corrupt" in wait_until("reload refused", server.log)

    put_in_place(pristine, own)
    server.process.send_signal(signal.SIGHUP)
    wait_until("library reloaded", server.log)
    assert server.client.post("/v1/poses", content=photo).status_code == 200
    wait_until("old library let go", server.log)
    assert deleted_maps(server) == []
