"""When an agent that restarts ends: after its disk has what the promises of the others rest on, and not much later without it."""

from __future__ import annotations

import logging
import signal
from types import SimpleNamespace
from typing import Any

import pytest

from agent.main_loop import loop
from agent.main_loop.loop import DISK_NS, MainLoop
from agent.system import clock

NS_PER_MS = 1_000_000


def leaving(*, waiting: bool, may_go: bool, unleased: tuple[str, ...] = (), exposed: tuple[str, ...] = ()) -> Any:
    node = SimpleNamespace(may_go=lambda _: may_go, exposed=lambda _: exposed)
    outbox = SimpleNamespace(waiting=waiting, unleased=unleased)
    return SimpleNamespace(_leaves=True, _ends_ns=1 << 60, _disk_ns=0, _node=node, _outbox=outbox)


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
        assert not MainLoop._may_end(one)
        at[0] += DISK_NS - 1
        assert not MainLoop._may_end(one) and not caplog.messages
        at[0] += 1
        assert MainLoop._may_end(one)
    assert [message.split(":")[0] for message in caplog.messages] == ["/a"]


def test_a_disk_that_answers_in_time_and_is_busy_again_later_is_waited_for_anew(at: list[int]) -> None:
    one = leaving(waiting=True, may_go=True)
    assert not MainLoop._may_end(one)
    one._outbox.waiting, one._node.may_go = False, lambda _: False
    at[0] += DISK_NS
    assert not MainLoop._may_end(one)
    one._outbox.waiting, one._node.may_go = True, lambda _: True
    assert not MainLoop._may_end(one)


def test_one_whose_promises_are_there_ends_at_once_and_says_nothing(at: list[int], caplog: pytest.LogCaptureFixture) -> None:
    assert MainLoop._may_end(leaving(waiting=False, may_go=True)) and not caplog.messages


def signalled(*numbers: int, ends_ns: int = 0, is_announced: bool = False) -> Any:
    """A loop to which these signals came at once; ``said``: what it did about them."""
    said: list[str] = []
    one = SimpleNamespace(
        _wake=SimpleNamespace(recv=lambda _: bytes(numbers)),
        _node=object(),
        _worker=SimpleNamespace(send=lambda _: said.append("asks")),
        _leave=lambda: said.append("leaves"),
        _ends_ns=ends_ns,
        _is_announced=is_announced,
        _ending=False,
        said=said,
    )
    MainLoop._heed_signals(one)
    return one


def test_a_restart_that_was_announced_before_systemd_ends_the_agent_waits_for_the_promises_all_the_same() -> None:
    assert signalled(signal.SIGUSR1).said == ["leaves"]
    assert signalled(signal.SIGUSR1, signal.SIGTERM).said == ["leaves"]
    announced = signalled(signal.SIGTERM, ends_ns=1, is_announced=True)
    assert not announced._ending and announced.said == [] and not announced._is_announced
    assert signalled(signal.SIGTERM, ends_ns=1)._ending, "the next one ends it as it is"


def test_an_end_asks_whether_it_is_a_restart_and_an_interrupt_waits_for_nothing() -> None:
    asked = signalled(signal.SIGTERM)
    assert asked.said == ["asks"] and asked._ends_ns and not asked._ending
    assert signalled(signal.SIGINT)._ending and signalled(signal.SIGINT, ends_ns=1, is_announced=True)._ending
    assert signalled(signal.SIGUSR1, ends_ns=1)._ending
