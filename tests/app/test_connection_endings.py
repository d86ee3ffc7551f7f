"""How connections end: idle, deaf, refused amidst an upload, and thousands of them at random."""

from __future__ import annotations

import asyncio
import json
import random
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import uvicorn
import uvloop
from starlette.applications import Starlette
from uvicorn.server import ServerState

from app.connection import MAX_HEAD_BYTES, connection_class
from tests.app.server import Server, read_response, read_whole

PATIENCE_S = 1.5
KEEP_ALIVE_S = 1
LIVEZ = b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n"
NOWHERE = b"POST /nowhere HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory, library_dir: Path) -> Iterator[Server]:
    """A server with one worker, next to no queue and little patience."""
    with Server(
        tmp_path_factory.mktemp("small") / "log",
        library_dir=library_dir,
        workers=1,
        queue_size=1,
        deadline_ms=60_000,
        upload_timeout_s=PATIENCE_S,
        keep_alive_s=KEEP_ALIVE_S,
    ) as running:
        yield running
        assert "Traceback" not in running.log.read_text()


def open_files(server: Server) -> int:
    return len(list(Path(f"/proc/{server.process.pid}/fd").iterdir()))


def test_an_idle_connection_is_closed_after_a_refused_upload_too(small: Server) -> None:
    with small.connect() as connection, connection.makefile("rb") as stream:
        connection.sendall(NOWHERE % 100_000)
        assert read_whole(stream)[0] == 404
        connection.sendall(bytes(100_000))
        started = time.monotonic()
        assert stream.read() == b""
    assert 0.5 * KEEP_ALIVE_S < time.monotonic() - started < 10


@pytest.mark.parametrize(
    ("pieces", "ends"),
    [
        (["H", "B"], True),
        (["HB"], True),
        (["H", "BN"], False),
        (["HBN"], False),
        (["HBHBN"], False),
        (["HB", "HBN"], False),
    ],
)
def test_keep_alive_is_for_idle_connections(pieces: list[str], ends: bool) -> None:
    """H and B, head and body of what is refused, N some of the next head, in these packets.

    Keep-alive lasts no time here, so whatever timer is left running ends the connection. The body
    is longer than a head may be, and read together with it.
    """
    size = 3 * MAX_HEAD_BYTES
    sent = {"H": NOWHERE % size, "B": bytes(size), "N": LIVEZ[:-4]}
    refusal = b"HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\n\r\n"
    kind = connection_class(60.0, lambda _: refusal)
    config = uvicorn.Config(
        Starlette(), http=kind, ws="none", lifespan="off", log_config=None, timeout_keep_alive=0
    )
    config.load()

    async def scenario() -> None:
        loop = asyncio.get_running_loop()
        ours, theirs = socket.socketpair()
        with theirs:
            _, connection = await loop.create_connection(
                lambda: kind(config, ServerState(), {}), sock=ours
            )
            for piece in pieces:
                connection.data_received(b"".join(sent[part] for part in piece))
            transport = connection.transport
            await asyncio.sleep(0.05)
            assert transport.is_closing() == ends
            transport.abort()
            await asyncio.sleep(0)

    uvloop.run(scenario())


@pytest.mark.parametrize("head", [b"HTTP/1.0\r\n", b"HTTP/1.1\r\nHost: x\r\nConnection: close\r\n"])
def test_who_is_refused_may_end_the_upload(small: Server, head: bytes) -> None:
    """Were the socket just closed, most clients would fail in sending and see no answer."""
    size = 3_000_000
    with small.connect() as connection:
        connection.sendall(b"POST /nowhere " + head + b"Content-Length: %d\r\n\r\n" % size)
        connection.sendall(bytes(size))
        assert read_response(connection)[0] == 404
        assert connection.recv(1) == b""


def test_refused_for_want_of_room_with_the_connection_closed(small: Server) -> None:
    """As proxies ask that speak HTTP/1.0 to what is behind them."""
    heavy = cv2.imencode(".png", np.zeros((3000, 3000, 3), np.uint8))[1].tobytes()
    request = b"POST /v1/poses HTTP/1.0\r\nContent-Length: %d\r\n\r\n" % len(heavy) + heavy
    with ExitStack() as stack:
        clients = [stack.enter_context(small.connect()) for _ in range(6)]
        for client in clients:
            client.sendall(request)
        answers = [read_whole(stack.enter_context(client.makefile("rb"))) for client in clients]
        assert [client.recv(1) for client in clients] == [b""] * len(clients)
    assert {status for status, _, _ in answers} == {200, 503}
    for _, headers, body in answers:
        assert headers["connection"] == "close"
        assert json.loads(body)["request_id"] == headers["x-request-id"]


def test_the_rest_of_a_refused_body_is_not_awaited_for_ever(small: Server) -> None:
    with small.connect() as connection:
        connection.sendall(b"POST /nowhere HTTP/1.0\r\nContent-Length: 99\r\n\r\n")
        assert read_response(connection)[0] == 404
        started = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() - started < 20:
                connection.sendall(b"?")
                time.sleep(0.2)
        assert time.monotonic() - started < 10


def test_a_slow_upload_behind_another_request_is_told_so(small: Server) -> None:
    """The first answer must not have the second request taken for a refused one."""
    with small.connect() as connection, connection.makefile("rb") as stream:
        connection.sendall(
            LIVEZ + b"POST /v1/lift HTTP/1.1\r\nHost: x\r\nContent-Length: 99\r\n\r\n{"
        )
        assert read_whole(stream)[0] == 200
        assert read_whole(stream)[0] == 408


def test_nothing_is_kept_for_who_does_not_read(small: Server) -> None:
    """However little of the answers is left when the socket takes no more."""
    before = open_files(small)
    with ExitStack() as stack:
        for answers in range(4, 36, 2):
            connection = stack.enter_context(socket.socket())
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.connect(("127.0.0.1", small.port))
            connection.sendall(answers * b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n")
        deadline = time.monotonic() + 20
        while open_files(small) > before:
            assert time.monotonic() < deadline, "a connection is kept open"
            time.sleep(0.1)


MOODS = ("stays", "cut", "half", "gone", "deaf")


class Crowd:
    """Clients that send one to four requests at once, each with an id, and then leave or stay.

    ``seen`` counts moods and statuses; ``wrong`` says who got what was not theirs, or nothing.
    """

    def __init__(self, server: Server, photo: bytes, until: float) -> None:
        self.seen: Counter[str] = Counter()
        self.wrong: list[str] = []
        self._server = server
        self._photo = photo
        self._until = until

    def run(self, clients: int) -> None:
        threads = [threading.Thread(target=self._client, args=(n,)) for n in range(clients)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _client(self, number: int) -> None:
        rng = random.Random(number)
        while time.monotonic() < self._until and not self.wrong:
            mood = rng.choice(MOODS)
            self.seen[mood] += 1
            with suppress(ConnectionError), self._server.connect() as connection:
                self._one(connection, rng, mood, f"{number}-{rng.getrandbits(32)}")

    def _one(self, connection: socket.socket, rng: random.Random, mood: str, name: str) -> None:
        names = [f"{name}-{place}" for place in range(rng.randint(1, 4))]
        sent = b"".join(self._request(rng, name) for name in names)
        began = time.monotonic()
        connection.sendall(sent[: rng.randint(1, len(sent))] if mood == "cut" else sent)
        if mood == "half":
            connection.shutdown(socket.SHUT_WR)
        if mood == "stays":
            with connection.makefile("rb") as stream:
                for name in names:
                    if not stream.peek(1):
                        if time.monotonic() - began < KEEP_ALIVE_S:
                            self.wrong.append(f"{name} got nothing")
                        return
                    self._check(name, *read_whole(stream))
        if mood == "deaf":
            time.sleep(rng.random() / 20)
        if mood in {"gone", "deaf"}:  # with a reset
            linger = struct.pack("ii", 1, 0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)

    def _check(self, name: str, status: int, headers: dict[str, str], body: bytes) -> None:
        self.seen[str(status)] += 1
        if headers["x-request-id"] != name or (status >= 400 and name.encode() not in body):
            self.wrong.append(f"{name} got {status} {headers} {body[:200]!r}")

    def _request(self, rng: random.Random, name: str) -> bytes:
        head = f"Host: x\r\nX-Request-ID: {name}\r\n"
        if rng.random() < 0.5:
            path = rng.choice(["/livez", "/openapi.json", "/nowhere"])
            return f"GET {path} HTTP/1.1\r\n{head}\r\n".encode()
        head = f"POST /v1/poses HTTP/1.1\r\n{head}Content-Length: {len(self._photo)}\r\n\r\n"
        return head.encode() + self._photo


def test_nobody_gets_the_answer_of_another(small: Server, photo: bytes) -> None:
    """Connections are cut in every state, and their numbers go to others at once."""
    crowd = Crowd(small, photo, until=time.monotonic() + 4.0)
    crowd.run(clients=12)
    assert not crowd.wrong
    assert {"200", "404", "503", *MOODS} <= set(crowd.seen)
    assert set(crowd.seen) <= {"200", "404", "408", "503", *MOODS}
    deadline = time.monotonic() + 20
    while small.metric("posematch_running") or small.metric("posematch_upload_bytes"):
        assert time.monotonic() < deadline
        time.sleep(0.05)
