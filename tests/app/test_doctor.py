"""`posematch doctor`: what is well is said so, what is not is named with what to do."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from app.cli import cli
from app.commands.machine import Memory, cpu_flags, describe_cpu, memory
from app.settings import Settings
from tests.app.server import Server, free_port

WEIGHTS = Settings().weights_dir


def run(*arguments: str, **settings: object) -> Result:
    """In this process, with these settings and no others."""
    others = {name: None for name in os.environ if name.upper().startswith("POSEMATCH_")}
    given = {f"POSEMATCH_{name.upper()}": str(value) for name, value in settings.items()}
    return CliRunner(env={**others, **given}).invoke(cli, arguments)


def examine(expected: int, **settings: object) -> dict[str, dict[str, Any]]:
    done = run("doctor", "--json", **{"port": free_port(), **settings})
    assert done.exit_code == expected, done.output
    report = json.loads(done.stdout)
    assert report["can_serve"] == (expected == 0)
    return {finding["name"]: finding for finding in report["findings"]}


def test_all_is_well(library_dir: Path) -> None:
    findings = examine(0, library_dir=library_dir, deadline_ms=60_000)
    assert {it["state"] for it in findings.values()} <= {"ok", "warning"}
    assert findings["a photo"]["state"] == "ok"
    assert "1 of 1 person found, matched with hnsw, " in findings["a photo"]["said"]
    said = run("doctor", library_dir=library_dir, port=free_port(), deadline_ms=60_000).stdout
    assert re.search(r"ok  library: small \S+, 4000 exemplars", said)


def test_nothing_is_built(tmp_path: Path) -> None:
    findings = examine(0, cache_dir=tmp_path / "cache")
    assert findings["library"]["state"] == "warning"
    assert "posematch library build" in findings["library"]["mend"]
    assert "a photo" not in findings
    assert list(tmp_path.iterdir()) == []


def test_bad_settings() -> None:
    findings = examine(1, workers=0)
    assert "POSEMATCH_WORKERS" in findings["settings"]["said"]


def test_broken_weights(tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    shutil.copytree(WEIGHTS, weights)
    for file in weights.glob("cpm*.onnx"):
        file.write_bytes(b"oops")
    for file in weights.glob("person*.onnx"):
        file.unlink()
    findings = examine(1, weights_dir=weights, cache_dir=tmp_path / "cache")
    for name, said in (("cpm", "do not match"), ("person", "missing")):
        finding = next(f for key, f in findings.items() if key.startswith(f"weights of {name}"))
        assert finding["state"] == "failure"
        assert said in finding["said"]
        assert "restore" in finding["mend"]


def test_a_broken_library(library_dir: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(library_dir, broken)
    poses = broken / "poses.npy"
    data = bytearray(poses.read_bytes())
    data[-1] ^= 1
    poses.write_bytes(data)
    findings = examine(1, library_dir=broken)
    assert findings["library"]["state"] == "failure"
    assert "poses.npy" in findings["library"]["said"]
    assert findings["library"]["mend"]


def test_a_cache_that_is_no_directory(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    findings = examine(1, cache_dir=file / "cache")
    assert findings["cache"]["state"] == "failure"
    assert "POSEMATCH_CACHE_DIR" in findings["cache"]["mend"]


def test_a_cache_that_cannot_even_be_looked_for(tmp_path: Path) -> None:
    findings = examine(1, cache_dir=tmp_path / ("a" * 300) / "cache")
    assert findings["cache"]["state"] == "failure"
    assert findings["library"]["state"] == "warning"


def test_the_port(tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        findings = examine(1, port=taken.getsockname()[1], cache_dir=tmp_path)
    assert findings["port"]["state"] == "failure"
    assert "POSEMATCH_PORT" in findings["port"]["mend"]
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # not asked about this machine
    monkeypatch.setenv("no_proxy", "")
    monkeypatch.setattr("urllib.request._opener", None)  # made before, it knows of none
    findings = examine(0, port=server.port, cache_dir=tmp_path)
    assert "already serving" in findings["port"]["said"]


def test_a_port_where_something_speaks_no_http(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def greet() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.sendall(b"SSH-2.0-other\r\n")
                connection.recv(1000)

        greeting = Thread(target=greet)
        greeting.start()
        findings = examine(1, port=listening.getsockname()[1], cache_dir=tmp_path)
        greeting.join()
    assert findings["port"]["state"] == "failure"


def test_settings_that_refuse_an_ordinary_photo(library_dir: Path) -> None:
    finding = examine(1, library_dir=library_dir, max_pixels=1000)["a photo"]
    assert finding["state"] == "failure"
    assert "480 x 640" in finding["said"]


def test_a_library_of_ones_own_is_not_to_be_deleted(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    finding = examine(1, library_dir=file)["library"]
    assert finding["state"] == "failure"
    assert "delete" not in finding["mend"]


@pytest.mark.parametrize(
    ("settings", "state"),
    [
        ({"host": "127.0.0.1"}, "ok"),
        ({"host": "0.0.0.0"}, "warning"),
        ({"host": "0.0.0.0", "api_keys": "0123456789abcdef"}, "ok"),
    ],
)
def test_an_open_door(tmp_path: Path, settings: dict[str, str], state: str) -> None:
    finding = examine(0, cache_dir=tmp_path, **settings)["access"]
    assert finding["state"] == state
    assert "0123456789abcdef" not in finding["said"]


@pytest.mark.parametrize(("free_mb", "state"), [(400, "warning"), (600, "ok")])
def test_what_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mb: int, state: str
) -> None:
    """A build takes less than serving does: where there is no library yet, no more is wanted."""
    monkeypatch.setattr("app.commands.doctor.memory", lambda: Memory(free_mb * 10**6, None))
    finding = examine(0, cache_dir=tmp_path)["memory"]
    assert finding["state"] == state
    assert (finding["mend"] == "") == (state == "ok")


def test_the_machine_is_described() -> None:
    free = memory()
    assert free is None or free.available_bytes > 0
    assert all(flag in describe_cpu() for flag in cpu_flags())
    assert "core" in describe_cpu()
