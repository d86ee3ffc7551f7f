"""Latency and throughput of the running service, per stage, over loopback HTTP.

    python -m benchmarks.latency [--photo FILE] [--seconds 10] [--concurrency 1 4 16]

Starts ``posematch serve`` on a free port (or measures the one at ``--url``), posts one JPEG over
kept-alive connections at each concurrency for a fixed time, and prints the 50th and 99th percentile
of every stage (from ``Server-Timing``) and of the client's own clock, images a second, refusals,
and the server process' CPU time per answered request. The client shares the machine's cores with
the server and says how much of them it took.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import re
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

DEFAULT_PHOTO = Path(__file__).parent.parent / "tests" / "data" / "renders" / "000.jpg"
START_TIMEOUT_S = 600.0
_STAGE = re.compile(rb"(\w+);dur=([\d.]+)")


@dataclass
class Load:
    """What one run of a concurrency measured; ``stages_ms`` per answered request."""

    seconds: float = 0.0
    statuses: Counter[int] = field(default_factory=Counter)
    latencies_ms: list[float] = field(default_factory=list)
    refusals_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description="Latency and throughput over HTTP.")
    parser.add_argument("--url", help="measure this server instead of starting one")
    parser.add_argument("--pid", type=int, help="its process, for its CPU time (with --url)")
    parser.add_argument("--photo", type=Path, default=DEFAULT_PHOTO)
    parser.add_argument("--query", default="", help="query string, such as max_people=1")
    parser.add_argument("--concurrency", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--seconds", type=float, default=10.0, help="per concurrency, at most 120")
    arguments = parser.parse_args()
    seconds = min(max(arguments.seconds, 0.5), 120.0)
    with contextlib.ExitStack() as stack:
        url, pid = arguments.url, arguments.pid
        if url is None:
            url, pid = stack.enter_context(started_server())
        request = encode_request(url, arguments.photo.read_bytes(), arguments.query)
        print(f"{arguments.photo.name}, {seconds:g} s each, {os.cpu_count()} cores")
        asyncio.run(generate_load(url, request, concurrency=1, seconds=1.0))  # warm up
        for concurrency in arguments.concurrency:
            server_before, client_before = cpu_seconds(pid), time.process_time()
            load = asyncio.run(generate_load(url, request, concurrency, seconds))
            server_cpu = cpu_seconds(pid) - server_before
            report(concurrency, load, server_cpu, time.process_time() - client_before)


@contextlib.contextmanager
def started_server() -> Iterator[tuple[str, int]]:
    """Run ``posematch serve`` on a free port until it is ready; yields its URL and pid."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = Path(sys.executable).with_name("posematch")
    environment = {**os.environ, "POSEMATCH_LOG_LEVEL": "warning"}
    process = subprocess.Popen([command, "serve", "--port", str(port)], env=environment)
    try:
        deadline = time.monotonic() + START_TIMEOUT_S
        while not _is_ready(port):
            if process.poll() is not None or time.monotonic() > deadline:
                raise SystemExit("the server did not start")
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}", process.pid
    finally:
        process.terminate()
        process.wait(timeout=30)


def _is_ready(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
            connection.sendall(b"GET /readyz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
            return b" 200 " in connection.recv(64)
    except OSError:
        return False


def encode_request(url: str, photo: bytes, query: str) -> bytes:
    """The HTTP request, ready to be sent again and again."""
    target = "/v1/poses" + ("?" + query if query else "")
    head = f"POST {target} HTTP/1.1\r\nHost: {urlsplit(url).netloc}\r\n"
    head += f"Content-Type: image/jpeg\r\nContent-Length: {len(photo)}\r\n\r\n"
    return head.encode() + photo


async def generate_load(url: str, request: bytes, concurrency: int, seconds: float) -> Load:
    """Send ``request`` over ``concurrency`` kept-alive connections, each as fast as it can."""
    load = Load()
    started = time.perf_counter()
    end = started + seconds
    await asyncio.gather(*(_client(url, request, end, load) for _ in range(concurrency)))
    load.seconds = time.perf_counter() - started
    return load


async def _client(url: str, request: bytes, end: float, load: Load) -> None:
    parts = urlsplit(url)
    reader, writer = await asyncio.open_connection(parts.hostname, parts.port, limit=1 << 20)
    try:
        while time.perf_counter() < end:
            started = time.perf_counter()
            writer.write(request)
            await writer.drain()
            head = await reader.readuntil(b"\r\n\r\n")
            length = re.search(rb"content-length: (\d+)", head, re.IGNORECASE)
            await reader.readexactly(int(length[1]) if length else 0)
            spent_ms = 1e3 * (time.perf_counter() - started)
            status = int(head[9:12])
            load.statuses[status] += 1
            if status != 200:
                load.refusals_ms.append(spent_ms)
                await asyncio.sleep(0.02)  # what a polite client does at the least
                continue
            load.latencies_ms.append(spent_ms)
            for stage, stage_ms in _STAGE.findall(head):
                load.stages_ms.setdefault(stage.decode(), []).append(float(stage_ms))
    finally:
        writer.close()


def cpu_seconds(pid: int | None) -> float:
    """User and system time of a process so far (Linux), nan when it is not known."""
    if pid is None:
        return float("nan")
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def report(concurrency: int, load: Load, server_cpu_s: float, client_cpu_s: float) -> None:
    """Print one table."""
    answered = load.statuses[200]
    others = {status: n for status, n in load.statuses.items() if status != 200}
    print(f"\nconcurrency {concurrency}: {answered / load.seconds:.1f} images/s, others {others}")
    if not answered:
        return
    print(
        f"  CPU-ms per answer: server {1e3 * server_cpu_s / answered:.1f},"
        f" client {1e3 * client_cpu_s / answered:.1f}"
    )
    print(f"  {'ms':>8} {'p50':>8} {'p99':>8}")
    rows = {**load.stages_ms, "client": load.latencies_ms, "refused": load.refusals_ms}
    for stage, spent_ms in rows.items():
        if spent_ms:
            p50, p99 = np.percentile(spent_ms, [50, 99])
            print(f"  {stage:>8} {p50:8.2f} {p99:8.2f}")


if __name__ == "__main__":
    main()
