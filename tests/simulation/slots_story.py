"""Scenarios of the slots that a person can read, played by the agent's own `Slots` on the radio of `radio.py`.

A file is lines of ``AT ms VERB arguments``; ``#`` begins a comment; robots are named by their numbers, ``all`` are all of them.

    team 8                     robots in the team file; before everything else
    terms spread=false         other terms than the usual ones
    0     on all               these robots start;  off 3: their power is cut (a later on is a new life)
    0     clocks 100           every clock is wrong by up to so many ppm; before robots start (± 50, and years apart, anyway)
    0     listens 3            from its next start it only listens;  round 3 60: from its next start its t_tup_ms is 60
    500   one-way 1 2          what 1 sends does not reach 2;  cut 1 2: both ways;  mend: all of that ends
    500   apart 1 2 / 3 4      these groups do not hear each other
    500   loses 1              so many percent of the receptions fail
    500   noise 10             an alien asks for echoes every 10 ms; 0: not any more
    600   stalls 3 30          its loop gets no processor for 30 ms;  sleeps 3 5000: its machine is suspended
    600   oversleeps 3 30      its next wake-up is late by so many ms
    600   mark                 from here on count what the next lines look at
    900   agreed               all that are on use the same set: exactly those that are on
    900   agreed-within 250    they came to that within 250 ms after the last mark, and have not left it since
    900   steady               no set has changed since the mark
    900   together 1           since the mark all robots on but the reference changed their sets at once: within so many ms
    900   set 1 1 2 3          the set that 1 uses
    900   reference 2 all      the one that these follow
    900   sees 1 3 remove      how 1 sees 3: not, insert, run, remove
    900   own 3 silent         what it does: listening, running, silent;  why 3 TEXT: its reason has these words
    900   accuses-nobody 3     since the mark 3 has not missed any robot
    900   deaf 1 3 2           at 1 the status says that 3 does not hear 2;  hears-all: no status says such a thing
    900   gaps 5.5             no two frames since the mark (of two robots) left closer to each other, in ms
    900   sent 3 1 2           frames that it has sent since the mark: at least, at most
    900   pauses 3 40 60       between two of its frames since the mark: at least, at most, in ms
    900   late 3 29 31         by how much its last frame was late at most, in ms

Every robot keeps the invariants all the time: never two frames within half a slot, none later than two rounds after the last one
(its own stalls and starts aside), and the set that it uses holds itself.
"""

from __future__ import annotations

import itertools
from typing import Any

import msgspec

from failover.core.frames.slots import Slots
from failover.core.frames.terms import Seen, Terms
from failover.core.types import MS
from tests.simulation.slotted import Robot, Team

WAKES_LATE_NS = 5 * MS
"""No wake-up of the simulation is so late by itself."""


class SlotsStory:
    """One scenario being played. ``failures``: expectations that were not met."""

    def __init__(self) -> None:
        self.failures: list[str] = []
        self.team: Team
        self.mark_ns = 0
        self.agreed_ns: int | None = None
        self.changed_ns = 0
        self.changes: dict[int, int] = {}
        self.missed: dict[int, int] = {}
        self._sets: dict[int, tuple[int, int]] = {}
        self._sends: dict[int, tuple[int, int]] = {}
        self._terms: dict[int, Terms] = {}

    def play(self, text: str, seed: int = 1) -> Team:
        """Play the lines in order; raises AssertionError with what was not met."""
        lines = [words for line in text.splitlines() if (words := line.split("#")[0].split())]
        count = int(lines.pop(0)[1])
        terms = _terms(Terms(), lines.pop(0)[1:]) if lines[0][0] == "terms" else Terms()
        self.team = Team(seed, count, terms)
        self.team.watch = self._watch
        for at_ms, verb, *arguments in lines:
            self.team.run(int(at_ms) * MS)
            self._play(verb, arguments)
        assert not self.failures, "\n".join(self.failures)
        return self.team

    # --- What must hold all the time ------------------------------------------------------------------------------------

    def _watch(self, robot: Robot) -> None:
        slots, now_ns = robot.slots, self.team.now_ns
        assert slots is not None
        life, used = self._sets.get(robot.rank, (0, 0))
        if (life, used) != (robot.boot, slots.set):
            self._sets[robot.rank] = (robot.boot, slots.set)
            if life == robot.boot:
                self.changed_ns = self.changes[robot.rank] = now_ns
        if any(peer.seen is Seen.REMOVE for peer in slots.peers.values()):
            self.missed[robot.rank] = now_ns
        if not self.team.agreed():
            self.agreed_ns = None
        elif self.agreed_ns is None:
            self.agreed_ns = now_ns
        if slots.terms.transmit and not slots.set >> robot.rank & 1:
            self._fail(f"{robot.rank + 1} uses a set without itself: {slots.view().members}")
        if robot.sends and robot.sends[-1] != self._sends.get(robot.rank, (0, 0))[1]:
            self._sent(robot, slots)

    def _sent(self, robot: Robot, slots: Slots) -> None:
        life, before_ns = self._sends.get(robot.rank, (0, 0))
        now_ns, t_ns = robot.sends[-1], slots.terms.t_tup_ns
        self._sends[robot.rank] = (robot.boot, now_ns)
        if life != robot.boot:
            return
        pause_ns = now_ns - before_ns
        if pause_ns < t_ns // slots.set.bit_count() // 2:
            self._fail(f"{robot.rank + 1} has sent twice within {pause_ns / MS:.1f} ms")
        if pause_ns > 2 * t_ns + WAKES_LATE_NS and before_ns > robot.stands_until_ns:
            self._fail(f"{robot.rank + 1} has not sent for {pause_ns / MS:.1f} ms")

    def _fail(self, what: str) -> None:
        self.failures.append(f"at {self.team.now_ns / MS:.1f} ms {what}")

    # --- The lines ------------------------------------------------------------------------------------------------------

    def _ranks(self, words: list[str]) -> list[int]:
        return [robot.rank for robot in self.team.robots] if words == ["all"] else [int(word) - 1 for word in words]

    def _slots(self, word: str) -> Slots:
        slots = self.team.robots[int(word) - 1].slots
        assert slots is not None, f"{word} is off"
        return slots

    def _play(self, verb: str, arguments: list[str]) -> None:
        team = self.team
        match verb:
            case "on":
                team.on(*self._ranks(arguments))
            case "off":
                team.off(*self._ranks(arguments))
            case "clocks":
                for robot in team.robots:
                    robot.rate = 1 + (2 * team.random.random() - 1) * int(arguments[0]) / 1e6
            case "listens":
                self._give(arguments[0], transmit=False)
            case "round":
                self._give(arguments[0], t_tup_ms=int(arguments[1]))
            case "one-way":
                one, other = self._ranks(arguments)
                team.unheard.add((one, other))
            case "cut":
                one, other = self._ranks(arguments)
                team.unheard |= {(one, other), (other, one)}
            case "apart":
                middle = arguments.index("/")
                these, those = self._ranks(arguments[:middle]), self._ranks(arguments[middle + 1 :])
                team.unheard |= {pair for one in these for other in those for pair in ((one, other), (other, one))}
            case "mend":
                team.unheard.clear()
            case "loses":
                team.loss = float(arguments[0]) / 100
            case "noise":
                team.noise(int(arguments[0]) * MS)
            case "stalls" | "sleeps":
                team.stall(int(arguments[0]) - 1, int(arguments[1]) * MS, is_deaf=verb == "sleeps")
            case "oversleeps":
                team.robots[int(arguments[0]) - 1].oversleeps_ns = int(arguments[1]) * MS
            case "mark":
                self.mark_ns = team.now_ns
            case _:
                self._look(verb, arguments)

    def _give(self, robot: str, **terms: Any) -> None:
        one = self.team.robots[int(robot) - 1]
        one.terms = msgspec.structs.replace(one.terms, **terms)

    def _look(self, verb: str, arguments: list[str]) -> None:
        team = self.team
        match verb:
            case "agreed":
                self._expect("the robots that are on agree", team.agreed(), self._sets_told())
            case "agreed-within":
                took_ms = None if self.agreed_ns is None else (self.agreed_ns - self.mark_ns) / MS
                is_so = took_ms is not None and took_ms <= float(arguments[0])
                self._expect(f"they agree within {arguments[0]} ms", is_so, f"it took {took_ms} ms; {self._sets_told()}")
            case "steady":
                self._expect("no set has changed", self.changed_ns <= self.mark_ns, f"one did at {self.changed_ns / MS:.1f} ms")
            case "set":
                found = self._slots(arguments[0]).set
                self._expect(
                    f"{arguments[0]} uses {arguments[1:]}",
                    found == sum(1 << rank for rank in self._ranks(arguments[1:])),
                    bin(found),
                )
            case "reference":
                for rank in self._ranks(arguments[1:]):
                    found = self._slots(str(rank + 1)).view().reference
                    self._expect(f"{rank + 1} follows {arguments[0]}", found == f"robot{arguments[0]}", found)
            case "sees":
                seen = self._slots(arguments[0]).peers[int(arguments[1]) - 1].seen.name.lower()
                self._expect(f"{arguments[0]} sees {arguments[1]} as {arguments[2]}", seen == arguments[2], seen)
            case "own":
                own = self._slots(arguments[0]).own
                self._expect(f"{arguments[0]} is {arguments[1]}", own == arguments[1], own)
            case "why":
                why = self._slots(arguments[0]).why
                self._expect(f"{arguments[0]} says {arguments[1:]}", " ".join(arguments[1:]) in why, why)
            case "deaf":
                deaf = self._slots(arguments[0]).view().deaf
                pair = (f"robot{arguments[1]}", f"robot{arguments[2]}")
                self._expect(f"{arguments[0]} says that {arguments[1]} does not hear {arguments[2]}", deaf == (pair,), deaf)
            case "accuses-nobody":
                at_ns = self.missed.get(int(arguments[0]) - 1, 0)
                self._expect(f"{arguments[0]} accuses nobody", at_ns < self.mark_ns, f"it did at {at_ns / MS:.1f} ms")
            case "hears-all":
                deaf = [robot.slots.view().deaf for robot in team.robots if robot.slots is not None]
                self._expect("no robot tells of a deaf one", not any(deaf), deaf)
            case _:
                self._measure(verb, arguments)

    def _measure(self, verb: str, arguments: list[str]) -> None:
        team, at_least, at_most = self.team, float(arguments[-2] if len(arguments) > 1 else arguments[-1]), float(arguments[-1])
        match verb:
            case "gaps":
                sends = team.sends(self.mark_ns)
                gaps = [(after[0] - before[0], before, after) for before, after in itertools.pairwise(sends)]
                least = min((gap for gap in gaps if gap[1][1] != gap[2][1]), default=(0, (0, 0), (0, 0)))
                told = f"{least[0] / MS:.2f} ms between {least[1][1] + 1} and {least[2][1] + 1} at {least[1][0] / MS:.1f} ms"
                self._expect(f"gaps of {arguments[0]} ms", least[0] >= at_least * MS, told)
            case "sent":
                sent = sum(at >= self.mark_ns for at in team.robots[int(arguments[0]) - 1].sends)
                self._expect(f"{arguments[0]} has sent {arguments[1:]} frames", at_least <= sent <= at_most, sent)
            case "pauses":
                sends = [at for at in team.robots[int(arguments[0]) - 1].sends if at >= self.mark_ns]
                pauses = [(after - before) / MS for before, after in itertools.pairwise(sends)]
                is_so = bool(pauses) and at_least <= min(pauses) and max(pauses) <= at_most
                self._expect(f"{arguments[0]} pauses for {arguments[1:]} ms", is_so, pauses)
            case "together":
                lowest, *followers = [robot.rank for robot in team.living()]
                changes = [self.changes[rank] for rank in followers if self.changes.get(rank, 0) > self.mark_ns]
                took_ms = (max(changes) - min(changes)) / MS if changes else None
                is_so = len(changes) == len(followers) and took_ms is not None and took_ms <= at_most
                self._expect(f"all but {lowest + 1} change their sets at once", is_so, f"it took {took_ms} ms")
            case "late":
                late_ms = self._slots(arguments[0]).late_ns_max / MS
                self._expect(f"{arguments[0]} was late by {arguments[1:]} ms", at_least <= late_ms <= at_most, late_ms)
            case _:
                raise ValueError(f"a scenario of slots knows no verb {verb!r}")

    def _sets_told(self) -> str:
        robots = [robot for robot in self.team.robots if robot.slots is not None]
        return "; ".join(f"{robot.rank + 1}: {' '.join(robot.slots.view().members)}" for robot in robots if robot.slots)

    def _expect(self, what: str, is_so: bool, found: object) -> None:
        if not is_so:
            self._fail(f"{what}: no, {found}")


def _terms(usual: Terms, words: list[str]) -> Terms:
    settings = dict(word.split("=") for word in words)
    values = {key: value == "true" if value in ("true", "false") else float(value) for key, value in settings.items()}
    return msgspec.convert(msgspec.to_builtins(usual) | values, Terms, strict=False)
