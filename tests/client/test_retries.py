"""Patience: what is tried again, when, and for how long, with a clock and a server of our own."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import anyio
import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from posematch_client import AsyncClient, Client, RefusedError, Retries, UnreachableError
from posematch_client.retries import RETRIED_STATUSES, Attempts, retry_after_s

URL = "http://service"
QUICK = Retries(deadline_s=5.0, first_pause_s=0.001, longest_pause_s=0.002)
Handler = Callable[[httpx.Request], httpx.Response]


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def refusal(status: int, **headers: str) -> httpx.Response:
    problem = {"type": "urn:posematch:problem:overloaded", "detail": "busy", "request_id": "r1"}
    kind = {"Content-Type": "application/problem+json"}
    return httpx.Response(status, headers={**kind, **headers}, content=json.dumps(problem))


class Script:
    """A server that answers by the list, and then well; it remembers what it was asked."""

    def __init__(self, *steps: httpx.Response | Exception) -> None:
        self.steps = list(steps)
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.requests.append(request)
        if not self.steps:
            return httpx.Response(200, json={"people": []})
        step = self.steps.pop(0)
        if isinstance(step, Exception):
            raise step
        return step


def ask(script: Handler, retries: Retries, way: str) -> object:
    """One call of ``poses``, by the synchronous or the asynchronous client."""
    transport = httpx.MockTransport(script)
    if way == "sync":
        with Client(URL, retries=retries, transport=transport) as client:
            return client.poses(b"photo", max_people=2)

    async def run() -> object:
        async with AsyncClient(URL, retries=retries, transport=transport) as client:
            return await client.poses(b"photo", max_people=2)

    return anyio.run(run)


both_ways = pytest.mark.parametrize("way", ["sync", "async"])


@both_ways
def test_the_same_is_asked_again(way: str) -> None:
    script = Script(
        refusal(503, **{"Retry-After": "0"}), httpx.ConnectError("gone"), refusal(502), refusal(429)
    )
    assert ask(script, QUICK, way) == {"people": []}
    assert len(script.requests) == 5
    assert {(it.url.path, it.url.query, it.content) for it in script.requests} == {
        ("/v1/poses", b"max_people=2", b"photo")
    }


@both_ways
@pytest.mark.parametrize("status", [400, 401, 404, 408, 413, 415, 422, 500])
def test_what_will_not_change_is_not_asked_again(way: str, status: int) -> None:
    script = Script(refusal(status))
    with pytest.raises(RefusedError) as caught:
        ask(script, QUICK, way)
    assert (caught.value.status, caught.value.slug) == (status, "overloaded")
    assert (caught.value.detail, caught.value.request_id) == ("busy", "r1")
    assert len(script.requests) == 1


@both_ways
def test_too_long_a_wait_is_the_last_word(way: str) -> None:
    script = Script(refusal(503, **{"Retry-After": "3600"}))
    with pytest.raises(RefusedError) as caught:
        ask(script, QUICK, way)
    assert caught.value.retry_after_s == 3600
    assert len(script.requests) == 1


@both_ways
def test_attempts_end(way: str) -> None:
    retries = Retries(attempts=3, first_pause_s=0.001)
    with pytest.raises(RefusedError):
        ask(Script(*[refusal(503)] * 9), retries, way)
    script = Script(*[httpx.ReadError("cut")] * 9)
    with pytest.raises(UnreachableError, match="3 tries: cut") as caught:
        ask(script, retries, way)
    assert isinstance(caught.value.__cause__, httpx.ReadError)
    assert len(script.requests) == 3


@both_ways
def test_a_proxy_without_a_problem(way: str) -> None:
    page = httpx.Response(400, headers={"Content-Type": "text/html"}, content="<h1>no</h1>")
    with pytest.raises(RefusedError) as caught:
        ask(Script(page), QUICK, way)
    assert (caught.value.status, caught.value.slug, caught.value.problem) == (400, "", {})
    html = httpx.Response(200, headers={"Content-Type": "text/html"}, content="<h1>hello</h1>")
    with pytest.raises(RefusedError):
        ask(Script(html), QUICK, way)


@both_ways
def test_a_redirect_says_where_to(way: str) -> None:
    moved = httpx.Response(308, headers={"Location": "https://service/v1/poses"})
    with pytest.raises(RefusedError, match="308: sent on to https://service/v1/poses: give"):
        ask(Script(moved), QUICK, way)


@both_ways
def test_a_proxy_that_lost_its_replica(way: str) -> None:
    lost = httpx.Response(500, headers={"Content-Type": "text/plain"}, content="Internal error")
    script = Script(lost, lost)
    assert ask(script, QUICK, way) == {"people": []}
    assert len(script.requests) == 3


@given(
    asked=st.none() | st.integers(0, 400),
    spent_s=st.floats(0, 60),
    share=st.floats(0, 1),
    made=st.integers(0, 12),
)
def test_pauses(asked: int | None, spent_s: float, share: float, made: int) -> None:
    """Never earlier than asked, at most a quarter later, never beyond the deadline."""
    retries = Retries(deadline_s=50, attempts=10, first_pause_s=0.2, longest_pause_s=5)
    clock = Clock()
    attempts = Attempts(retries, clock, lambda low, high: low + share * (high - low))
    for _ in range(made):
        attempts.pause_after(refusal(503))
    clock.now_s += spent_s
    pause = attempts.pause_after(
        refusal(503, **({} if asked is None else {"Retry-After": str(asked)}))
    )
    if pause is None:
        least = 0.0 if asked is None else asked
        most = 5.0 if asked is None else asked + max(asked, 1) / 4
        assert made + 1 >= retries.attempts or spent_s + most >= retries.deadline_s - 1e-6
        assert least <= most
        return
    assert spent_s + pause < retries.deadline_s
    if asked is None:
        assert 0 <= pause <= min(0.2 * 2**made, 5.0)
    else:
        assert asked <= pause <= asked + max(asked, 1) / 4


def test_time_left_is_the_timeout_of_a_try() -> None:
    clock = Clock()
    attempts = Attempts(Retries(deadline_s=8), clock)
    assert attempts.left_s() == 8
    clock.now_s += 6
    assert attempts.left_s() == 2
    clock.now_s += 6
    assert 0 < attempts.left_s() < 0.01


def test_retry_after_is_seconds_or_a_date() -> None:
    soon = format_datetime(datetime.now(UTC) + timedelta(seconds=30), usegmt=True)
    seconds = retry_after_s(refusal(503, **{"Retry-After": soon}))
    assert seconds is not None
    assert 25 < seconds <= 30
    past = format_datetime(datetime(2001, 1, 1, tzinfo=UTC), usegmt=True)
    for text, expected in (("7", 7.0), (past, 0.0), ("soon", None), ("-3", None), ("", None)):
        assert retry_after_s(refusal(503, **{"Retry-After": text})) == expected
    assert retry_after_s(refusal(503)) is None


def test_senseless_patience() -> None:
    for bad in ({"deadline_s": 0}, {"attempts": 0}):
        with pytest.raises(ValueError, match="attempts"):
            Retries(**bad)
    assert 408 not in RETRIED_STATUSES


@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_a_key_that_no_header_takes_is_refused_at_once(kind: type[Client | AsyncClient]) -> None:
    with pytest.raises(ValueError, match="api_key has characters other than ASCII"):
        kind("http://127.0.0.1:1", api_key="schlüssel-0123456789")


@pytest.mark.parametrize("way", ["sync", "async"])
def test_readiness_is_waited_for_until_the_deadline(way: str) -> None:
    """However many tries other calls have: a first start takes minutes."""
    script = Script(*[refusal(503) for _ in range(5)])
    transport = httpx.MockTransport(script)
    once = Retries(deadline_s=5.0, attempts=1, first_pause_s=0.001, longest_pause_s=0.002)
    if way == "sync":
        with Client(URL, retries=once, transport=transport) as client:
            client.wait_until_ready()
    else:

        async def wait() -> None:
            async with AsyncClient(URL, retries=once, transport=transport) as client:
                await client.wait_until_ready()

        anyio.run(wait)
    assert len(script.requests) == 6


def test_pauses_stay_numbers_however_many_tries() -> None:
    clock = Clock()
    attempts = Attempts(Retries(deadline_s=1e9).until_deadline(), clock, lambda _, most: most)
    pauses = [attempts.pause_after(refusal(502)) for _ in range(1100)]
    assert pauses[-1] == Retries().longest_pause_s


@both_ways
@pytest.mark.parametrize(
    "error",
    [
        httpx.UnsupportedProtocol("Request URL is missing an 'http://' or 'https://' protocol."),
        httpx.LocalProtocolError("Illegal header value b'Bearer key\\n'"),
    ],
)
def test_what_cannot_be_sent_is_not_tried_again(way: str, error: Exception) -> None:
    script = Script(error)
    with pytest.raises(UnreachableError, match=r"cannot be sent: (Request URL|Illegal header)"):
        ask(script, QUICK, way)
    assert len(script.requests) == 1


def test_an_address_without_its_protocol_is_said() -> None:
    said = pytest.raises(UnreachableError, match="cannot be sent")
    with Client("127.0.0.1:8000", retries=QUICK) as client, said:
        client.info()


@both_ways
def test_an_answer_that_cannot_be_unpacked_is_asked_for_again(way: str) -> None:
    script = Script(httpx.DecodingError("incorrect header check"))
    assert ask(script, QUICK, way) == {"people": []}
    with pytest.raises(UnreachableError, match="incorrect header check"):
        ask(Script(httpx.DecodingError("incorrect header check")), Retries(attempts=1), way)


def test_a_date_beyond_all_calendars_is_no_date() -> None:
    text = "1 Jan 99999999999999999999 00:00:00 GMT"
    assert retry_after_s(refusal(503, **{"Retry-After": text})) is None


def test_refusals_come_through_process_pools() -> None:
    error = RefusedError(503, {"type": "urn:posematch:problem:overloaded", "detail": "busy"}, 2.0)
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) == "503: busy"
    assert (again.status, again.slug, again.retry_after_s) == (503, "overloaded", 2.0)
