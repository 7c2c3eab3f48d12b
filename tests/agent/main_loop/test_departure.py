"""When an agent that restarts ends: after its disk has what the promises of the others rest on, and not much later without it."""

from __future__ import annotations

import logging
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
