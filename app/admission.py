"""Admission: who may compute, who waits, who is refused at once.

There are as many permits as workers. A request takes a free one and starts; with none free it
waits, unless the queue is full or its turn would come too late for its deadline, which it is told
immediately rather than after waiting in vain. A permit is given back when its thread has really
ended: a client that vanished must not let a further thread in beside the one still computing.

What waits lies in the pool's own queue, whole and ready: a worker that ends goes on with the next
at once, however busy the event loop is refusing others. All bookkeeping happens on the event loop's
thread, so it needs no locks; workers only note when they began.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from app.errors import OverloadedError, PoseMatchError

T = TypeVar("T")

_MEMORY = 0.1
"""Weight of the newest duration in what a kind of work usually takes."""
_DEVIATIONS = 4.0
"""Work counts as lasting so many mean deviations longer than usual when it has to end in time."""


class ClientGoneError(PoseMatchError):
    """The client closed its connection; there is nobody to answer."""


@dataclass(frozen=True)
class Arrival:
    """A request whose body is complete: since when (``time.monotonic`` seconds), and its client.

    ``gone`` completes when the client has closed the connection.
    """

    at_s: float
    gone: asyncio.Future[None]


@dataclass
class _Usual:
    """How long a kind of work takes: running mean and mean deviation, as TCP does (RFC 6298)."""

    mean_s: float = 0.0
    deviation_s: float = 0.0

    @property
    def at_most_s(self) -> float:
        """Nearly always enough."""
        return self.mean_s + _DEVIATIONS * self.deviation_s

    def learn(self, spent_s: float) -> None:
        """Take one more duration into account."""
        off_s = spent_s - self.mean_s
        self.mean_s += _MEMORY * off_s
        self.deviation_s += _MEMORY * (abs(off_s) - self.deviation_s)


@dataclass(eq=False)
class _Job:
    """Accepted work: how long it should take, and since when a worker is at it (None: waiting)."""

    cost_s: float
    began_s: float | None = None


class Admission:
    """Permits in front of a thread pool; see the module's text."""

    def __init__(self, *, workers: int, queue_size: int, deadline_s: float) -> None:
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="posematch-worker")
        self._workers = workers
        self._queue_size = queue_size
        self._deadline_s = deadline_s
        self._jobs: dict[Future[Any], _Job] = {}
        self._usual: dict[str, _Usual] = {}

    @property
    def running(self) -> int:
        """Permits in use."""
        return min(len(self._jobs), self._workers)

    @property
    def waiting(self) -> int:
        """Requests in the queue."""
        return len(self._jobs) - self.running

    def expect(self, kind: str, seconds: float) -> None:
        """Say what ``kind`` of work will usually take (a warm-up's figure)."""
        self._usual[kind] = _Usual(seconds)

    def check(self, kind: str) -> None:
        """Raise the ``OverloadedError`` that a request whose body came now would meet, if any."""
        if self.running == self._workers:
            self._refuse_if_hopeless(self._usual.get(kind, _Usual()), time.monotonic())

    async def run(self, kind: str, work: Callable[[], T], arrival: Arrival, *, units: int = 1) -> T:
        """Run ``work`` on a worker thread and return its result.

        ``kind`` selects what durations are estimated from; ``units`` is how many times the usual
        work this is (images in a batch).
        Raises ``OverloadedError`` when refused, ``ClientGoneError`` when the client has left
        before its turn.
        """
        if arrival.gone.done():
            raise ClientGoneError
        usual = self._usual.get(kind, _Usual())
        wait_s, slack_s = 0.0, None
        if self.running == self._workers:
            wait_s, slack_s = self._refuse_if_hopeless(usual, arrival.at_s)
        job = _Job(units * usual.mean_s)

        def begin() -> T:
            job.began_s = time.monotonic()
            return work()

        thread = self._pool.submit(begin)
        self._jobs[thread] = job
        loop = asyncio.get_running_loop()

        def ended(_: Future[T]) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._end, thread, kind, units)

        thread.add_done_callback(ended)
        answer = asyncio.wrap_future(thread)
        if slack_s is not None:
            await self._turn(thread, answer, arrival, wait_s, slack_s)
        return await answer

    def close(self) -> None:
        """Wait for running threads and end the pool."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    async def _turn(
        self,
        thread: Future[T],
        answer: asyncio.Future[T],
        arrival: Arrival,
        wait_s: float,
        slack_s: float,
    ) -> None:
        """Wait for the answer until the work must have begun; withdraw it when that is too late."""
        either: set[asyncio.Future[Any]] = {answer, arrival.gone}
        try:
            await asyncio.wait(either, timeout=slack_s, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            self._withdraw(thread)
            answer.cancel()
            raise
        if not answer.done() and self._withdraw(thread):
            if arrival.gone.done():
                raise ClientGoneError
            raise self._refusal("deadline", wait_s)

    def _withdraw(self, thread: Future[Any]) -> bool:
        """Take work out of the queue; False when a worker has it already."""
        withdrawn = thread.cancel()
        if withdrawn:
            self._jobs.pop(thread, None)
        return withdrawn

    def _refuse_if_hopeless(self, usual: _Usual, at_s: float) -> tuple[float, float]:
        """How long one more request would wait, and how long it may; or ``OverloadedError``."""
        now_s = time.monotonic()
        backlog_s = 0.0
        for job in self._jobs.values():
            if job.began_s is None:
                backlog_s += job.cost_s
            else:
                backlog_s += max(0.0, job.cost_s - (now_s - job.began_s))
        wait_s = backlog_s / self._workers
        slack_s = at_s + self._deadline_s - usual.at_most_s - now_s
        if self.waiting >= self._queue_size:
            raise self._refusal("queue_full", wait_s)
        if wait_s > slack_s:
            raise self._refusal("deadline", wait_s)
        return wait_s, slack_s

    def _end(self, thread: Future[Any], kind: str, units: int) -> None:
        job = self._jobs.pop(thread, None)
        if job is None or job.began_s is None:  # withdrawn
            return
        spent_s = (time.monotonic() - job.began_s) / units
        self._usual.setdefault(kind, _Usual(spent_s)).learn(spent_s)

    def _refusal(self, reason: str, wait_s: float) -> OverloadedError:
        return OverloadedError(reason, max(1, math.ceil(wait_s)))
