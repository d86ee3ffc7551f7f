"""Load over kept-alive connections: closed loop (each client waits) and open loop (a fixed rate).

The generator shares the machine's cores with the server, so it does little itself (uvloop, a bare
protocol); whoever uses it says how much of them it took (``Load.client_cpu_s``).
"""

from __future__ import annotations

import asyncio
import re
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any, Self

import uvloop

from benchmarks.service import Service

_STAGE = re.compile(rb"(\w+);dur=([\d.]+)")
_LENGTH = re.compile(rb"content-length: (\d+)", re.IGNORECASE)
_POLITE_PAUSE_S = 0.02
"""What a client of the closed loop waits after a refusal."""


class Connection(asyncio.Protocol):
    """A kept-alive connection that answers one request after the other."""

    def __init__(self) -> None:
        self._received = bytearray()
        self._answer: asyncio.Future[bytes] | None = None

    @classmethod
    async def open(cls, service: Service) -> Self:
        """A new connection to the service."""
        _, connection = await asyncio.get_running_loop().create_connection(cls, *service.address)
        return connection

    def ask(self, request: bytes) -> asyncio.Future[bytes]:
        """The head of the answer once its body is read, too; ``ConnectionError`` if it breaks."""
        self._answer = asyncio.get_running_loop().create_future()
        if self._transport.is_closing():
            self._answer.set_exception(ConnectionError("the connection is closed"))
        else:
            self._transport.write(request)
        return self._answer

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Keep the transport."""
        self._transport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        """Who waits for an answer will get none."""
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(exc or ConnectionError("closed before the answer's end"))

    def data_received(self, data: bytes) -> None:
        """Gather the answer."""
        self._received += data
        end = self._received.find(b"\r\n\r\n") + 4
        if end < 4:
            return
        head = bytes(self._received[:end])
        length = _LENGTH.search(head)
        whole = end + (int(length[1]) if length else 0)
        if len(self._received) >= whole and self._answer is not None:
            del self._received[:whole]
            if not self._answer.done():
                self._answer.set_result(head)


@dataclass
class Load:
    """What one run measured; ``stages_ms`` by stage of the answered, ``refusals_ms`` of the 503."""

    seconds: float = 0.0
    client_cpu_s: float = 0.0
    server_cpu_s: float = 0.0
    statuses: Counter[int] = field(default_factory=Counter)
    broken: int = 0
    latencies_ms: list[float] = field(default_factory=list)
    refusals_ms: list[float] = field(default_factory=list)
    refusals_app_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)

    @property
    def goodput(self) -> float:
        """Photos answered a second."""
        return self.statuses[200] / self.seconds

    def record(self, head: bytes, spent_ms: float) -> None:
        """Count one answer by its head."""
        status = int(head[9:12])
        self.statuses[status] += 1
        stages = {stage.decode(): float(ms) for stage, ms in _STAGE.findall(head)}
        if status != 200:
            self.refusals_ms.append(spent_ms)
            self.refusals_app_ms.append(stages.get("app", 0.0))
            return
        self.latencies_ms.append(spent_ms)
        for stage, stage_ms in stages.items():
            self.stages_ms.setdefault(stage, []).append(stage_ms)


def encode_request(service: Service, photo: bytes, query: str = "") -> bytes:
    """POST /v1/poses with this photo, ready to be sent again and again."""
    host, port = service.address
    target = "/v1/poses" + ("?" + query if query else "")
    head = f"POST {target} HTTP/1.1\r\nHost: {host}:{port}\r\n"
    head += f"Content-Type: application/octet-stream\r\nContent-Length: {len(photo)}\r\n\r\n"
    return head.encode() + photo


def closed_loop(service: Service, request: bytes, concurrency: int, seconds: float) -> Load:
    """``concurrency`` clients, each sending its next request when the last is answered."""

    async def client(load: Load, end: float) -> None:
        connection = await Connection.open(service)
        while time.perf_counter() < end:
            started = time.perf_counter()
            head = await connection.ask(request)
            load.record(head, 1e3 * (time.perf_counter() - started))
            if head[9:12] != b"200":
                await asyncio.sleep(_POLITE_PAUSE_S)
        connection.close()

    async def run(load: Load) -> None:
        end = time.perf_counter() + seconds
        await asyncio.gather(*(client(load, end) for _ in range(concurrency)))

    return _measured(service, run)


def open_loop(service: Service, request: bytes, rate: float, seconds: float) -> Load:
    """``rate`` requests a second whether or not earlier ones are answered."""

    async def one(load: Load, idle: list[Connection]) -> None:
        started = time.perf_counter()
        try:
            connection = idle.pop() if idle else await Connection.open(service)
            head = await connection.ask(request)
        except OSError:
            load.broken += 1
            return
        load.record(head, 1e3 * (time.perf_counter() - started))
        idle.append(connection)

    async def run(load: Load) -> None:
        idle: list[Connection] = []
        begin = time.perf_counter()
        async with asyncio.TaskGroup() as tasks:
            for number in range(int(rate * seconds)):
                await asyncio.sleep(max(0.0, begin + number / rate - time.perf_counter()))
                tasks.create_task(one(load, idle))
        for connection in idle:
            connection.close()

    return _measured(service, run)


def _measured(service: Service, run: Callable[[Load], Coroutine[Any, Any, None]]) -> Load:
    load = Load()
    started, client, server = time.perf_counter(), time.process_time(), service.cpu_s()
    uvloop.run(run(load))
    load.seconds = time.perf_counter() - started
    load.client_cpu_s = time.process_time() - client
    load.server_cpu_s = service.cpu_s() - server
    return load
