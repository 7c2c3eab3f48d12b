"""The agent's timer: when it rings, and when it does not."""

from __future__ import annotations

import select
from collections.abc import Iterator

import pytest

from agent.system import clock, timers

FAR_NS = 3_600_000_000_000


@pytest.fixture
def alarm() -> Iterator[timers.Alarm]:
    """One that is not set."""
    made = timers.Alarm()
    yield made
    made.close()


def rings(alarm: timers.Alarm, patience_ms: int = 0) -> bool:
    """Whether it is readable within so long."""
    waiting = select.poll()
    waiting.register(alarm.fileno(), select.POLLIN)
    return bool(waiting.poll(patience_ms))


def test_it_rings_at_its_instant_and_never_before(alarm: timers.Alarm) -> None:
    for ahead_ns in (50_000, 1_300_000, 2_999_999):
        at_ns = clock.now_ns() + ahead_ns
        alarm.set(at_ns)
        assert rings(alarm, 60_000)
        assert clock.now_ns() >= at_ns


def test_an_instant_that_is_over_rings_until_another_is_set(alarm: timers.Alarm) -> None:
    past_ns = clock.now_ns() - 1
    for _ in range(3):
        alarm.set(past_ns)
        assert rings(alarm, 60_000)
    alarm.set(clock.now_ns() + FAR_NS)
    assert not rings(alarm)


@pytest.mark.parametrize("at_ns", [0, -1, -FAR_NS])
def test_an_instant_before_the_clock_began_rings_at_once(alarm: timers.Alarm, at_ns: int) -> None:
    alarm.set(at_ns)
    assert rings(alarm, 60_000)


def test_without_an_instant_it_does_not_ring(alarm: timers.Alarm) -> None:
    assert not rings(alarm)
    alarm.set(clock.now_ns())
    assert rings(alarm, 60_000)
    alarm.set(None)
    assert not rings(alarm)
