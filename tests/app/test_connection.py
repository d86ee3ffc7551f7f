"""Clients as no library is, over raw sockets: slow, silent, endless, deaf, or no HTTP at all."""

from __future__ import annotations

import json
import socket
import time
from contextlib import suppress
from email.utils import parsedate_to_datetime

import pytest

from app.api.bodies import UploadMemory
from app.connection import MAX_HEAD_BYTES
from app.errors import OverloadedError, RequestError
from tests.app.server import Server, read_response, read_whole

PATIENCE_S = 1.5
"""The upload timeout of the session's server."""

LIVEZ = b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n"


def is_closed(connection: socket.socket, within_s: float = 20.0) -> bool:
    """Whether the server ends the connection; what it still sends is thrown away."""
    connection.settimeout(within_s)
    try:
        while connection.recv(65536):
            pass
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return True


def check_problem(connection: socket.socket, status: int, slug: str) -> None:
    answered, body = read_response(connection)
    assert answered == status
    problem = json.loads(body)
    assert problem["type"] == f"urn:posematch:problem:{slug}"
    # A type has one title, whoever says it (RFC 9457, 3.1.3).
    (title,) = {kind.title for kind in RequestError.__subclasses__() if kind.slug == slug}
    assert problem["title"] == title
    assert problem["status"] == status
    assert problem["request_id"]
    assert is_closed(connection)


def test_a_head_that_trickles_in(server: Server) -> None:
    started = time.monotonic()
    with server.connect() as connection:
        for piece in (b"POST /v1/po", b"ses HTTP/1.1\r\n", b"Host: x\r\n", b"X-Slow: "):
            connection.sendall(piece)
            time.sleep(0.2)
        check_problem(connection, 408, "upload-too-slow")
    assert time.monotonic() - started > 0.9 * PATIENCE_S


def test_silence_is_not_answered_but_ended(server: Server) -> None:
    with server.connect() as connection:
        assert connection.recv(100) == b""


def test_a_second_head_has_to_arrive_too(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(LIVEZ + b"GET /li")
        assert read_response(connection)[0] == 200
        check_problem(connection, 408, "upload-too-slow")


def test_a_head_without_end(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n")
        with suppress(OSError):
            for number in range(2 * MAX_HEAD_BYTES // 500):
                connection.sendall(b"X-Header-%d: %s\r\n" % (number, b"y" * 500))
                time.sleep(0.001)
        check_problem(connection, 431, "head-too-large")


@pytest.mark.parametrize(
    "data",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),  # TLS
        b"\x00" * 64,
        b"GET\r\n\r\n",
        b"POST /v1/poses HTTP/1.1\r\nContent-Length: -4\r\n\r\n",
        b"POST /v1/poses HTTP/1.1\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"POST /v1/poses HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nnot-hex\r\n",
        b"GET /\xff\xfe HTTP/1.1\r\nHost: x\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    ],
)
def test_what_is_no_http_gets_a_problem(server: Server, data: bytes) -> None:
    with server.connect() as connection:
        connection.sendall(data)
        check_problem(connection, 400, "malformed-http")


@pytest.mark.parametrize("before", [1, 3])
@pytest.mark.parametrize(
    "data",
    [
        b"garbage\r\n\r\n",
        b"POST /v1/lift HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nnot-hex\r\n",
    ],
)
def test_requests_before_what_is_no_http_are_answered(
    server: Server, before: int, data: bytes
) -> None:
    lift = b"POST /v1/lift HTTP/1.1\r\nHost: x\r\nX-Request-ID: %d\r\nContent-Length: 2\r\n\r\n{}"
    with server.connect() as connection, connection.makefile("rb") as stream:
        connection.sendall(b"".join(lift % number for number in range(before)) + data)
        for number in range(before):
            status, headers, _ = read_whole(stream)
            assert (status, headers["x-request-id"]) == (422, str(number))
        status, headers, body = read_whole(stream)
        assert (status, json.loads(body)["request_id"]) == (400, headers["x-request-id"])
        assert abs(parsedate_to_datetime(headers["date"]).timestamp() - time.time()) < 60
        assert stream.read() == b""


def test_a_request_is_answered_once(server: Server) -> None:
    """Here before its body, which then turns out to be none."""
    with server.connect() as connection, connection.makefile("rb") as stream:
        connection.sendall(
            b"POST /nowhere HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        assert read_whole(stream)[0] == 404
        connection.sendall(b"not-hex\r\n")
        assert stream.read() == b""


def test_the_connection_outlives_a_refusal(server: Server) -> None:
    """The body that was not wanted is dropped; what comes after it is the next request."""
    with server.connect() as connection:
        connection.sendall(b"POST /nowhere HTTP/1.1\r\nHost: x\r\nContent-Length: 500000\r\n\r\n")
        assert read_response(connection)[0] == 404
        connection.sendall(bytes(500_000) + LIVEZ)
        assert read_response(connection)[0] == 200


def test_but_not_for_ever(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(
            b"POST /nowhere HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        assert read_response(connection)[0] == 404
        started = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() - started < 20:
                connection.sendall(b"5\r\nnever\r\n")
                time.sleep(0.05)
        assert time.monotonic() - started < 20


def test_who_does_not_read_is_cut_off(server: Server) -> None:
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", server.port))
        connection.sendall(200 * b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n")
        time.sleep(3 * PATIENCE_S)
        connection.settimeout(10)
        received = 0
        with suppress(ConnectionError):
            while piece := connection.recv(65536):
                received += len(piece)
        assert received < 100 * 80_000
    assert server.client.get("/livez").status_code == 200
    assert "Traceback" not in server.log.read_text(), "a connection given up is no error"


def test_who_reads_slowly_gets_everything_in_order(server: Server) -> None:
    """Answers larger than the socket's buffers, several at once."""
    expected = server.client.get("/openapi.json").content
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", server.port))
        connection.sendall(20 * b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n" + LIVEZ)
        with connection.makefile("rb") as stream:
            for _ in range(20):
                time.sleep(0.02)
                status, _, body = read_whole(stream)
                assert (status, body) == (200, expected)
            assert read_whole(stream)[0] == 200


def test_old_and_odd_clients(server: Server, photo: bytes) -> None:
    length = b"Content-Length: %d\r\n" % len(photo)
    for head in (
        b"POST /v1/poses HTTP/1.0\r\n",
        b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nConnection: Upgrade, HTTP2-Settings\r\n"
        b"Upgrade: h2c\r\nHTTP2-Settings: AAMAAABkAAQAAP__\r\n",
        b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\n",
    ):
        with server.connect() as connection:
            connection.sendall(head + length + b"\r\n")
            if b"Expect" in head:
                assert connection.recv(100) == b"HTTP/1.1 100 Continue\r\n\r\n"
            connection.sendall(photo)
            assert read_response(connection)[0] == 200


def test_a_body_that_will_be_refused_is_not_asked_for(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(
            b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\n"
            b"Content-Length: 99000000\r\n\r\n"
        )
        assert read_response(connection)[0] == 413


def test_upload_memory_is_shared_and_given_back() -> None:
    memory = UploadMemory(100)
    with memory.share() as one, memory.share() as other:
        one(60)
        other(40)
        assert memory.held_bytes == 100
        with pytest.raises(OverloadedError) as caught:
            other(1)
        assert caught.value.reason == "upload_memory"
    assert memory.held_bytes == 0
