from __future__ import annotations

import pytest

from library_store.breaker import Breaker
from library_store.errors import IndexUnavailableError


class Engine:
    """Fails while it is away, and counts how often it is asked."""

    def __init__(self) -> None:
        self.away = False
        self.calls = 0

    def ask(self) -> int:
        self.calls += 1
        if self.away:
            raise ConnectionError("refused")
        return self.calls


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("library_store.breaker.time.monotonic", lambda: now[0])
    return now


def fail(breaker: Breaker, engine: Engine) -> IndexUnavailableError:
    with pytest.raises(IndexUnavailableError, match="the engine") as caught:
        breaker.call(engine.ask, (ConnectionError,))
    return caught.value


def test_it_opens_after_a_few_failures_and_closes_by_itself(clock: list[float]) -> None:
    engine, breaker = Engine(), Breaker("the engine", tolerated=1, pause_s=2)
    assert breaker.call(engine.ask, (ConnectionError,)) == 1
    engine.away = True
    for _ in range(2):
        error = fail(breaker, engine)
        assert isinstance(error.__cause__, ConnectionError)
        assert error.retry_after_s == 2
    assert engine.calls == 3
    # Open: nobody is asked.
    assert fail(breaker, engine).__cause__ is None
    assert engine.calls == 3
    # After the pause one call finds out, the next is refused again.
    clock[0] += 2.5
    fail(breaker, engine)
    fail(breaker, engine)
    assert engine.calls == 4
    clock[0] += 2.5
    engine.away = False
    assert breaker.call(engine.ask, (ConnectionError,)) == 5
    assert breaker.call(engine.ask, (ConnectionError,)) == 6


def test_a_failure_now_and_then_is_no_outage(clock: list[float]) -> None:
    engine, breaker = Engine(), Breaker("the engine", tolerated=1, pause_s=2)
    for _ in range(5):
        engine.away = True
        fail(breaker, engine)
        engine.away = False
        breaker.call(engine.ask, (ConnectionError,))
    assert engine.calls == 10
    assert clock[0] == 100.0


def test_only_one_finds_out_while_it_is_away(clock: list[float]) -> None:
    engine, breaker = Engine(), Breaker("the engine", tolerated=0, pause_s=2)
    engine.away = True
    fail(breaker, engine)
    clock[0] += 3.0

    def ask_while_another_does() -> int:
        fail(breaker, engine)
        return engine.calls

    assert breaker.call(ask_while_another_does, (ConnectionError,)) == 1


def test_other_errors_pass(clock: list[float]) -> None:  # noqa: ARG001
    def broken() -> None:
        raise KeyError("a bug")

    with pytest.raises(KeyError):
        Breaker("the engine").call(broken, (ConnectionError,))
