"""Ten senders on two robots tell a driver that keeps its state, over cut cables, deaths of both ends, a takeover, and a split.

Then the driver's own ledger and the senders' records are compared: order of each sender, none twice, none lost that was answered.
FAILOVER_MESSAGES says how many messages there are, 1000 unless it is set.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from failover.cli.demo.robots import Pace, RobotMachine
from failover.drivers.here import DIRECTORY, ROBOT, TEAM
from tests.e2e import robots
from tests.e2e.messengers import LIMIT, PATH, SENDER_SHIFT, Record
from tests.e2e.test_links import TWO, links
from tests.robot_processes import command_lines

AHEAD = 0.05
"""The part of all messages that senders may be ahead of what the test waits for."""

MESSAGES = int(os.environ.get("FAILOVER_MESSAGES", "1000"))
SENDERS = 10
ROOM = MESSAGES + SENDERS
PATIENCE_S = 60 + MESSAGES / 20
SEED = random.randrange(1 << 32)

PACE = Pace(beat_ms=50, lease_ms=2_000)
"""A busy machine that makes a robot silent for a moment is no fault of these messages."""

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).parent / "messengers.py"

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: a cable must be laid and pulled"),
    pytest.mark.timeout(600 + MESSAGES / 10),
]


class Field:
    """Two robots, the driver, and ten senders with a record each."""

    def __init__(self, pair: tuple[RobotMachine, RobotMachine], directory: Path) -> None:
        self.first, self.second = pair
        self.directory = directory
        self.dice = random.Random(SEED)
        self.place_of = {number: pair[number % 2] for number in range(SENDERS)}
        self.kills: Counter[str] = Counter()
        self._records = {number: Record(self.record(number)) for number in range(SENDERS)}
        self.allow(0)
        for robot in pair:
            (directory / robot.name).mkdir(mode=0o700)

    def command(self, *arguments: str, at: str = TWO[0][1]) -> list[str]:
        place = [str(self.first.directory.parent), str(self.directory), at]
        return [sys.executable, str(PROGRAM), *place, *arguments]

    def drive(self) -> None:
        """Start the driver under the first robot's agent."""
        environment = {"PYTHONPATH": str(ROOT), ROBOT: "", TEAM: "", DIRECTORY: ""}
        command = self.command("driver", str(ROOM))
        robots.run(self.first, "ledger", *command, engine="cooperative", env=environment)

    def shine(self, robot: RobotMachine, name: str) -> None:
        """Start a driver on a robot, without its agent."""
        robots.start_inside(robot, "env", f"PYTHONPATH={ROOT}", *self.command("lamp", name, at=robot.name))

    def record(self, number: int) -> Path:
        return self.directory / f"s{number}"

    def begin(self, number: int, count: int = MESSAGES // SENDERS) -> None:
        """Start a sender, or its next life, on its robot."""
        command = self.command("sender", str(number), str(count), str(self.record(number)), at=self.place_of[number].name)
        robots.start_inside(self.place_of[number], "env", f"PYTHONPATH={ROOT}", *command)

    def noted(self, number: int) -> Record:
        """What a sender has noted until now."""
        return self._records[number].read()

    def is_done(self, number: int) -> bool:
        return self.noted(number).is_done

    def replace(self, number: int) -> None:
        """Kill a sender, and start it again; if it has ended, it stays."""
        what, robot = f"sender {number} ", self.place_of[number]
        if robots.until(lambda: [*_processes(robot, what)] or self.is_done(number), f"{what} to run") is not True:
            self._kill(robot, what)
            self.begin(number)

    def end_sender(self, number: int) -> None:
        """Kill a sender for good."""
        self._kill(self.place_of[number], f"sender {number} ")

    def kill_driver(self) -> None:
        """Kill it on the first robot, whose agent starts it again."""
        robots.until(lambda: [*_processes(self.first, "driver")], "the driver to run")
        self._kill(self.first, "driver")

    def _kill(self, robot: RobotMachine, what: str) -> None:
        for pid in _processes(robot, what):
            os.kill(pid, signal.SIGKILL)
            robots.until(lambda pid=pid: robots.has_ended(pid), f"{what} to end")  # type: ignore[misc]
            self.kills[what.split()[0]] += 1

    @property
    def progress(self) -> float:
        """The part of all messages that the newest answer of each sender has reached."""
        return sum(self.noted(number).answered for number in range(SENDERS)) / MESSAGES

    def allow(self, message: int) -> None:
        """Let each sender post up to this message."""
        limit = self.directory / "new-limit"
        limit.write_text(str(message))
        limit.rename(self.directory / LIMIT)

    def until_answered(self, part: float, what: str) -> None:
        """Until so much of all messages was answered, while more are on their way."""
        self.allow(int((part + AHEAD) * MESSAGES / SENDERS))
        robots.until(lambda: self.progress >= part, f"answers {what}", PATIENCE_S)

    def until_more(self, what: str) -> None:
        """Until messages are answered that were not on their way before."""
        self.until_answered(self.progress + AHEAD, what)

    @property
    def are_done(self) -> bool:
        return all(map(self.is_done, range(SENDERS)))

    def ledger(self, robot: RobotMachine) -> list[tuple[int, int]]:
        """What the driver has in its state: (sender, message), in order."""
        script = (
            "import failover; found = []\n"
            "with failover.proxy('ledger') as proxy:\n"
            "    while page := proxy.call('read', begin=len(found), timeout=60): found += page\n"
        )
        entries = self.said(robot, script)
        return [(one >> SENDER_SHIFT, one & (1 << SENDER_SHIFT) - 1) for one in entries]

    def said(self, robot: RobotMachine, script: str) -> Any:
        """What a program on that robot leaves in ``found``."""
        begun = (
            "import sys, json; sys.path.insert(0, sys.argv.pop(1)); from pathlib import Path; from tests.e2e import messengers\n"
            "messengers.be_on(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])\n"
        )
        ended = "Path(sys.argv[4]).write_text(json.dumps(found)); Path(sys.argv[4]).rename(sys.argv[5])\n"
        command = [sys.executable, "-c", begun + script + ended, str(ROOT), *self.command(at=robot.name)[2:]]
        written, found = self.directory / "written", self.directory / "found"
        found.unlink(missing_ok=True)
        robots.start_inside(robot, *command, str(written), str(found))
        robots.until(found.exists, "a program to say what it found", PATIENCE_S)
        return json.loads(found.read_text())

    def names(self, robot: RobotMachine) -> dict[str, tuple[str, str, int]]:
        """What each path leads to as that robot knows it: the robot, whether it is live, its epoch."""
        script = (
            "from failover.drivers.here import here; from failover.drivers.lookup import whole_tree; tree = whole_tree(here())\n"
            "found = [(one.record.path, one.robot, str(one.reach), one.record.epoch)\n"
            "         for one in (tree.claimants(place.record.path)[0] for place in tree.under())]\n"
        )
        told = cast("list[tuple[str, str, str, int]]", self.said(robot, script))
        return {path: (at, reach, epoch) for path, at, reach, epoch in told}


def _processes(robot: RobotMachine, what: str) -> Iterator[int]:
    """The processes there that are the driver, or a sender."""
    for pid, words in command_lines(robot):
        if str(PROGRAM) in words and what in " ".join(words) and "env" not in words and not robots.has_ended(pid):
            yield pid


def play(field: Field) -> None:
    """All that goes wrong, one thing after the other, while messages travel."""
    field.until_answered(0.05, "before anything happens")
    for part in (0.1, 0.25):
        field.until_answered(part, f"up to {part:.0%}")
        robots.cable(field.first, "down")
        robots.until(lambda: not links(field.first)["wire"]["carrier"], "the cut to be seen")
        for number in field.dice.sample(range(SENDERS), 2):
            field.replace(number)
        robots.cable(field.first, "up")
        robots.until(lambda: all(map(robots.connected, (field.first, field.second))), "the cable to work again")
        robots.until_protected(field.first, "ledger")
        field.until_more("after the cut")
    for part in (0.4, 0.55):
        field.until_answered(part, f"up to {part:.0%}")
        field.kill_driver()
        robots.until_protected(field.first, "ledger")
        field.until_more("after the driver's death")
    for number in range(SENDERS):
        field.replace(number)
    field.until_answered(0.7, "up to 70 %")
    robots.until_protected(field.first, "ledger")
    field.until_more("before the takeover")
    field.first.freeze()
    robots.until_taken_over(field.second, "ledger")
    field.first.end()
    field.kills["robot"] += 1
    for number in (one for one, robot in field.place_of.items() if robot is field.first):
        field.place_of[number] = field.second
        field.begin(number)
    field.until_answered(1 - AHEAD, "of the standby")
    field.allow(MESSAGES // SENDERS)
    robots.until(lambda: field.are_done, "all senders to end", PATIENCE_S)


def check(field: Field, ledger: list[tuple[int, int]]) -> None:
    """Order of each sender, none twice, none lost that was answered; each answer was that of its message."""
    assert len(set(ledger)) == len(ledger), "a message was carried out twice"
    for number in range(SENDERS):
        told = [message for sender, message in ledger if sender == number]
        assert told == sorted(told), f"messages of sender {number} are not in order"
        lives = field.noted(number).lines
        assert {message for kind, message, _ in lives if kind == "posted"} == set(range(1, MESSAGES // SENDERS + 1))
        for kind, message, place in lives:
            assert kind in ("posted", "ok", "done"), f"sender {number}, message {message}: {kind}"
            if kind == "ok":
                assert ledger[place - 1] == (number, message), f"answered, and not in the ledger: {number}, {message}"


def test_of_all_messages_none_is_lost_or_doubled_or_overtakes(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    print("seed", SEED)
    with robots.two_robots(tmp_path, cables=TWO, pace=PACE) as pair:
        field = Field(pair, tmp_path_factory.mktemp("m"))
        field.drive()
        robots.until_protected(field.first, "ledger")
        for number in range(SENDERS):
            field.begin(number)
        play(field)
        ledger = field.ledger(field.second)
        check(field, ledger)
        answered = sum(len(field.noted(number).oks()) for number in range(SENDERS))
        print(f"{len(ledger)} messages carried out, {answered} answered; kills: {dict(field.kills)}")
    assert answered > MESSAGES / 2 and field.kills["driver"] == 2 and field.kills["sender"] > SENDERS / 2


LAMPS = (("robot1", "Lamp"), ("robot2", "Lamp"), ("robot2", "New"))
MORE = 20
"""Messages that show that a copy of the driver goes on."""


class Split:
    """Two senders, one on each side, of a driver whose robots do not hear each other for a while."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.allowed = 0
        for number in range(2):
            field.begin(number, ROOM)

    def answered(self) -> list[int]:
        return [len(self.field.noted(number).oks()) for number in range(2)]

    def until_more(self, what: str) -> None:
        """Until each sender has answers to messages that it may post only now."""
        begun, self.allowed = self.allowed, self.allowed + 2 * MORE
        self.field.allow(self.allowed)
        robots.until(lambda: all(self.field.noted(number).answered > begun + MORE for number in range(2)), what)

    def cables(self, state: str) -> None:
        for name, _ in TWO:
            robots.cable(self.field.first, state, name)

    def end(self) -> None:
        for number in range(2):
            self.field.end_sender(number)


def test_after_a_split_each_name_is_right_and_no_message_is_doubled(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with robots.two_robots(tmp_path, cables=TWO, pace=PACE) as pair:
        field = Field(pair, tmp_path_factory.mktemp("m"))
        first, second = pair
        field.drive()
        field.shine(first, "Lamp")
        field.shine(second, "Lamp")
        split = Split(field)
        split.until_more("answers")
        robots.until_protected(first, "ledger")
        before = split.answered()
        split.cables("down")
        robots.until_taken_over(second, "ledger")
        split.until_more("answers of each copy to its own side")
        field.shine(second, "New")
        robots.until(lambda: "Lab/robot2/New" in field.names(second), "a driver that begins in the split to be known on its side")
        epoch = field.names(second)[PATH][2]
        split.cables("up")
        robots.until(lambda: robots.component(second, "ledger").get("role") == "standby", "one copy to stay")
        after = split.allowed
        split.until_more("answers of the copy that stays to both")
        for robot in pair:
            robots.until(lambda at=robot: _are_right(field.names(at), epoch), f"{robot.name} to know each name")  # type: ignore[misc]
        split.end()
        ledger = field.ledger(first)
    assert len(set(ledger)) == len(ledger), "a message was carried out twice"
    for number in range(2):
        told = [message for sender, message in ledger if sender == number]
        assert told == sorted(told), f"messages of sender {number} are not in order"
        oks = field.noted(number).oks()
        stays = oks if number == 0 else [one for place, one in enumerate(oks) if place < before[1] or one[0] > after]
        assert len(stays) > MORE
        for message, place in stays:
            assert ledger[place - 1] == (number, message), f"answered, and not in the ledger: {number}, {message}"


def _are_right(names: dict[str, tuple[str, str, int]], epoch: int) -> bool:
    """Each name leads to a living driver, and the ledger's to the copy that never stopped, whose epoch is later again."""
    ledger = names.pop(PATH, ("", "", 0))
    lamps = {f"Lab/{robot}/{name}": (robot, "live", 0) for robot, name in LAMPS}
    return ledger[:2] == ("robot1", "live") and ledger[2] > epoch and names == lamps
