"""Scenarios that a person can read, played by the daemon's own rules.

A file is lines of ``AT ms VERB arguments``; ``#`` begins a comment. ``expect`` looks at the world at that instant:

    team robot1 robot2 robot3              who is in the team, if not robot1 and robot2; before everything else
    votes robot1 robot2 witness1           the same, and primaries are elected; servers have their role by their name, too
    archive                                robots go on from copies where none of them has a checkpoint; after the team
    boot-patience 5000                     of robots that start, in ms; before everything but that
    rule when_alone=freeze on_loss=hold    rules of the component, before everything but that
    0    on robot1                         start a robot; off: power cut; agent-dies: guards and programs live on
    100  run robot1                        an operator starts the component there
    500  cut robot1 robot2                 nothing passes, both ways;  one-way A B: from A to B;  mend: all cuts end
    500  sealed robot1 robot2              neither can authenticate the other, until both have been told: read robot1 robot2
    500  noise robot2 robot1 900           for 900 ms an attacker sends robot1 garbage from robot2's address
    550  old-team robot1 robot2            from its next start on robot1's team file does not know robot2;  new-team robot1 robot2
    500  lies witness1 finishes            from now on its heartbeats are changed on their way (liars.py);  honest: not any more
    900  later robot1 5000                 it is off, and on its disk so many more epochs have passed
    900  tells robot1 witness1 ends runs   robot1 has refused words of witness1 for these reasons, and for no others
    600  stall robot1 300                  its loop gets no processor for 300 ms
    600  slow robot1 40                    its disk and its captures take so many times as long
    600  fails robot1 2                    the next two restores there come to nothing
    600  refuses robot1                    a program that is resumed there ends at once: it cannot read its state;  takes: it can
    700  exit robot1 0                     its program ends with this wait status (11: crash)
    800  handover robot1                   an operator moves it to the standby
    800  promote robot1                    an operator has robot1 run it, without waiting for others
    850  new-disk robot1                   its checkpoints are gone; its decisions are not
    850  new-robot robot1                  both are gone
    900  expect robot1 primary             its state there
    900  epoch robot1 2                    the epoch it knows
    900  standby robot1 robot2             where the checkpoints of the one that runs at robot1 go
    900  acts robot1                       where it computes: robots, or nobody
    900  gives-up                          from now on an older checkpoint than the acknowledged one may be used
    900  offers robot2 1 4                 how often it has offered a checkpoint since the last such line: at least, at most
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import msgspec
from msgspec.structs import replace

from failover.core import acts
from failover.core.events import Drain, Handover, Promote, Run, Stop
from failover.core.types import MS, ComponentSpec, Config, Launch, Rules
from tests.simulation.archive import COPIES_MS
from tests.simulation.invariants import Invariants, seen_at, state_at
from tests.simulation.liars import by_name
from tests.simulation.planned import with_grace
from tests.simulation.teams import elective, pair, with_copies
from tests.simulation.world import World

COMPONENT = "/team/part"


@dataclass(slots=True)
class Story:
    """One scenario being played. ``failures``: expectations that were not met."""

    rules: Rules = field(default_factory=Rules)
    failures: list[str] = field(default_factory=list)
    offers: Counter[str] = field(default_factory=Counter)
    world: World = field(init=False)
    invariants: Invariants = field(init=False)

    def play(self, text: str) -> World:
        """Play the lines in order; raises AssertionError with the story when an expectation is not met."""
        lines = [words for line in text.splitlines() if (words := line.split("#")[0].split())]
        kind, *members = lines.pop(0) if lines[0][0] in ("team", "votes") else ("team", "robot1", "robot2")
        names, votes = tuple(members), kind == "votes"
        copies_ms = COPIES_MS if lines[0][0] == "archive" and lines.pop(0) else 0
        boot_patience_ms = int(lines.pop(0)[1]) if lines[0][0] == "boot-patience" else 0
        grace_ms = int(lines.pop(0)[1]) if lines[0][0] == "grace" else 0
        if lines[0][0] == "rule":
            self.rules = _rules(lines.pop(0)[1:])
        safe = {COMPONENT} if votes or self.rules.when_alone == "freeze" else set()
        self.invariants = Invariants(safe=safe, votes=votes)
        configs = _voters(names) if votes else pair((), names, boot_patience_ms)
        configs = with_grace(configs, grace_ms) if grace_ms else configs
        configs = with_copies(configs, copies_ms)
        self.world = World(1, configs, (self.invariants, self._count))
        for at_ms, verb, *arguments in lines:
            self.world.run(int(at_ms) * MS)
            self._play(verb, arguments)
        assert not self.failures, "\n".join([*self.failures, *self.world.log])
        return self.world

    def _count(self, world: World, robot: str, what: object) -> None:
        self.offers[robot] += isinstance(what, acts.Ship)

    def _play(self, verb: str, arguments: list[str]) -> None:
        world, robot = self.world, arguments[0] if arguments else ""
        match verb:
            case "on":
                world.power_on(robot)
            case "off":
                world.power_off(robot)
            case "restart":
                world.restart(robot, int(arguments[1]) * MS)
            case "drain" | "undrain":
                world.command(robot, Drain(world.request(), verb == "drain"))
            case "agent-dies":
                world.agent_dies(robot)
            case "run":
                spec = ComponentSpec(COMPONENT, launch=Launch(("part",)), rules=self.rules)
                world.command(robot, Run(world.request(), spec))
            case "stop":
                world.command(robot, Stop(world.request(), COMPONENT))
            case "promote":
                world.command(robot, Promote(world.request(), COMPONENT))
            case "handover":
                world.command(robot, Handover(world.request(), COMPONENT))
            case "exit":
                self.invariants.crashing.add((robot, COMPONENT))
                world.program_ends(robot, COMPONENT, int(arguments[1]))
            case "lies":
                world.robots[robot].lie = by_name(arguments[1])
            case "honest":
                world.robots[robot].lie = None
            case "later":
                world.later(robot, int(arguments[1]))
            case "tells":
                node = world.robots[robot].node
                found = {str(why) for (whose, why) in (node._testimony.refusals if node else ()) if whose == arguments[1]}
                self._expect(f"{robot} has refused words of {arguments[1]}:", str(sorted(found)), str(sorted(arguments[2:])))
            case "stall":
                world.stall(robot, int(arguments[1]) * MS)
            case "fails":
                world.robots[robot].failing = int(arguments[1])
            case "refuses" | "takes":
                world.robots[robot].refuses = verb == "refuses"
            case "slow":
                world.robots[robot].slow = float(arguments[1])
            case "cut":
                world.network.cuts |= {(robot, arguments[1]), (arguments[1], robot)}
            case "one-way":
                world.network.cuts.add((robot, arguments[1]))
            case "mend":
                world.network.cuts.clear()
            case "sealed":
                world.network.sealed |= {(robot, arguments[1]), (arguments[1], robot)}
            case "read":
                world.network.sealed -= {(robot, arguments[1]), (arguments[1], robot)}
            case "noise":
                world.noise(robot, arguments[1], world.now_ns + int(arguments[2]) * MS)
            case "old-team" | "new-team":
                config = world.robots[robot].config
                others = {*config.peers} - {arguments[1]} if verb == "old-team" else {*config.peers, arguments[1]}
                world.robots[robot].config = replace(config, peers=tuple(sorted(others)))
            case "new-disk" | "new-robot":
                world.new_disk(robot, vote_record=verb == "new-robot")
            case "epoch":
                self._expect(f"the epoch at {robot} is", str(seen_at(world, robot, COMPONENT).epoch), arguments[1])
            case "gives-up":
                self.invariants.split.add(COMPONENT)
            case "offers":
                least, most = map(int, arguments[1:])
                found = self.offers.pop(robot, 0)
                self._expect(f"{robot} has offered {found}:", str(least <= found <= most), "True")
            case "expect":
                self._expect(f"{robot} is", state_at(world, robot, COMPONENT), " ".join(arguments[1:]))
            case "standby":
                self._expect(f"the standby of {robot} is", seen_at(world, robot, COMPONENT).standby, arguments[1])
            case "acts":
                self._expect("it acts at", " ".join(world.acting(COMPONENT)) or "nobody", " ".join(arguments))
            case _:
                raise ValueError(f"a scenario knows no verb {verb!r}")

    def _expect(self, what: str, found: str, wanted: str) -> None:
        if found != wanted:
            self.failures.append(f"at {self.world.now_ns // MS} ms {what} {found}, not {wanted}")


def _voters(names: tuple[str, ...]) -> list[Config]:
    def count(kind: str) -> int:
        return sum(name.startswith(kind) for name in names)

    return elective(count("robot"), servers=count("server"), witnesses=count("witness"), patience_ms=1_000)


def _rules(words: list[str]) -> Rules:
    settings = dict(word.split("=") for word in words)
    return msgspec.convert(settings, Rules, strict=False)
