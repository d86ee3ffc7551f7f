"""When to try again: every question to the service may be asked twice, it changes nothing there."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

import httpx

from posematch_client.errors import RefusedError, UnreachableError

RETRIED_STATUSES = frozenset({429, 502, 503, 504})
_HOPELESS = (httpx.UnsupportedProtocol, httpx.LocalProtocolError)
"""Errors of the request itself, such as an address without http:// or a key with a line's end."""
_DOUBLINGS = 100
"""Of the pause at most: no number holds a thousand."""


@dataclass(frozen=True)
class Retries:
    """How patient a client is.

    Args:
        deadline_s: from the call to the last moment at which it still waits or tries.
        attempts: most tries of a call; 1 never tries again.
        first_pause_s: where the server does not say how long to wait, pauses are random between 0
            and this, doubled after every try (so that many clients do not come back at once).
        longest_pause_s: where that doubling ends.

    What the server says (Retry-After) is kept to: up to a quarter is added, nothing taken off. If
    it exceeds the time left, the call ends at once with what the server said.

    """

    deadline_s: float = 30.0
    attempts: int = 10
    first_pause_s: float = 0.2
    longest_pause_s: float = 5.0

    def __post_init__(self) -> None:
        if self.deadline_s <= 0 or self.attempts < 1:
            raise ValueError("deadline_s must be positive and attempts at least 1")

    def until_deadline(self) -> Retries:
        """The same with only the deadline as an end."""
        return replace(self, attempts=sys.maxsize)


class Attempts:
    """The tries of one call."""

    def __init__(
        self,
        retries: Retries,
        clock: Callable[[], float] = time.monotonic,
        uniform: Callable[[float, float], float] = random.uniform,
    ) -> None:
        self._retries = retries
        self._clock = clock
        self._uniform = uniform
        self._end_s = clock() + retries.deadline_s
        self._made = 0

    def left_s(self) -> float:
        """Time until the deadline, at least a little, as the timeout of a try."""
        return max(self._end_s - self._clock(), 0.001)

    def pause_after(self, response: httpx.Response) -> float | None:
        """How long to wait before the next try; None when this answer is the last word."""
        if response.status_code not in RETRIED_STATUSES and not _is_of_a_proxy(response):
            return None
        return self._pause(retry_after_s(response))

    def pause_after_failure(self, error: httpx.RequestError) -> float:
        """How long to wait before the next try; ``UnreachableError`` when there is none."""
        said = str(error) or type(error).__name__
        if isinstance(error, _HOPELESS):
            raise UnreachableError(f"cannot be sent: {said}") from error
        pause = self._pause(None)
        if pause is None:
            raise UnreachableError(f"no answer after {self._made} tries: {said}") from error
        return pause

    def _pause(self, asked_s: float | None) -> float | None:
        self._made += 1
        if asked_s is None:
            doubled = self._retries.first_pause_s * 2.0 ** min(self._made - 1, _DOUBLINGS)
            pause = self._uniform(0.0, min(doubled, self._retries.longest_pause_s))
        else:
            pause = asked_s + self._uniform(0.0, max(asked_s, 1.0) / 4)
        is_over = self._made >= self._retries.attempts or self._clock() + pause >= self._end_s
        return None if is_over else pause


def _is_of_a_proxy(response: httpx.Response) -> bool:
    """Whether this is a 500 not of the service's own making, whose errors are all problem+json.

    Ray Serve's proxy answers so when the replica that had the request has died.
    """
    kind = response.headers.get("content-type", "")
    return response.status_code == 500 and not kind.startswith("application/problem+json")


def retry_after_s(response: httpx.Response) -> float | None:
    """The header Retry-After in seconds, which may also be a date; None without a sensible one."""
    text = response.headers.get("retry-after", "").strip()
    if text.isdecimal():
        return float(text)
    try:
        when = parsedate_to_datetime(text)
    except (ValueError, OverflowError):
        return None
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    return max(0.0, (when - datetime.now(UTC)).total_seconds())


def parsed(response: httpx.Response) -> object:
    """The JSON of a good answer; ``RefusedError`` for all others."""
    is_json = "json" in response.headers.get("content-type", "")
    try:
        body = response.json() if is_json else None
    except ValueError:
        body = None
    if response.is_success and body is not None:
        return body
    problem = body if isinstance(body, dict) else {}
    if response.has_redirect_location and not problem:
        # Not followed: every photo, and the key, would be sent twice.
        there = response.headers["location"]
        problem = {"detail": f"sent on to {there}: give the client that address"}
    raise RefusedError(response.status_code, problem, retry_after_s(response))
