"""Refusals given from the head of a request: complete, counted, and the connection lives on."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np

from app.admission import Arrival
from app.api.deps import Service
from app.api.shedding import EarlyRefusals
from app.settings import load_settings
from tests.app.server import Server, read_whole

LIVEZ = b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n"
REFUSED = 'posematch_requests_total{method="POST",route="/v1/poses",status="503"}'


def test_a_refusal_from_the_head_is_as_complete_as_any_other(narrow_server: Server) -> None:
    heavy = cv2.imencode(".png", np.zeros((5000, 5000, 3), np.uint8))[1].tobytes()
    request = b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nX-Request-ID: mine\r\n"
    request += b"Content-Length: %d\r\n\r\n" % len(heavy) + heavy
    before = narrow_server.metric(REFUSED)
    with ExitStack() as stack:
        clients = [stack.enter_context(narrow_server.connect()) for _ in range(6)]
        streams = [stack.enter_context(client.makefile("rb")) for client in clients]
        for client in clients:
            client.sendall(request)
        answers = [read_whole(stream) for stream in streams]
        refused = [number for number, answer in enumerate(answers) if answer[0] == 503]
        assert {status for status, _, _ in answers} == {200, 503}
        for number in refused:
            _, headers, body = answers[number]
            assert headers["content-type"] == "application/problem+json"
            assert headers["x-content-type-options"] == "nosniff"
            assert "app;dur=" in headers["server-timing"]
            assert headers["x-request-id"] == json.loads(body)["request_id"] == "mine"
            assert int(headers["retry-after"]) >= 1
        assert narrow_server.metric(REFUSED) == before + len(refused)
        # All in one packet: what is answered at once must not overtake what is computed.
        clients[refused[0]].sendall(LIVEZ + request + LIVEZ)
        stream = streams[refused[0]]
        assert [read_whole(stream)[0] for _ in range(3)] == [200, 200, 200]


def test_many_refused_requests_in_one_packet(narrow_server: Server) -> None:
    """They queue up behind one that is computed, and are all answered."""
    heavy = cv2.imencode(".png", np.zeros((5000, 5000, 3), np.uint8))[1].tobytes()
    head = b"POST /v1/poses HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n"
    with ExitStack() as stack:
        others = [stack.enter_context(narrow_server.connect()) for _ in range(3)]
        for other in others:
            other.sendall(head % len(heavy) + heavy)
        client = stack.enter_context(narrow_server.connect())
        stream = stack.enter_context(client.makefile("rb"))
        client.sendall(LIVEZ + 300 * (head % 1 + b"?") + LIVEZ)
        statuses = [read_whole(stream)[0] for _ in range(302)]
        assert statuses[0] == statuses[-1] == 200
        assert set(statuses[1:-1]) <= {503, 415, 422}
        assert 503 in statuses
        for other in others:
            with other.makefile("rb") as answered:
                assert read_whole(answered)[0] in {200, 503}


def test_what_is_refused_early() -> None:
    """Work, for which there is no room; not where CORS headers are wanted, which come later."""
    service = Service(load_settings(cors_origins="https://a.example", workers=1, queue_size=0))
    early = EarlyRefusals(service).encoded
    scope: dict[str, Any] = {
        "type": "http", "method": "POST", "path": "/v1/poses", "headers": []
    }  # fmt: skip
    done = threading.Event()

    async def scenario() -> None:
        assert early(scope) is None, "a worker is free"
        gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        arrival = Arrival(time.monotonic(), gone)
        computed = asyncio.create_task(service.admission.run("poses", done.wait, arrival))
        await asyncio.sleep(0)
        answer = early(scope)
        assert answer is not None
        assert answer.startswith(b"HTTP/1.1 503 Service Unavailable\r\n")
        assert early(scope | {"headers": [(b"origin", b"https://a.example")]}) is None
        assert early(scope | {"method": "GET"}) is None
        assert early(scope | {"path": "/livez"}) is None
        done.set()
        await computed
        service.admission.close()

    asyncio.run(scenario())
