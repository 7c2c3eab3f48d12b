"""The faults of a campaign: each begins, lasts, and ends; afterwards, all that it changed is as before.

Faults are drawn at random, aimed at the robot that runs a component more often than at others, and described in a sentence.
"""

from __future__ import annotations

import functools
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Final

from tests.chaos.house import LEASE_MS, House, Member, send
from tests.chaos.network import Way
from tests.robot_processes import command_lines

LEASE_S: Final = LEASE_MS / 1_000
PARTS: Final[tuple[tuple[str, ...], ...]] = (
    ("main_loop",),
    ("worker",),
    ("keeper",),
    ("guard",),
    ("main_loop", "worker"),
    ("main_loop", "worker", "keeper"),
)
"""Parts of an agent that are killed, or stand still, at one instant."""

AIMED: Final = 0.7
"""Of the faults hit a robot that runs something."""

NARROW_KBIT_S: Final = (200, 1_000)
"""Of a link that is saturated: the beats of one member to six others take 300."""


@dataclass(slots=True)
class Fault:
    """One fault, drawn and not yet begun.

    Attributes:
        kind: one of `KINDS`.
        sentence: names the fault and its member.
        lasts_s: until it is mended.
        hits: members that it is aimed at.
        crashes: how many of the programs of those members it ends without ending their robot.
    """

    kind: str
    sentence: str
    lasts_s: float
    hits: tuple[Member, ...]
    begin: Callable[[], None]
    end: Callable[[], None] = lambda: None
    crashes: bool = False


@dataclass(slots=True)
class Draw:
    """Draws faults for a house.

    Attributes:
        running: who runs which component now, by member's name.
        standbys: who holds the newest checkpoint of a component, by the component's name.
    """

    house: House
    dice: Random
    running: Mapping[str, list[str]] = field(default_factory=dict)
    standbys: Mapping[str, str] = field(default_factory=dict)

    def fault(self, kind: str) -> Fault:
        """One of this kind."""
        return KINDS[kind](self)

    # Whom

    def _busy(self) -> Member:
        """Mostly a robot that runs something."""
        busy = [member for member in self.house.robots if self.running.get(member.name)]
        return self.dice.choice(busy if busy and self.dice.random() < AIMED else self.house.members)

    def _robot(self) -> Member:
        busy = [member for member in self.house.robots if self.running.get(member.name)]
        return self.dice.choice(busy or self.house.robots)

    def _storing(self) -> Member:
        return self.dice.choice([member for member in self.house.members if member.role != "witness"])

    # Processes

    def kill(self) -> Fault:
        """Parts of an agent are killed."""
        member, parts = self._busy(), self.dice.choice(PARTS)
        away_s = self.dice.uniform(0.1, 6 * LEASE_S)

        def begin() -> None:
            pids = [pid for part in parts for pid in member.parts(part)]
            self.house.note_cgroups(member)
            send(pids, signal.SIGSTOP)  # no part sees another one die
            send(pids, signal.SIGKILL)

        def end() -> None:
            if "main_loop" in parts:
                self.house.start_agent(member)

        sentence = f"kill -9 {' and '.join(parts)} of {member.name}"
        return Fault("kill", sentence, away_s, (member,), begin, end, "guard" in parts)

    def stop(self) -> Fault:
        """Parts of an agent stand still for a while, shorter or far longer than a lease."""
        member, parts = self._busy(), self.dice.choice(PARTS)
        lasts_s = self.dice.choice((LEASE_S / 2, 2 * LEASE_S, 8 * LEASE_S, 14 * LEASE_S))
        sentence = f"kill -STOP {' and '.join(parts)} of {member.name} for {lasts_s:.2f} s"

        def begin() -> None:
            member.stop([pid for part in parts for pid in member.parts(part)])

        return Fault("stop", sentence, lasts_s, (member,), begin, member.go_on, "guard" in parts)

    def crash(self) -> Fault:
        """A program is killed and nothing else."""
        member = self._robot()
        names = self.running.get(member.name, [])
        name = self.dice.choice(names) if names else ""

        def begin() -> None:
            send(_programs(member, name), signal.SIGKILL)

        return Fault("crash", f"kill -9 the program {name} at {member.name}", 0.1, (member,), begin, crashes=True)

    # Whole members

    def power(self) -> Fault:
        """A member loses its power, and comes back with its disk."""
        return self._outage("power", self._busy(), "its disk is as it was", lambda member: None)

    def burnt(self) -> Fault:
        """A member loses its power and its disk."""
        return self._outage("burnt", self._busy(), "its disk is new and empty", self.house.new_disk)

    def hung(self) -> Fault:
        """All of a member stands still, guards and programs too, and is then switched off: it never wakes up."""
        member, hangs_s = self._busy(), self.dice.uniform(LEASE_S, 5 * LEASE_S)

        def begin() -> None:
            assert member.machine is not None
            while fresh := [pid for pid in member.machine.processes() if pid not in member.stopped]:
                member.stop(fresh)

        def end() -> None:
            self.house.power_off(member)
            self.house.power_on(member)

        sentence = f"all of {member.name} hangs for {hangs_s:.2f} s, then its power is cut and comes back"
        return Fault("hung", sentence, hangs_s, (member,), begin, end)

    def blackout(self) -> Fault:
        """All members lose their power, and come back one after the other in any order."""
        order = self.dice.sample(self.house.members, len(self.house.members))

        def begin() -> None:
            for member in order:
                self.house.power_off(member)

        def end() -> None:
            for member in reversed(order):
                self.house.power_on(member)

        away_s = self.dice.uniform(0.2, 2)
        return Fault("blackout", f"all lose their power for {away_s:.2f} s", away_s, tuple(order), begin, end)

    def worst(self) -> Fault:
        """A primary loses its power while its standby is cut off: no other member may resume from less than was acknowledged."""
        primary = self._robot()
        names = [name for name in self.running.get(primary.name, []) if self.standbys.get(name)]
        standby = self.house.member(self.standbys[self.dice.choice(names)]) if names else self.house.members[-1]
        plugs = [(standby.number, link) for link in standby.links]
        lasts_s, is_primary_first = self.dice.uniform(LEASE_S, 12 * LEASE_S), self.dice.random() < 0.5

        def begin() -> None:
            self.house.network.pull(plugs)
            self.house.power_off(primary)

        def end() -> None:
            if is_primary_first:
                self.house.power_on(primary)
            self.house.network.push(plugs)
            if not is_primary_first:
                self.house.power_on(primary)

        sentence = f"{primary.name} loses its power while its standby {standby.name} is cut off for {lasts_s:.2f} s"
        return Fault("worst", sentence, lasts_s, (primary, standby), begin, end)

    def moving(self) -> Fault:
        """In the middle of a handover, the robot that gives, or the one that takes, loses its power."""
        source = self._robot()
        target = self.dice.choice([member for member in self.house.robots if member is not source])
        name = self.dice.choice(self.running.get(source.name) or [""])
        victim, pause_s = self.dice.choice((source, target)), self.dice.uniform(0, 1)

        def begin() -> None:
            self.house.order_handover(name, source, target)
            time.sleep(pause_s)  # not a wait for anything: the instant of the cut
            self.house.power_off(victim)

        sentence = (
            f"{name} is handed over from {source.name} to {target.name}; {victim.name} loses its power after {pause_s:.2f} s"
        )
        end = functools.partial(self.house.power_on, victim)
        return Fault("moving", sentence, pause_s + self.dice.uniform(0.2, 6 * LEASE_S), (source, target), begin, end)

    def _outage(self, kind: str, member: Member, how: str, change: Callable[[Member], None]) -> Fault:
        away_s = self.dice.uniform(0.2, 8 * LEASE_S)

        def end() -> None:
            change(member)
            self.house.power_on(member)

        sentence = f"{member.name} loses its power for {away_s:.2f} s; {how}"
        return Fault(kind, sentence, away_s, (member,), lambda: self.house.power_off(member), end)

    # Network

    def cable(self) -> Fault:
        """One cable, or all cables of a member are pulled."""
        member = self._busy()
        links = self.dice.choice([(link,) for link in member.links] + [member.links])
        plugs = [(member.number, link) for link in links]
        lasts_s = self._lasts_s()
        sentence = (
            f"{member.name} loses {'all of its cables' if links == member.links else f'cable {links[0]}'} for {lasts_s:.2f} s"
        )
        network = self.house.network
        return Fault("cable", sentence, lasts_s, (member,), lambda: network.pull(plugs), lambda: network.push(plugs))

    def one_way(self) -> Fault:
        """One member is not heard by another, is not heard by any, or hears none."""
        member = self._busy()
        others = [other for other in self.house.members if other is not member]
        how = self.dice.choice(("mute", "deaf", "pair"))
        if how == "pair":
            other = self.dice.choice(others)
            return self._cut("one_way", f"{other.name} hears nothing of {member.name}", (member,), _ways([member], [other]))
        ways = _ways([member], others) if how == "mute" else _ways(others, [member])
        said = f"no member hears {member.name}" if how == "mute" else f"{member.name} hears no member"
        return self._cut("one_way", said, (member,), ways)

    def partition(self) -> Fault:
        """Two groups that do not hear each other, or of which only one hears the other."""
        members = list(self.house.members)
        one = self.dice.sample(members, self.dice.randrange(1, len(members)))
        other = [member for member in members if member not in one]
        ways = set(_ways(one, other))
        half = self.dice.random() < 0.2
        if not half:
            ways |= set(_ways(other, one))
        names = " ".join(sorted(member.name for member in one))
        how = "are not heard by the others" if half else "are apart from the others"
        return self._cut("partition", f"{names} {how}", tuple(members), ways)

    def saturated(self) -> Fault:
        """So little passes over a member's cables that snapshots fill them."""
        member, kbit_s, lasts_s = self._busy(), self.dice.choice(NARROW_KBIT_S), self._lasts_s()
        network = self.house.network

        def begin() -> None:
            for link in member.links:
                network.saturate(member.number, link, kbit_s)

        def end() -> None:
            for link in member.links:
                network.relieve(member.number, link)

        sentence = f"only {kbit_s} kbit/s pass over the cables of {member.name} for {lasts_s:.2f} s"
        return Fault("saturated", sentence, lasts_s, (member,), begin, end)

    def _cut(self, kind: str, said: str, hits: tuple[Member, ...], ways: set[Way]) -> Fault:
        lasts_s, network = self._lasts_s(), self.house.network
        return Fault(kind, f"{said} for {lasts_s:.2f} s", lasts_s, hits, lambda: network.cut(ways), lambda: network.mend(ways))

    # Disks

    def full(self) -> Fault:
        """A file of another program fills a disk."""
        member, lasts_s = self._storing(), self.dice.uniform(1, 10 * LEASE_S)
        film = member.disk / "a user's film"
        sentence = f"the disk of {member.name} is full for {lasts_s:.2f} s"
        return Fault("full", sentence, lasts_s, (member,), lambda: fill(film), lambda: film.unlink(missing_ok=True))

    def _lasts_s(self) -> float:
        return self.dice.choice((0.4, 2, 5, 10)) * LEASE_S * self.dice.uniform(0.8, 1.2)


KINDS: Final[dict[str, Callable[[Draw], Fault]]] = {
    "kill": Draw.kill,
    "stop": Draw.stop,
    "power": Draw.power,
    "one_way": Draw.one_way,
    "crash": Draw.crash,
    "partition": Draw.partition,
    "hung": Draw.hung,
    "full": Draw.full,
    "cable": Draw.cable,
    "burnt": Draw.burnt,
    "worst": Draw.worst,
    "moving": Draw.moving,
    "blackout": Draw.blackout,
    "saturated": Draw.saturated,
}


def _ways(senders: list[Member], receivers: list[Member]) -> set[Way]:
    """All ways from these to those, over every link."""
    return {
        (sender.number, receiver.number, link)
        for sender in senders
        for receiver in receivers
        for link in set(sender.links) & set(receiver.links)
    }


def _programs(member: Member, name: str) -> Iterator[int]:
    """PIDs of a component's program: the process whose command line names it, not those of ours around it."""
    for pid, words in command_lines(member.machine) if member.machine is not None else ():
        if not {"agent.guard.server", "checkpoint"} & set(words[:5]) and {name, f"name={name}"} & set(words):
            yield pid


def fill(path: Path) -> None:
    """Take all the room that is left on a disk."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        for size in (1 << 20, 1 << 12):
            _fill(descriptor, size)
    finally:
        os.close(descriptor)


def _fill(descriptor: int, size: int) -> None:
    try:
        while True:
            os.write(descriptor, bytes(size))
    except OSError:
        return
