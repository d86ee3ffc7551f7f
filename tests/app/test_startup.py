"""Starting and stopping the real process: what refuses to start says why, without a traceback."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from app.main import create_app
from app.settings import Settings
from app.version import VERSION
from models.card import WEIGHTS_DIR
from tests.app.server import COMMAND, Server, environment


def refusal(tmp_path: Path, port: int = 0, **settings: object) -> str:
    """What `posematch serve` says on stderr when it refuses to start."""
    outcome = subprocess.run(
        [COMMAND, "serve", "--port", str(port)],
        env=environment(**{"cache_dir": tmp_path / "cache", **settings}),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert outcome.returncode == 1, outcome.stderr
    assert "Traceback" not in outcome.stderr
    assert "cannot start" in outcome.stderr
    return outcome.stderr


def test_bad_settings(tmp_path: Path) -> None:
    assert "POSEMATCH_WORKERS" in refusal(tmp_path, workers=0)
    assert "POSEMATCH_WORKERS" in refusal(tmp_path, worker=1), "a hint at the right name"


def await_numpy(pid: int) -> None:
    """Until the process is amidst its imports."""
    while "numpy" not in Path(f"/proc/{pid}/maps").read_text():
        time.sleep(0.005)


def test_control_c_while_it_still_imports() -> None:
    command: list[str | Path] = [COMMAND, "serve", "--port", "0"]
    # A suite that runs in the background ignores Ctrl-C itself, and children would inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    with process:
        await_numpy(process.pid)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert said == ""
    assert process.returncode == -signal.SIGINT, "which a shell calls 130"


def test_control_c_is_ignored_where_the_shell_says_so() -> None:
    """In the background of a script: it is meant for what runs in the foreground."""
    command = ["sh", "-c", f"trap '' INT; exec {COMMAND} version"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        await_numpy(process.pid)
        while process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(0.02)
        assert process.stdout is not None
        assert process.stdout.read().strip() == VERSION
    assert process.returncode == 0


@pytest.mark.parametrize("is_cached", [False, True])
def test_a_container_is_stopped_at_any_time(
    tmp_path: Path, library_dir: Path, is_cached: bool
) -> None:
    """There it is PID 1, which no signal ends by itself: while it builds its library, too."""
    alone = ["unshare", "--pid", "--fork", "--kill-child"]
    if subprocess.run([*alone, "true"], stderr=subprocess.DEVNULL, check=False).returncode:
        pytest.skip("no PID namespace may be made here")
    word, settings = (
        ("ready", environment(library_dir=library_dir))
        if is_cached
        else ("poses ...", environment(cache_dir=tmp_path))
    )
    with subprocess.Popen(
        [*alone, COMMAND, "serve", "--port", "0"], env=settings, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert any(word in line for line in process.stderr)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
        os.kill(int(children), signal.SIGTERM)
        _, said = process.communicate(timeout=30)
    assert "Traceback" not in said
    assert process.returncode == (0 if is_cached else 128 + signal.SIGINT)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "localhost"])
def test_an_address_that_is_taken_is_said_before_a_library_is_built(
    tmp_path: Path, host: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refusal(tmp_path, port, host=host)
    assert f"cannot listen on {host} port {port} (Address already in use)" in said
    assert "POSEMATCH_PORT" in said
    assert list(tmp_path.iterdir()) == [], "no library was begun"


def test_an_address_that_is_none(tmp_path: Path) -> None:
    assert "no-such-host.invalid" in refusal(tmp_path, host="no-such-host.invalid")
    assert list(tmp_path.iterdir()) == []


def test_a_restart_has_its_port_again(tmp_path: Path, library_dir: Path) -> None:
    """Connections that the last process closed linger in the system."""
    server = Server(tmp_path / "log", library_dir=library_dir)
    with server, server.connect():
        server.stop()  # which closes it from its side
    with server:
        assert server.is_ready()


def test_limits_below_an_ordinary_photo(tmp_path: Path, library_dir: Path) -> None:
    settings = {"library_dir": library_dir, "max_pixels": 1_000, "max_body_bytes": 1_000}
    with Server(tmp_path / "log", **settings) as server:
        photo = cv2.imencode(".png", np.zeros((40, 25, 3), np.uint8))[1].tobytes()
        assert server.client.post("/v1/poses", content=photo).status_code == 200


def test_missing_library(tmp_path: Path) -> None:
    said = refusal(tmp_path, library_dir=tmp_path / "none")
    assert str(tmp_path / "none") in said
    assert "posematch library build" in said


def test_corrupt_library(tmp_path: Path, library_dir: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(library_dir, broken)
    with (broken / "poses.npy").open("r+b") as file:
        file.seek(5000)
        file.write(b"oops")
    assert str(broken / "poses.npy") in refusal(tmp_path, library_dir=broken)


def test_missing_and_corrupt_model(tmp_path: Path, library_dir: Path) -> None:
    said = refusal(tmp_path, library_dir=library_dir, weights_dir=tmp_path / "none")
    assert str(tmp_path / "none") in said
    broken = tmp_path / "weights"
    shutil.copytree(WEIGHTS_DIR, broken)
    for name in ("cpm.onnx", "cpm-int8.onnx"):  # whichever of the two this machine would choose
        (broken / name).write_bytes(b"\x00" * 1000)
    said = refusal(tmp_path, library_dir=library_dir, weights_dir=broken)
    assert "cpm.onnx" in said or "cpm-int8.onnx" in said


def test_missing_lifter(tmp_path: Path, library_dir: Path) -> None:
    weights = tmp_path / "weights"
    shutil.copytree(WEIGHTS_DIR, weights)
    (weights / "lifter.json").unlink()
    said = refusal(tmp_path, library_dir=library_dir, weights_dir=weights)
    assert "lifter.json is missing" in said
    assert "POSEMATCH_LIFTER=off" in said


def test_unwritable_cache(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("not a directory")
    assert str(file) in refusal(tmp_path, cache_dir=file / "cache")


def test_not_ready_before_the_engine_is_loaded_nor_while_stopping() -> None:
    """Without its lifespan the application has no engine yet."""
    app = create_app(Settings())

    async def scenario() -> None:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
            for stopping in (False, True):
                app.state.service.stopping = stopping
                assert (await client.get("/livez")).status_code == 200
                assert (await client.get("/metrics")).status_code == 200
                for path in ("/readyz", "/v1/info"):
                    response = await client.get(path)
                    assert response.status_code == 503
                    assert response.json()["type"] == "urn:posematch:problem:not-ready"
                    assert response.headers["retry-after"] == "1"
                response = await client.post("/v1/poses", content=b"x")
                assert response.status_code == 503

    asyncio.run(scenario())


def test_requests_under_way_finish_at_sigterm(tmp_path: Path, library_dir: Path) -> None:
    heavy = cv2.imencode(".png", np.zeros((5000, 5000, 3), np.uint8))[1].tobytes()
    server = Server(tmp_path / "log", library_dir=library_dir, deadline_ms=60_000)
    answers: list[httpx.Response] = []

    def post() -> None:
        answers.append(httpx.post(server.url + "/v1/poses", content=heavy, timeout=60))

    with server:
        thread = threading.Thread(target=post)
        thread.start()
        while not answers and server.metric("posematch_running") == 0:
            time.sleep(0.001)
        server.stop()
        thread.join()
    assert [answer.status_code for answer in answers] == [200]
    assert "Traceback" not in server.log.read_text()
    with pytest.raises(httpx.ConnectError):
        httpx.get(server.url + "/livez")
