"""Admission on its own: permits, queue, deadline, clients that leave."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from app.admission import Admission, Arrival, ClientGoneError
from app.errors import OverloadedError
from app.quota import Quota


def run(scenario: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(scenario, 20))


def arrival(gone: asyncio.Future[None] | None = None) -> Arrival:
    return Arrival(time.monotonic(), gone or asyncio.get_running_loop().create_future())


def admission(workers: int = 1, queue_size: int = 4, deadline_s: float = 5.0) -> Admission:
    return Admission(workers=workers, queue_size=queue_size, deadline_s=deadline_s)


def until(done: threading.Event) -> Callable[[], bool]:
    """Work that ends with the event, or soon: the threads of a test that fails must end too."""
    return partial(done.wait, 20)


def test_never_more_threads_than_permits() -> None:
    async def scenario() -> None:
        gate = admission(workers=2, queue_size=20)
        running, most = 0, 0
        lock = threading.Lock()

        def work() -> None:
            nonlocal running, most
            with lock:
                running += 1
                most = max(most, running)
            time.sleep(0.01)
            with lock:
                running -= 1

        await asyncio.gather(*(gate.run("x", work, arrival()) for _ in range(12)))
        assert most == 2
        await asyncio.sleep(0.05)
        assert (gate.running, gate.waiting) == (0, 0)
        gate.close()

    run(scenario())


def refused_at_once(work: Coroutine[Any, Any, object]) -> OverloadedError:
    """What the first step of ``work`` raises: it waits for nothing before."""
    with pytest.raises(OverloadedError) as caught:
        work.send(None)
    return caught.value


def test_a_full_queue_refuses_at_once() -> None:
    async def scenario() -> None:
        gate = admission(queue_size=1)
        done = threading.Event()
        tasks = [asyncio.create_task(gate.run("x", until(done), arrival())) for _ in range(2)]
        await asyncio.sleep(0.02)
        refusal = refused_at_once(gate.run("x", until(done), arrival()))
        assert refusal.reason == "queue_full"
        assert int(refusal.headers["Retry-After"]) >= 1
        done.set()
        await asyncio.gather(*tasks)
        gate.close()

    run(scenario())


def stopped_clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The gate's clock from here on: the seconds in the list, which only the test moves."""
    now_s = [0.0]
    monkeypatch.setattr("app.admission.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    return now_s


def test_refusals_say_how_long_what_lies_ahead_will_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits, and what is left of what runs, shared by the workers; in whole seconds, up."""
    now_s = stopped_clock(monkeypatch)

    async def scenario() -> None:
        gate = admission(workers=2, queue_size=1, deadline_s=100.0)
        gate.expect("x", 4.0)
        begun, done = threading.Semaphore(0), threading.Event()

        def work() -> None:
            begun.release()
            until(done)()

        def come() -> Arrival:
            return Arrival(now_s[0], asyncio.get_running_loop().create_future())

        tasks = [
            asyncio.create_task(gate.run("x", work, come(), units=units)) for units in (1, 1, 3)
        ]
        for _ in range(2):
            await asyncio.to_thread(begun.acquire)
        assert (gate.running, gate.waiting) == (2, 1)
        # 4 + 4 + 12 s of work by two; 2 x 1.5 + 12 later; what should have ended long ago is none.
        for now, wanted in ((0.0, 10), (2.5, 8), (50.0, 6)):
            now_s[0] = now
            refusal = refused_at_once(gate.run("x", until(done), come()))
            assert (refusal.reason, refusal.headers["Retry-After"]) == ("queue_full", str(wanted))
        done.set()
        await asyncio.gather(*tasks)
        gate.close()

    run(scenario())


def test_of_work_of_several_units_is_learned_what_one_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = stopped_clock(monkeypatch)

    async def scenario() -> None:
        gate = admission(queue_size=0, deadline_s=100.0)

        def come() -> Arrival:
            return Arrival(now_s[0], asyncio.get_running_loop().create_future())

        def spend() -> None:
            now_s[0] += 12.0

        await gate.run("x", spend, come(), units=4)
        await asyncio.sleep(0)  # the gate learns how long it took
        done = threading.Event()
        running = asyncio.create_task(gate.run("x", until(done), come()))
        await asyncio.sleep(0.05)
        assert refused_at_once(gate.run("x", until(done), come())).headers["Retry-After"] == "3"
        done.set()
        await running
        gate.close()

    run(scenario())


def test_time_since_the_last_body_byte_counts_to_the_deadline(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = stopped_clock(monkeypatch)

    async def scenario() -> None:
        gate = admission(deadline_s=10.0)
        gate.expect("x", 3.0)
        done = threading.Event()
        running = asyncio.create_task(gate.run("x", until(done), Arrival(0.0, asyncio.Future())))
        await asyncio.sleep(0.05)
        now_s[0] = 1.0
        # 2 s of waiting and 3 s of work: of 10 s the one has 9 left, the other 4.
        in_time = asyncio.create_task(gate.run("x", until(done), Arrival(0.0, asyncio.Future())))
        await asyncio.sleep(0)
        assert gate.waiting == 1
        in_time.cancel()
        await asyncio.sleep(0.05)
        late = Arrival(-5.0, asyncio.Future())
        assert refused_at_once(gate.run("x", until(done), late)).reason == "deadline"
        done.set()
        await running
        gate.close()

    run(scenario())


def test_a_wait_past_the_deadline_is_refused_at_once() -> None:
    async def scenario() -> None:
        gate = admission(deadline_s=0.2)
        gate.expect("x", 0.15)
        done = threading.Event()
        first = asyncio.create_task(gate.run("x", until(done), arrival()))
        await asyncio.sleep(0.01)
        assert refused_at_once(gate.run("x", until(done), arrival())).reason == "deadline"
        done.set()
        await first
        gate.close()

    run(scenario())


def test_work_that_may_take_longer_is_accepted_less_far_ahead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same mean; where durations differ, room is left before the deadline."""
    # On a busy machine no two pieces of work take the same time.
    now_s = stopped_clock(monkeypatch)

    def spend(seconds: float) -> None:
        now_s[0] += seconds

    async def accepted(durations_s: list[float]) -> int:
        gate = admission(queue_size=100, deadline_s=0.5)
        gate.expect("x", sum(durations_s) / len(durations_s))

        def come() -> Arrival:
            return Arrival(now_s[0], asyncio.get_running_loop().create_future())

        for duration_s in durations_s * 15:
            await gate.run("x", partial(spend, duration_s), come())
            await asyncio.sleep(0)  # the gate learns how long it took
        done = threading.Event()
        tasks = [asyncio.create_task(gate.run("x", until(done), come())) for _ in range(60)]
        await asyncio.sleep(0.01)
        waiting = gate.waiting
        done.set()
        await asyncio.gather(*tasks, return_exceptions=True)
        gate.close()
        return waiting

    async def scenario() -> None:
        steady, uneven = await accepted([0.02, 0.02]), await accepted([0.002, 0.038])
        assert 0 < uneven < 0.95 * steady

    run(scenario())


def test_a_turn_that_does_not_come_in_time_is_refused() -> None:
    """The estimate was too hopeful: the work takes longer than it used to."""

    async def scenario() -> None:
        gate = admission(deadline_s=0.1)
        gate.expect("x", 0.001)
        done = threading.Event()
        first = asyncio.create_task(gate.run("x", until(done), arrival()))
        await asyncio.sleep(0.01)
        with pytest.raises(OverloadedError):
            await gate.run("x", until(done), arrival())
        assert gate.waiting == 0
        done.set()
        await first
        gate.close()

    run(scenario())


def test_with_a_worker_free_nothing_is_refused() -> None:
    async def scenario() -> None:
        gate = admission(deadline_s=0.001)
        gate.expect("x", 10.0)
        assert await gate.run("x", lambda: 7, arrival()) == 7
        gate.close()

    run(scenario())


def test_work_of_clients_that_left_is_never_started() -> None:
    async def scenario() -> None:
        gate = admission()
        done, ran = threading.Event(), threading.Event()
        first = asyncio.create_task(gate.run("x", until(done), arrival()))
        gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        second = asyncio.create_task(gate.run("x", ran.set, arrival(gone)))
        await asyncio.sleep(0.01)
        gone.set_result(None)
        with pytest.raises(ClientGoneError):
            await second
        done.set()
        await first
        with pytest.raises(ClientGoneError):
            await gate.run("x", ran.set, arrival(gone))
        assert not ran.is_set()
        gate.close()

    run(scenario())


def test_a_cancelled_request_keeps_its_permit_until_the_thread_ends() -> None:
    async def scenario() -> None:
        gate = admission(queue_size=0)
        done = threading.Event()
        first = asyncio.create_task(gate.run("x", until(done), arrival()))
        await asyncio.sleep(0.01)
        first.cancel()
        await asyncio.sleep(0.01)
        assert first.cancelled()
        assert gate.running == 1
        with pytest.raises(OverloadedError):
            await gate.run("x", until(done), arrival())
        done.set()
        await asyncio.sleep(0.05)
        assert gate.running == 0
        gate.close()

    run(scenario())


def test_a_cancelled_wait_leaves_the_queue() -> None:
    async def scenario() -> None:
        gate = admission()
        done = threading.Event()
        first = asyncio.create_task(gate.run("x", until(done), arrival()))
        second = asyncio.create_task(gate.run("x", until(done), arrival()))
        await asyncio.sleep(0.01)
        second.cancel()
        await asyncio.sleep(0.01)
        assert gate.waiting == 0
        done.set()
        await first
        await asyncio.sleep(0.05)
        assert gate.running == 0
        gate.close()

    run(scenario())


def test_a_worker_goes_on_with_what_waits_while_the_event_loop_is_busy() -> None:
    async def scenario() -> None:
        gate = admission()
        last = threading.Event()
        tasks = [
            asyncio.create_task(gate.run("x", work, arrival()))
            for work in (lambda: time.sleep(0.02), lambda: None, last.set)
        ]
        await asyncio.sleep(0.005)
        assert (gate.running, gate.waiting) == (1, 2)
        assert last.wait(5), "all three are done without the loop, which waits here"
        await asyncio.gather(*tasks)
        await asyncio.sleep(0.01)
        assert (gate.running, gate.waiting) == (0, 0)
        gate.close()

    run(scenario())


def test_work_withdrawn_at_its_deadline_is_never_started() -> None:
    async def scenario() -> None:
        gate = admission(deadline_s=0.1)
        gate.expect("x", 0.001)
        done, ran = threading.Event(), threading.Event()
        first = asyncio.create_task(gate.run("x", until(done), arrival()))
        await asyncio.sleep(0.01)
        with pytest.raises(OverloadedError) as caught:
            await gate.run("x", ran.set, arrival())
        assert caught.value.reason == "deadline"
        done.set()
        await first
        gate.close()
        assert not ran.is_set()

    run(scenario())


def test_errors_of_the_work_come_back_and_free_the_permit() -> None:
    async def scenario() -> None:
        gate = admission()

        def fail() -> None:
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            await gate.run("x", fail, arrival())
        await asyncio.sleep(0.02)
        assert gate.running == 0
        gate.close()

    run(scenario())


def test_quota_refills_steadily() -> None:
    now = 0.0
    quota = Quota([b"a", b"b"], per_minute=2, clock=lambda: now)
    assert [quota.take(b"a") for _ in range(3)] == [None, None, 30]
    assert quota.take(b"b") is None
    now = 29.0
    assert quota.take(b"a") == 1
    now = 30.5
    assert quota.take(b"a") is None
    now = 1e6
    assert [quota.take(b"a") for _ in range(3)] == [None, None, 30], "no more than a minute's worth"
