"""Stories that a person can read, played by the daemon's own rules.

A file is lines of ``AT ms VERB arguments``; ``#`` begins a comment. ``expect`` looks at the world at that instant:

    rule when_alone=freeze on_loss=hold    rules of the component, before everything else
    0    on robot1                         start a robot; off: power cut; agent-dies: guards and programs live on
    100  run robot1                        an operator starts the component there
    500  cut robot1 robot2                 nothing passes, both ways;  one-way A B: from A to B;  mend: all cuts end
    600  stall robot1 300                  its loop gets no processor for 300 ms
    700  exit robot1 0                     its program ends with this wait status (11: crash)
    800  handover robot1                   an operator moves it to the standby
    900  expect robot1 primary             its state there
    900  acts robot1                       where it computes: robots, or nobody
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from failover.core.events import Handover, Run, Stop
from failover.core.types import MS, ComponentSpec, Launch, Rules
from tests.simulation.invariants import Invariants, state_at
from tests.simulation.world import World, pair

COMPONENT = "/team/part"


@dataclass(slots=True)
class Story:
    """One scenario being played. ``failures``: expectations that were not met."""

    rules: Rules = field(default_factory=Rules)
    failures: list[str] = field(default_factory=list)
    world: World = field(init=False)
    invariants: Invariants = field(init=False)

    def play(self, text: str) -> World:
        """Play the lines in order; raises AssertionError with the story when an expectation is not met."""
        lines = [words for line in text.splitlines() if (words := line.split("#")[0].split())]
        if lines[0][0] == "rule":
            self.rules = _rules(lines.pop(0)[1:])
        self.invariants = Invariants(safe={COMPONENT} if self.rules.when_alone == "freeze" else set())
        self.world = World(1, pair(), (self.invariants,))
        for at_ms, verb, *arguments in lines:
            self.world.run(int(at_ms) * MS)
            self._play(verb, arguments)
        assert not self.failures, "\n".join([*self.failures, *self.world.log])
        return self.world

    def _play(self, verb: str, arguments: list[str]) -> None:
        world, robot = self.world, arguments[0] if arguments else ""
        match verb:
            case "on":
                world.power_on(robot)
            case "off":
                world.power_off(robot)
            case "agent-dies":
                world.agent_dies(robot)
            case "run":
                spec = ComponentSpec(COMPONENT, launch=Launch(("part",)), rules=self.rules)
                world.command(robot, Run(world.request(), spec))
            case "stop":
                world.command(robot, Stop(world.request(), COMPONENT))
            case "handover":
                world.command(robot, Handover(world.request(), COMPONENT))
            case "exit":
                self.invariants.crashing.add((robot, COMPONENT))
                world.program_ends(robot, COMPONENT, int(arguments[1]))
            case "stall":
                world.stall(robot, int(arguments[1]) * MS)
            case "cut":
                world.network.cuts |= {(robot, arguments[1]), (arguments[1], robot)}
            case "one-way":
                world.network.cuts.add((robot, arguments[1]))
            case "mend":
                world.network.cuts.clear()
            case "expect":
                self._expect(f"{robot} is", state_at(world, robot, COMPONENT), " ".join(arguments[1:]))
            case "acts":
                self._expect("it acts at", " ".join(world.acting(COMPONENT)) or "nobody", " ".join(arguments))
            case _:
                raise ValueError(f"a scenario knows no verb {verb!r}")

    def _expect(self, what: str, found: str, wanted: str) -> None:
        if found != wanted:
            self.failures.append(f"at {self.world.now_ns // MS} ms {what} {found}, not {wanted}")


def _rules(words: list[str]) -> Rules:
    settings = dict(word.split("=") for word in words)
    return msgspec.convert(settings, Rules, strict=False)
