"""A circuit breaker: while an engine is away, callers are told at once instead of waiting in vain.

After a few failures in a row every call is refused; now and then one is let through, and when it
succeeds all are again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from library_store.errors import IndexUnavailableError

T = TypeVar("T")


class Breaker:
    """Guards calls to the engine called ``name``; safe to use from several threads.

    ``tolerated`` failures in a row may happen before it opens, for ``pause_s`` seconds each time.
    """

    def __init__(self, name: str, *, tolerated: int = 2, pause_s: int = 2) -> None:
        self._name = name
        self._tolerated = tolerated
        self._pause_s = pause_s
        self._lock = threading.Lock()
        self._failures = 0
        self._next_try_s = 0.0

    def call(self, work: Callable[[], T], failures: tuple[type[Exception], ...]) -> T:
        """The result of ``work``; one of ``failures`` becomes an ``IndexUnavailableError``."""
        with self._lock:
            if self._failures > self._tolerated:
                now_s = time.monotonic()
                if now_s < self._next_try_s:
                    raise self.refusal("is away")
                # This call finds out for all the others, which are refused meanwhile.
                self._next_try_s = now_s + self._pause_s
        try:
            result = work()
        except failures as error:
            with self._lock:
                self._failures += 1
                self._next_try_s = time.monotonic() + self._pause_s
            raise self.refusal(f"does not answer: {error}") from error
        with self._lock:
            self._failures = 0
        return result

    def refusal(self, what: str) -> IndexUnavailableError:
        """That the engine is away, in the words given."""
        return IndexUnavailableError(f"{self._name} {what}", self._pause_s)
