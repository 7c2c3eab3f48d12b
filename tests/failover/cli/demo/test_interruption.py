"""Ctrl-C: at once where that is allowed, afterwards where it is held, once only."""

from __future__ import annotations

import os
import signal

import pytest

from failover.cli.demo.interruption import NUMBERS, Interruption


def interrupt(number: signal.Signals = signal.SIGINT) -> None:
    """Have the signal delivered before this returns (signal(7): to a thread of a process that sends it to itself)."""
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", NUMBERS)
def test_an_interruption_is_raised_where_it_is_allowed(number: signal.Signals) -> None:
    interruption = Interruption()
    with interruption.noted(), pytest.raises(KeyboardInterrupt), interruption.allowed():
        interrupt(number)


def test_what_is_begun_is_noted_before_the_interruption_is_raised() -> None:
    interruption, begun = Interruption(), []

    def begin() -> None:
        with interruption.held():
            interrupt()
            begun.append("a robot")
        begun.append("the next robot")

    with interruption.noted(), interruption.allowed(), pytest.raises(KeyboardInterrupt):
        begin()
    assert begun == ["a robot"]


def test_an_interruption_before_the_play_ends_it_at_its_beginning() -> None:
    interruption, played = Interruption(), []

    def play() -> None:
        with interruption.allowed():
            played.append("an act")

    with interruption.noted():
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            play()
    assert played == []


def test_a_second_interruption_does_not_disturb_the_ending() -> None:
    interruption, ended = Interruption(), []
    with interruption.noted():
        try:
            with pytest.raises(KeyboardInterrupt), interruption.allowed():
                interrupt()
        finally:
            interrupt()
            ended.append("every robot")
    assert ended == ["every robot"]


def test_when_a_beginning_fails_nothing_interrupts_the_ending() -> None:
    interruption, ended = Interruption(), []

    def begin() -> None:
        try:
            with interruption.held():
                raise OSError("no robot")
        finally:
            interrupt()
            ended.append("every robot")

    with interruption.noted(), interruption.allowed(), pytest.raises(OSError, match="no robot"):
        begin()
    assert ended == ["every robot"]


def test_the_signals_do_afterwards_what_they_did_before() -> None:
    before = [signal.getsignal(number) for number in NUMBERS]
    with Interruption().noted():
        assert [signal.getsignal(number) for number in NUMBERS] != before
    assert [signal.getsignal(number) for number in NUMBERS] == before
