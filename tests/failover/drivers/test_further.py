"""A driver that calls another one while it carries out a message: the way goes on, and `failover path` shows it."""

from __future__ import annotations

import json
import threading

import pytest

import failover
from failover.cli import main
from failover.core.messaging.envelope import HOPS_MAX, Hop
from failover.drivers.here import Here
from failover.drivers.in_hand import carrying_out, hops_so_far
from failover.errors import CallRefusedError
from tests.failover.drivers.serving import called, serving


@failover.driver("Lab/Lamp", alias="lamp")
class Lamp:
    @failover.query
    def shine(self, seconds: int) -> int:
        return seconds


@failover.driver("Lab/Room", alias="room")
class Room:
    @failover.query
    def light(self, here: bool) -> list[int]:
        found: list[int] = []

        def shine() -> None:
            with failover.proxy("lamp") as lamp:
                found.extend(lamp.call("shine", seconds) for seconds in (1, 2))

        if here:
            shine()
        else:
            other = threading.Thread(target=shine)
            other.start()
            other.join()
        return found


def path_of(name: str, capsys: pytest.CaptureFixture[str]) -> tuple[list[str], list[list[str]]]:
    """Where the message was, and where it was further, as ``failover path --json`` tells it."""
    capsys.readouterr()
    assert main.main(["path", name, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    return [part["who"] for part in said["parts"]], [[part["who"] for part in way] for way in said["further"]]


def test_what_a_driver_sends_meanwhile_is_on_the_way_and_what_its_own_thread_sends_is_not(
    here: Here, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(Lamp, here), serving(Room, here), called(here, "room") as room:
        for is_here in (True, False):
            assert room.call("light", here=is_here) == [1, 2]
            assert room.last is not None
            own, further = path_of(room.last.re, capsys)
            asker, at = room.sender, "robot1/Lab.Room"
            assert own == [asker, asker, at]
            assert further == [[asker, asker, at, at, "robot1/Lab.Lamp"]] * 2 * is_here
        assert main.main(["path", room.last.re]) == 0 and "further" not in capsys.readouterr().out
        room.call("light", here=True)
        assert main.main(["path", room.last.re]) == 0
        assert capsys.readouterr().out.count("and further to robot1/Lab.Lamp") == 2
    assert hops_so_far() == ()


def test_a_circle_of_drivers_ends_with_a_sentence(here: Here) -> None:
    hops = tuple(Hop(f"robot1/{number}", number, number) for number in range(HOPS_MAX))
    with serving(Lamp, here), called(here, "lamp") as lamp:
        with carrying_out(hops), pytest.raises(CallRefusedError, match="names lead in a circle"):
            lamp.call("shine", seconds=1)
        assert lamp.call("shine", seconds=1) == 1
