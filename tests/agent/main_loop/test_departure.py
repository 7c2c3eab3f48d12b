"""When an agent that restarts ends: after its disk has what the promises of the others rest on, and not much later without it."""

from __future__ import annotations

import logging
import signal
from types import SimpleNamespace
from typing import Any

import pytest

from agent.main_loop import loop
from agent.main_loop.departure import ASK_NS, DISK_NS, STOP_S, Departure, Next
from agent.main_loop.loop import MainLoop
from agent.system import clock

GRACE_NS = 1 << 60


def leaving(*, waiting: bool, may_go: bool, unleased: tuple[str, ...] = (), exposed: tuple[str, ...] = ()) -> Any:
    """A loop whose agent restarts."""
    node = SimpleNamespace(may_go=lambda _: may_go, exposed=lambda _: exposed)
    departure = Departure(GRACE_NS)
    assert departure.signalled(bytes([signal.SIGUSR1]), 0) is Next.ANNOUNCE
    return SimpleNamespace(_departure=departure, _node=node, _outbox=SimpleNamespace(waiting=waiting, unleased=unleased))


def may_end(one: Any) -> bool:
    return MainLoop._may_end(one, one._node)


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Any:
    now = [1]
    monkeypatch.setattr(clock, "now_ns", lambda: now[0])
    return now


def test_it_waits_for_its_disk_two_seconds_then_ends_and_names_what_stands_still(
    at: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    one = leaving(waiting=True, may_go=True, unleased=("/a",))
    with caplog.at_level(logging.WARNING, logger=loop.log.name):
        assert not may_end(one)
        at[0] += DISK_NS - 1
        assert not may_end(one) and not caplog.messages
        at[0] += 1
        assert may_end(one)
    assert [message.split(":")[0] for message in caplog.messages] == ["/a"]


def test_a_disk_that_answers_in_time_and_is_busy_again_later_is_waited_for_anew(at: list[int]) -> None:
    one = leaving(waiting=True, may_go=True)
    assert not may_end(one)
    one._outbox.waiting, one._node.may_go = False, lambda _: False
    at[0] += DISK_NS
    assert not may_end(one)
    one._outbox.waiting, one._node.may_go = True, lambda _: True
    assert not may_end(one)


def test_one_whose_promises_are_there_ends_at_once_and_says_nothing(at: list[int], caplog: pytest.LogCaptureFixture) -> None:
    assert may_end(leaving(waiting=False, may_go=True)) and not caplog.messages


def begun() -> Departure:
    """An end that was asked for, of which is not known yet whether it is a restart."""
    departure = Departure(GRACE_NS)
    assert departure.signalled(bytes([signal.SIGTERM]), 0) is Next.ASK and departure.is_begun
    return departure


def announced() -> Departure:
    departure = Departure(GRACE_NS)
    assert departure.signalled(bytes([signal.SIGUSR1]), 0) is Next.ANNOUNCE
    return departure


TERM, INTERRUPT, COMES_BACK = bytes([signal.SIGTERM]), bytes([signal.SIGINT]), bytes([signal.SIGUSR1])


def test_a_restart_that_was_announced_before_systemd_ends_the_agent_waits_for_the_promises_all_the_same() -> None:
    assert Departure(GRACE_NS).signalled(COMES_BACK, 0) is Next.ANNOUNCE
    assert Departure(GRACE_NS).signalled(COMES_BACK + TERM, 0) is Next.ANNOUNCE
    one = announced()
    assert one.signalled(TERM, 1) is Next.GO_ON
    assert one.signalled(TERM, 2) is Next.END, "the next one ends it as it is"


def test_an_end_asks_whether_it_is_a_restart_and_an_interrupt_waits_for_nothing() -> None:
    assert not begun().may_end(False, False, ASK_NS - 1) and begun().may_end(False, False, ASK_NS)
    assert Departure(GRACE_NS).signalled(INTERRUPT, 0) is announced().signalled(INTERRUPT, 1) is Next.END
    assert begun().signalled(COMES_BACK, 1) is announced().signalled(COMES_BACK, 1) is Next.END


def test_the_answer_whether_it_is_a_restart_ends_it_or_has_it_announced_once() -> None:
    assert begun().answered(is_restart=False, now_ns=1) is Next.END
    one = begun()
    assert not one.needs_s(1)
    assert one.answered(is_restart=True, now_ns=1) is Next.ANNOUNCE and one.is_restart
    assert one.answered(is_restart=False, now_ns=2) is Next.GO_ON, "the peers are asked already"
    assert one.needs_s(2) == STOP_S and not one.needs_s(3) and one.needs_s(2 + STOP_S * 10**9) == STOP_S
