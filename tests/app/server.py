"""A real server for tests: the `posematch serve` command in a process of its own."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import httpx

COMMAND = Path(sys.executable).with_name("posematch")
START_TIMEOUT_S = 60.0


def environment(**settings: object) -> dict[str, str]:
    """The environment with these settings as POSEMATCH_* variables, and no others."""
    inherited = {k: v for k, v in os.environ.items() if not k.upper().startswith("POSEMATCH_")}
    return inherited | {f"POSEMATCH_{k.upper()}": str(v) for k, v in settings.items()}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Server:
    """Runs `posematch serve` with these settings for the time of a ``with`` block."""

    def __init__(self, log: Path, **settings: object) -> None:
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.log = log
        self._settings = {"host": "127.0.0.1", "port": self.port, **settings}

    def __enter__(self) -> Self:
        self.start()
        deadline = time.monotonic() + START_TIMEOUT_S
        while not self.is_ready():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.stop()
                raise AssertionError(f"the server did not start:\n{self.log.read_text()}")
            time.sleep(0.05)
        return self

    def start(self) -> None:
        """Start the process without waiting until it is ready."""
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [COMMAND, "serve"], env=environment(**self._settings), stdout=log, stderr=log
            )
        self.client = httpx.Client(base_url=self.url, timeout=60.0)

    def is_ready(self) -> bool:
        try:
            return self.client.get("/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def stop(self) -> int:
        """End it with SIGTERM; its exit code."""
        self.client.close()
        self.process.terminate()
        return self.process.wait(timeout=30)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.process.poll() is None:
            self.stop()

    def connect(self) -> socket.socket:
        """A raw connection, for requests no well-behaved client would make."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=30)

    def metric(self, sample: str) -> float:
        """The value of one line of /metrics, 0 when it is not there."""
        for line in self.client.get("/metrics").text.splitlines():
            if line.startswith(sample + " "):
                return float(line.rsplit(" ", 1)[1])
        return 0.0


def read_response(connection: socket.socket) -> tuple[int, bytes]:
    """Status and everything that follows the header, until the server closes or is done."""
    data = b""
    while b"\r\n\r\n" not in data:
        piece = connection.recv(65536)
        if not piece:
            break
        data += piece
    head, _, body = data.partition(b"\r\n\r\n")
    length = next(
        int(line.split(b":")[1])
        for line in head.split(b"\r\n")
        if line.lower().startswith(b"content-length:")
    )
    while len(body) < length:
        piece = connection.recv(65536)
        if not piece:
            break
        body += piece
    return int(head.split(b" ")[1]), body


def read_whole(stream: BinaryIO) -> tuple[int, dict[str, str], bytes]:
    """One response: status, headers, body."""
    status = int(stream.readline().split(b" ")[1])
    headers = {}
    while line := stream.readline().rstrip(b"\r\n").decode():
        name, _, value = line.partition(": ")
        headers[name.lower()] = value
    return status, headers, stream.read(int(headers["content-length"]))
