"""A driver that calls another one while it carries out a message: the way goes on, and `failover path` shows it."""

from __future__ import annotations

import asyncio
import contextvars
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from failover.cli import main
from failover.core.messaging.envelope import HOPS_MAX, Hop
from failover.drivers.here import Here
from failover.drivers.in_hand import CARRIED_MAX, carrying_out, hops_so_far
from tests.failover.drivers.serving import called, serving, until


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


@failover.driver("Lab/Clock", alias="clock")
class Clock:
    """Posts its next message to itself, and to another one that posts back."""

    def __init__(self) -> None:
        self.ticks = self.tocks = 0
        self.tasks: list[tuple[Hop, ...]] = []

    @failover.command
    def tick(self, left: int) -> None:
        self.ticks += 1
        if left:
            post("clock", "tick", left - 1)

    @failover.command
    def tock(self, left: int) -> None:
        self.tocks += 1
        if left:
            post("echo", "tock", left - 1)

    @failover.command
    def begin(self, over: str) -> None:
        async def later() -> None:
            self.tasks.append(hops_so_far())
            while not Path(over).exists():
                await asyncio.sleep(0.001)
            self.tasks.append(hops_so_far())

        context = contextvars.copy_context()
        threading.Thread(target=context.run, args=(asyncio.run, later())).start()
        until(lambda: self.tasks)


@failover.driver("Lab/Echo", alias="echo")
class Echo:
    @failover.command
    def tock(self, left: int) -> None:
        post("clock", "tock", left)


PROXIES: dict[str, failover.Proxy] = {}


def post(name: str, verb: str, left: int) -> None:
    PROXIES[name].post(verb, left=left)


@pytest.fixture
def clock(here: Here) -> Iterator[tuple[Clock, failover.Proxy]]:
    with serving(Clock, here) as clock, serving(Echo, here), called(here, "clock") as asked, called(here, "echo") as echo:
        PROXIES.update(clock=called(here, "clock"), echo=echo)
        with PROXIES["clock"]:
            yield clock.instance, asked


@pytest.mark.parametrize(("verb", "count"), [("tick", "ticks"), ("tock", "tocks")])
def test_drivers_that_post_to_themselves_or_each_other_go_on_for_ever(
    clock: tuple[Clock, failover.Proxy], verb: str, count: str
) -> None:
    driver, asked = clock
    asked.call(verb, left=5 * HOPS_MAX)
    until(lambda: getattr(driver, count) == 5 * HOPS_MAX + 1)


def test_a_task_that_lives_on_begins_a_new_way_once_the_message_is_carried_out(
    clock: tuple[Clock, failover.Proxy], tmp_path: Path
) -> None:
    driver, asked = clock
    asked.call("begin", over=str(tmp_path / "over"))
    (tmp_path / "over").touch()
    until(lambda: len(driver.tasks) == 2)
    assert [hop.who for hop in driver.tasks[0]] == [asked.sender, "robot1/Lab.Clock"] and driver.tasks[1] == ()


def test_a_long_way_goes_on_as_another_one() -> None:
    hops = tuple(Hop(f"robot1/{number}", number, number) for number in range(CARRIED_MAX))
    for carried, found in ((hops, hops), ((*hops, Hop("robot1/more", 1)), ())):
        with carrying_out(carried):
            assert hops_so_far() == found
