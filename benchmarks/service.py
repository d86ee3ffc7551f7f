"""A running service to measure: started for the time of a ``with`` block, and what it uses."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_PHOTO = ROOT / "tests" / "data" / "renders" / "000.jpg"
"""640 x 480, one person."""

START_TIMEOUT_S = 600.0


@dataclass(frozen=True)
class Service:
    """Where it listens, and its process; ``ready_s`` from start to ready, None if not ours."""

    url: str
    pid: int
    ready_s: float | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        parts = urlsplit(self.url)
        return parts.hostname or "127.0.0.1", parts.port or 80

    def cpu_s(self) -> float:
        """User and system time so far of the process and those that descend from it (Linux)."""
        processes = _processes()
        family, ticks = {self.pid}, 0
        for pid in sorted(processes):  # children have the higher ids, but where these start anew
            parent, spent = processes[pid]
            if pid in family or parent in family:
                family.add(pid)
                ticks += spent
        return ticks / os.sysconf("SC_CLK_TCK")

    def resident_mb(self) -> float:
        """Resident memory of the process alone, megabytes."""
        pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def open_files(self) -> int:
        """Open file descriptors, sockets included."""
        return len(list(Path(f"/proc/{self.pid}/fd").iterdir()))


@contextlib.contextmanager
def started_service(
    settings: Mapping[str, object] | None = None, variables: Mapping[str, str] | None = None
) -> Iterator[Service]:
    """Run ``posematch serve`` on a free port until it is ready.

    ``settings`` become POSEMATCH_* variables on top of the environment's; ``variables`` others.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "POSEMATCH_LOG_LEVEL": "warning", **(variables or {})}
    environment |= {f"POSEMATCH_{k.upper()}": str(v) for k, v in (settings or {}).items()}
    command = Path(sys.executable).with_name("posematch")
    started = time.monotonic()
    process = subprocess.Popen([command, "serve", "--port", str(port)], env=environment)
    try:
        while not _is_ready(port):
            if process.poll() is not None or time.monotonic() > started + START_TIMEOUT_S:
                raise SystemExit("the server did not start")
            time.sleep(0.02)
        yield Service(f"http://127.0.0.1:{port}", process.pid, time.monotonic() - started)
    finally:
        process.terminate()
        process.wait(timeout=60)


@contextlib.contextmanager
def given_or_started(url: str | None, pid: int | None) -> Iterator[Service]:
    """The service at ``url`` with process ``pid``, or one started here."""
    if url is None:
        with started_service() as service:
            yield service
        return
    if pid is None:
        raise SystemExit("--url needs --pid, the server's process, to say what it uses")
    yield Service(url, pid)


def _processes() -> dict[int, tuple[int, int]]:
    """Id of every process -> its parent's, and the clock ticks it has used."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            found[int(path.parent.name)] = int(fields[1]), int(fields[11]) + int(fields[12])
    return found


def _is_ready(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
            connection.sendall(b"GET /readyz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
            return b" 200 " in connection.recv(64)
    except OSError:
        return False
