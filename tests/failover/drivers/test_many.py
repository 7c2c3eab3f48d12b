"""Many drivers in one process: each has its own name, mailbox, pace and rights, behind one socket."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from msgspec.structs import replace

import failover
from failover.core.naming.tree import Place
from failover.drivers.declare import declaration_of
from failover.drivers.here import Here
from failover.drivers.lookup import lookup, whole_tree
from failover.drivers.many import Device, ManyDrivers, device
from failover.drivers.proxy import Proxy
from failover.errors import CallRefusedError, NoAnswerError
from tests.failover.drivers.serving import called, taking_messages, until

COUNT = 300


@failover.driver("Lab/Process")
class Process:
    @failover.query
    def pid(self) -> int:
        return 0


@failover.driver("Lab/Lamp", rate_hz=1000)
class Lamp:
    def __init__(self, number: int) -> None:
        self.number, self.level, self.moves = number, 0.0, 0

    @failover.command
    def set(self, level: float) -> int:
        self.level, self.moves = level, self.moves + 1
        return self.moves

    @failover.query
    def read(self) -> list[float]:
        return [self.number, self.level, self.moves]

    @failover.query
    def fail(self) -> None:
        raise RuntimeError("broken")

    @failover.stream(rate_hz=50)
    def light(self) -> float:
        return self.level


def lamps(count: int = COUNT) -> list[Device]:
    declared = declaration_of(Lamp)
    return [device(Lamp, declared, f"Lab/Lamps/{n}", [f"lamp {n}"] if n < 3 else [], number=n) for n in range(count)]


def test_each_is_found_and_called_by_its_own_names(here: Here) -> None:
    with taking_messages(ManyDrivers(Process, lamps(), here)):
        assert len(whole_tree(here)) == COUNT + 1
        for name, number in (("Lab/Lamps/7", 7), ("Lab → Lamps → 299", 299), ("lamp 2", 2)):
            with called(here, name) as lamp:
                assert lamp.call("set", level=number / 10) == 1
                assert lamp.call("read") == [number, number / 10, 1]
        with called(here, "Lab/Process") as process:
            assert process.call("pid") == 0
            assert len(list(here.directory.glob("*.calls"))) == 1, "one socket for all"
    until(lambda: not list(here.directory.glob("*.calls")))


def test_callers_of_different_drivers_do_not_disturb_each_other(here: Here) -> None:
    def drive(number: int) -> None:
        with called(here, f"Lab/Lamps/{number}") as lamp:
            answers[number] = [lamp.call("set", level=step) for step in range(50)]

    answers: dict[int, list[int]] = {}
    with taking_messages(ManyDrivers(Process, lamps(8), here)):
        callers = [threading.Thread(target=drive, args=(number,)) for number in range(8)]
        for one in callers:
            one.start()
        for one in callers:
            one.join()
        assert answers == {number: list(range(1, 51)) for number in range(8)}


def test_a_stream_comes_from_the_driver_that_was_asked(here: Here) -> None:
    with taking_messages(ManyDrivers(Process, lamps(4), here)), called(here, "lamp 1") as one, called(here, "lamp 2") as two:
        one.call("set", level=1.0)
        two.call("set", level=2.0)
        seen = [(first, second) for _, first, second in zip(range(3), one.stream("light"), two.stream("light"), strict=False)]
        assert seen == [(1.0, 2.0)] * 3


def test_an_error_of_one_is_no_error_of_the_others(here: Here) -> None:
    with taking_messages(ManyDrivers(Process, lamps(2), here)):
        with called(here, "lamp 0") as lamp, pytest.raises(CallRefusedError, match="broken"):
            lamp.call("fail")
        with called(here, "lamp 1") as lamp:
            assert lamp.call("read") == [1, 0.0, 0]


def test_a_message_to_what_is_not_there_is_refused_by_name(here: Here) -> None:
    with taking_messages(ManyDrivers(Process, lamps(2), here)):
        place = lookup(here, "lamp 0")
        astray = Proxy(here, moved(place, "Lab/Lamps/99"))
        with astray, pytest.raises((CallRefusedError, NoAnswerError), match="Lab/Lamps/99"):
            astray.call("read", timeout=1)


def moved(place: Place, path: str) -> Place:
    """As a caller may remember what is there no more."""
    return replace(place, record=replace(place.record, path=path))


def test_rights_are_those_of_each_path(here: Here, tmp_path: Path) -> None:
    (tmp_path / "rights.toml").write_text('[[rights.rules]]\ngroups = ["@robots"]\nverbs = ["call"]\npaths = ["Lab/Lamps/0"]\n')
    with ManyDrivers(Process, lamps(2), replace(here, rules=tmp_path)) as serving:
        rights = [serving._rights_of(serving._addressed(f"Lab/Lamps/{n}")) for n in (0, 1)]  # type: ignore[arg-type]
        told = [one.refusal(None, "robot2", "") for one in rights]
    assert told[0] == "" and "Lab/Lamps/1" in told[1]
