"""Admission: who may compute, who waits, who is refused at once.

There are as many permits as workers. A request takes a free one and starts; with none free it
waits, unless the queue is full or its turn would come too late for its deadline, which it is told
immediately rather than after waiting in vain. A permit is given back when its thread has really
ended: a client that vanished must not let a further thread in beside the one still computing.

All bookkeeping happens on the event loop's thread, so it needs no locks.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from app.errors import OverloadedError, PoseMatchError

T = TypeVar("T")

_MEMORY = 0.1
"""Weight of the newest duration in the running mean of a kind of work."""


class ClientGoneError(PoseMatchError):
    """The client closed its connection; there is nobody to answer."""


@dataclass(frozen=True)
class Arrival:
    """A request whose body is complete: since when (``time.monotonic`` seconds), and its client.

    ``gone`` completes when the client has closed the connection.
    """

    at_s: float
    gone: asyncio.Future[None]


@dataclass(eq=False)
class _Waiter:
    turn: asyncio.Future[None]
    cost_s: float


class Admission:
    """Permits in front of a thread pool; see the module's text."""

    def __init__(self, *, workers: int, queue_size: int, deadline_s: float) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="posematch-worker")
        self._workers = workers
        self._free = workers
        self._queue_size = queue_size
        self._deadline_s = deadline_s
        self._waiting: deque[_Waiter] = deque()
        self._ends_s: dict[Future[Any], float] = {}
        self._mean_s: dict[str, float] = {}

    @property
    def running(self) -> int:
        """Permits in use."""
        return self._workers - self._free

    @property
    def waiting(self) -> int:
        """Requests in the queue."""
        return len(self._waiting)

    def expect(self, kind: str, seconds: float) -> None:
        """Start the running mean of ``kind`` of work at ``seconds`` (a warm-up's figure)."""
        self._mean_s[kind] = seconds

    def check(self, kind: str) -> None:
        """Raise the ``OverloadedError`` that a request whose body came now would meet, if any."""
        if not self._free:
            self._refuse_if_hopeless(self._mean_s.get(kind, 0.0), time.monotonic())

    async def run(self, kind: str, work: Callable[[], T], arrival: Arrival, *, units: int = 1) -> T:
        """Run ``work`` on a worker thread and return its result.

        ``kind`` selects the running mean durations are estimated from; ``units`` is how many
        times the usual work this is (images in a batch).
        Raises ``OverloadedError`` when refused, ``ClientGoneError`` when the client has left
        before its turn.
        """
        await self._acquire(self._mean_s.get(kind, 0.0), units, arrival)
        started_s = time.monotonic()
        try:
            thread: Future[T] = self._pool.submit(work)
        except BaseException:
            self._release()
            raise
        loop = asyncio.get_running_loop()
        self._ends_s[thread] = started_s + units * self._mean_s.get(kind, 0.0)

        def ended(_: Future[T]) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._end, thread, kind, started_s, units)

        thread.add_done_callback(ended)
        return await asyncio.wrap_future(thread)

    def close(self) -> None:
        """Wait for running threads and end the pool."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    async def _acquire(self, unit_s: float, units: int, arrival: Arrival) -> None:
        if arrival.gone.done():
            raise ClientGoneError
        if self._free:
            self._free -= 1
            return
        wait_s, slack_s = self._refuse_if_hopeless(unit_s, arrival.at_s)
        waiter = _Waiter(asyncio.get_running_loop().create_future(), units * unit_s)
        self._waiting.append(waiter)
        try:
            await asyncio.wait(
                {waiter.turn, arrival.gone},
                timeout=slack_s,
                return_when=asyncio.FIRST_COMPLETED,
            )
        except asyncio.CancelledError:
            self._leave(waiter)
            raise
        if arrival.gone.done():
            self._leave(waiter)
            raise ClientGoneError
        if not waiter.turn.done():
            self._leave(waiter)
            raise self._refusal("deadline", wait_s)

    def _refuse_if_hopeless(self, unit_s: float, at_s: float) -> tuple[float, float]:
        """How long one more request would wait, and how long it may; or ``OverloadedError``."""
        now_s = time.monotonic()
        backlog_s = sum(waiter.cost_s for waiter in self._waiting)
        backlog_s += sum(max(0.0, end_s - now_s) for end_s in self._ends_s.values())
        wait_s = backlog_s / self._workers
        slack_s = at_s + self._deadline_s - unit_s - now_s
        if len(self._waiting) >= self._queue_size:
            raise self._refusal("queue_full", wait_s)
        if wait_s > slack_s:
            raise self._refusal("deadline", wait_s)
        return wait_s, slack_s

    def _leave(self, waiter: _Waiter) -> None:
        """Give up a place in the queue, or the permit that was granted meanwhile."""
        if waiter.turn.done():
            self._release()
        else:
            self._waiting.remove(waiter)

    def _end(self, thread: Future[Any], kind: str, started_s: float, units: int) -> None:
        del self._ends_s[thread]
        spent_s = (time.monotonic() - started_s) / units
        mean_s = self._mean_s.get(kind, spent_s)
        self._mean_s[kind] = mean_s + _MEMORY * (spent_s - mean_s)
        self._release()

    def _release(self) -> None:
        if self._waiting:
            self._waiting.popleft().turn.set_result(None)
        else:
            self._free += 1

    def _refusal(self, reason: str, wait_s: float) -> OverloadedError:
        return OverloadedError(reason, max(1, math.ceil(wait_s)))
