"""A campaign: fault after fault, and after each of them everything runs again, protected, and no promise was broken."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from random import Random
from typing import Any, Final

from tests.chaos import actuator
from tests.chaos.faults import Draw, Fault
from tests.chaos.house import AWAY, LEASE_MS, LOOK_S, House, until
from tests.chaos.judge import BrokenPromiseError, Judge, Pause, percentile
from tests.chaos.reader import Reader

AT_ONCE: Final = 0.25
"""Of the faults come together with the one after them."""

CRASHES_MAX: Final = 2
CRASH_WINDOW_S: Final = 65.0
"""An agent resumes a program from its newest checkpoint after three crashes in a minute; the fourth goes one checkpoint back,
as it is told to. So many are ours."""

MORE: Final = 5
"""Commands that show that a component runs."""

PAUSE_MS: Final = LEASE_MS // 2
"""Between two commands of one copy: longer is told as a pause."""

SLOW_S: Final = 0.02
MS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Blow:
    """A fault that was dealt.

    Attributes:
        begin_ns, end_ns, well_ns: it began; was mended; everything ran and was protected again (CLOCK_MONOTONIC).
        struck: the components that ran at a member it was aimed at.
    """

    number: int
    kind: str
    sentence: str
    begin_ns: int
    end_ns: int
    well_ns: int
    struck: tuple[str, ...]


@dataclass(slots=True)
class Campaign:
    """Deals faults of some kinds, each in turn, to a house and judges what comes of them."""

    house: House
    dice: Random
    kinds: list[str]
    judge: Judge = field(init=False)
    blows: list[Blow] = field(default_factory=list)
    readers: list[Reader] = field(default_factory=list)
    _record: actuator.Record = field(init=False)
    _crashes: deque[tuple[float, str]] = field(default_factory=deque)
    _left: list[str] = field(default_factory=list)
    _awaited: dict[str, int] = field(default_factory=dict)
    _told: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.judge = Judge((program.name for program in self.house.programs), PAUSE_MS)
        self._record = actuator.Record(self.house.directory / actuator.RECORD)

    def wage(self, faults: int) -> None:
        """Deal so many faults.

        Raises:
            BrokenPromiseError: a promise was broken.
            StuckError: something does not go on.
        """
        self.readers = [Reader(self.house, program.name) for program in self.house.programs]
        for reader in self.readers:
            reader.start()
        try:
            until(self._is_well, self._illness, LOOK_S)
            while len(self.blows) < faults:
                self._round(faults - len(self.blows))
            self._last_look()
        finally:
            for reader in self.readers:
                reader.stop()

    def _round(self, left: int) -> None:
        """One fault or two at once, and the way back."""
        draw = self._look()
        dealt = [self._draw(draw)]
        if left > 1 and self.dice.random() < AT_ONCE:
            other = self._draw(draw)
            if set(other.hits) & set(dealt[0].hits):
                self._left.append(other.kind)  # next time
            else:
                dealt.append(other)
        began, ended = {}, {}
        for fault in dealt:
            began[id(fault)] = time.monotonic_ns()
            self._note(f"{fault.sentence}")
            fault.begin()
        for fault in sorted(dealt, key=lambda fault: fault.lasts_s):
            self._wait(began[id(fault)] + int(fault.lasts_s * 1e9))
            fault.end()
            ended[id(fault)] = time.monotonic_ns()
        for program in self.house.programs:
            self._expect(program.name)
        until(self._is_well, self._illness, LOOK_S)
        well_ns = time.monotonic_ns()
        for fault in dealt:
            struck = tuple(name for member in fault.hits for name in draw.running.get(member.name, ()))
            blow = Blow(len(self.blows) + 1, fault.kind, fault.sentence, began[id(fault)], ended[id(fault)], well_ns, struck)
            self.blows.append(blow)
        self._note(f"well again after {(well_ns - max(ended.values())) / 1e9:.1f} s")

    def _draw(self, draw: Draw) -> Fault:
        """The next kind in turn, so that a short campaign has one of each; none that ends a program too often."""
        while True:
            if not self._left:
                self._left = list(self.kinds)
                self.dice.shuffle(self._left)
            fault = draw.fault(self._left.pop())
            names = [name for member in fault.hits for name in draw.running.get(member.name, ())]
            if not fault.crashes or self._may_crash(names):
                return fault

    def _may_crash(self, names: list[str]) -> bool:
        now = time.monotonic()
        while self._crashes and self._crashes[0][0] < now - CRASH_WINDOW_S:
            self._crashes.popleft()
        counts = Counter(name for _, name in self._crashes)
        if any(counts[name] >= CRASHES_MAX for name in names):
            return False
        self._crashes += [(now, name) for name in names]
        return True

    def _wait(self, until_ns: int) -> None:
        """Judge meanwhile."""
        while time.monotonic_ns() < until_ns:
            self._hear()
            time.sleep(SLOW_S)

    def _hear(self) -> None:
        """Tell the judge the commands, in order, and the lines that readers had seen by then."""
        for one in self._record.fresh():
            for reader in self.readers:
                while reader.seen and reader.seen[0].at_ns < one.at_ns:
                    seen = reader.seen.popleft()
                    self.judge.histories[seen.component].acknowledge(seen.step, seen.seal)
            self.judge.hear([one])
        for reader in self.readers:
            if reader.complaint:
                raise BrokenPromiseError(f"the output of {reader.component}: {reader.complaint}")

    # How it stands

    def _look(self) -> Draw:
        """The targets of faults: the components that each member says it runs."""
        running: dict[str, list[str]] = {}
        standbys: dict[str, str] = {}
        for name, picture in self.house.pictures().items():
            primaries = [one for one in picture["components"] if one["role"] == "primary"]
            running[name] = [short(one["name"]) for one in primaries]
            standbys |= {short(one["name"]): one["standby"] for one in primaries}
        return Draw(self.house, self.dice, running, standbys)

    def _expect(self, component: str) -> None:
        """From now on, it is well when it has commanded anew."""
        self._awaited[component] = time.monotonic_ns()

    def _is_well(self) -> bool:
        self._hear()
        found = self._illnesses()
        if found and found != self._told:
            self._write("waits", f"{time.monotonic_ns() / 1e9:.3f}  for {'; '.join(found)}")
        self._told = found
        return not found

    def _illness(self) -> str:
        return "; ".join(self._illnesses())

    def _illnesses(self) -> list[str]:
        """The states that are not yet as they should be."""
        found = [name for name in self._awaited if not self._acts(name)]
        if found:
            return [f"{name} to act" for name in found]
        pictures = self.house.pictures()
        found = [f"{member.name} to answer" for member in self.house.members if member.name not in pictures]
        for name, picture in pictures.items():
            found += [
                f"{name} to hear {peer['name']}"
                for peer in picture["peers"]
                if not (peer["state"] == "live" and peer["hears_us"] and peer["lane"] == "connected")
            ]
        for program in self.house.programs:
            at = [one for picture in pictures.values() for one in picture["components"] if short(one["name"]) == program.name]
            primaries = [one for one in at if one["role"] == "primary"]
            if [(one["state"], one["protection"]) for one in primaries] != [("running", "protected")]:
                shown = [(one["state"], one["protection"], one["notes"]) for one in primaries]
                found.append(f"{program.name} to run at one robot, protected: {shown}")
        return found

    def _acts(self, component: str) -> bool:
        newest = self.judge.histories[component].newest
        return newest is not None and newest.at_ns > self._awaited[component]

    def _last_look(self) -> None:
        """Everything acknowledged is there at the end; readers have seen all steps of the programs, without a gap."""
        for reader in self.readers:
            goal = self.judge.histories[reader.component].newest
            assert goal is not None
            until(lambda reader=reader, goal=goal: reader.newest >= goal.step, f"output of {reader.component}")  # type: ignore[misc]
            self._hear()
        for component, history in self.judge.histories.items():
            if not history.stands_on(*history.acknowledged):
                raise BrokenPromiseError(f"{component}: {history.acknowledged} was acknowledged and is not in its past")

    # What is told

    def _note(self, what: str) -> None:
        line = f"{time.monotonic_ns() / 1e9:.3f}  {what}"
        print(line, flush=True)
        self._write("faults", line)
        self._write("waits", line)

    def _write(self, name: str, line: str) -> None:
        """Add to a file of the evidence: ``faults``, or ``waits``, which also has what was waited for."""
        with (self.house.directory / name).open("a") as file:
            file.write(line + "\n")

    def outages(self) -> list[Pause]:
        """Pauses of components whose robot was struck, and moves: each counted once."""
        return [pause for pause in self.judge.pauses() if pause.moved or any(_befell(blow, pause) for blow in self.blows)]

    def _outages_of(self, kind: str) -> list[float]:
        """In milliseconds: of the components that ran where a fault of this kind struck."""
        blows = [blow for blow in self.blows if blow.kind == kind]
        return [pause.length_ms for pause in self.judge.pauses() if any(_befell(blow, pause) for blow in blows)]

    def figures(self) -> str:
        """The results of the campaign."""
        kinds = Counter(blow.kind for blow in self.blows)
        outages = self.outages()
        moved = [one for one in outages if one.moved]
        commands = sum(history.commands for history in self.judge.histories.values())
        return (
            f"{len(self.blows)} faults ({', '.join(f'{kind} {count}' for kind, count in sorted(kinds.items()))})\n"
            f"{commands} commands; 0 double actions, 0 acknowledged losses, 0 stuck\n"
            f"{len(outages)} outages: {_spread([one.length_ms for one in outages])} ms\n"
            f"{len(moved)} of them went on in another copy: {_spread([one.length_ms for one in moved])} ms; "
            f"steps done again: {_spread([float(one.lost) for one in moved])}\n"
            + "\n".join(f"  {kind}: {_spread(self._outages_of(kind))} ms" for kind in sorted(kinds) if self._outages_of(kind))
        )

    def evidence(self) -> None:
        """Leave the merged event log of all robots, and each one's own picture, beside their journals."""
        for member in self.house.powered:
            member.go_on()
        with contextlib.suppress(OSError):
            (self.house.directory / "pictures.json").write_text(json.dumps(self.house.pictures(), indent=1))
        for member in self.house.robots:
            with contextlib.suppress(*AWAY):
                member.status()
                self._why(member.machine.socket if member.machine is not None else None)
                return

    def _why(self, socket: Any) -> None:
        for options, name in (((), "why.txt"), (("--json",), "why.json")):
            command = [sys.executable, "-m", "failover", "why", "--socket", str(socket), *options]
            with (self.house.directory / name).open("wb") as file:
                subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, check=False, timeout=60)


def short(name: str) -> str:
    """A component's own part of its name."""
    return name.rpartition("/")[2]


def _spread(values: list[float]) -> str:
    return f"p50 {percentile(values, 0.5):.0f}, p99 {percentile(values, 0.99):.0f}, at most {max(values, default=0):.0f}"


def _befell(blow: Blow, pause: Pause) -> bool:
    """Whether a fault struck the robot of a component that paused then."""
    return pause.component in blow.struck and pause.begin_ns < blow.well_ns and pause.end_ns > blow.begin_ns
