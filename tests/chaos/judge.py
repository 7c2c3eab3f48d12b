"""Checks what must never happen: by the actuator's record and by the promises to readers of the programs' output.

* *No two copies act at once.* Commands are in one queue: once another copy has commanded, the earlier one commands no more,
  and the epochs that copies carry only grow.
* *Nothing that was acknowledged is lost.* A step is acknowledged when its program was told that it is safe, or when a reader of
  its output (`--output=committed`) has seen it. Every copy begins after the steps acknowledged by then; and the history of the
  newest copy, proved by its seals, contains every acknowledged step.
* *Everything resumes.* `tests.chaos.campaign` waits for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from tests.chaos.actuator import Command, Safe

MS = 1_000_000


class BrokenPromiseError(AssertionError):
    """One of the promises above was broken."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Nothing was commanded from the one instant to the other (CLOCK_MONOTONIC).

    Attributes:
        moved: another copy went on afterwards.
        lost: steps that the first copy had commanded and the second one did again.
    """

    component: str
    begin_ns: int
    end_ns: int
    moved: bool
    lost: int

    @property
    def length_ms(self) -> float:
        """How long it was."""
        return (self.end_ns - self.begin_ns) / MS


@dataclass(slots=True)
class History:
    """All that is known of one component.

    Attributes:
        acknowledged: the newest step that was, and its seal.
        newest: command.
        over: copies that another one has followed.
        before: of each (step, seal) that was commanded, the seal of the step before; steps and seals together name a state.
        first: command of the copy that acts now.
    """

    component: str
    acknowledged: tuple[int, int] = (0, 0)
    newest: Command | None = None
    first: Command | None = None
    over: set[str] = field(default_factory=set)
    before: dict[tuple[int, int], int] = field(default_factory=dict)
    pauses: list[Pause] = field(default_factory=list)
    commands: int = 0

    def take(self, command: Command, longer_than_ns: int) -> None:
        """The next command.

        Raises:
            BrokenPromiseError: a copy acts that may not, or from a state that it may not have.
        """
        last, self.newest = self.newest, command
        self.before[command.step, command.seal] = command.before
        self.commands += 1
        moved = last is None or last.copy != command.copy
        if moved:
            self._begin(last, command)
        elif last is not None and (command.step, command.before) != (last.step + 1, last.seal):
            raise BrokenPromiseError(f"{self.component}: one copy goes from step {last.step} to {command.step}: {last} {command}")
        if last is not None and (moved or command.at_ns - last.at_ns > longer_than_ns):
            lost = max(last.step - command.step + 1, 0)
            self.pauses.append(Pause(self.component, last.at_ns, command.at_ns, moved, lost))

    def acknowledge(self, step: int, seal: int) -> None:
        """A reader or the program has learnt, before the next command that is taken in, that this step is safe."""
        if step > self.acknowledged[0]:
            self.acknowledged = (step, seal)

    def stands_on(self, step: int, seal: int) -> bool:
        """Whether the newest command's history contains that step with that seal."""
        assert self.newest is not None
        at = (self.newest.step, self.newest.seal)
        while at[0] > step and at in self.before:
            at = (at[0] - 1, self.before[at])
        return at == (step, seal)

    def _begin(self, last: Command | None, command: Command) -> None:
        """Another copy commands for the first time."""
        if command.copy in self.over:
            raise BrokenPromiseError(f"{self.component}: two copies act at once: {command} follows {last}")
        if last is not None:
            self.over.add(last.copy)
            if command.epoch < last.epoch:
                raise BrokenPromiseError(f"{self.component}: an older epoch acts: {command} follows {last}")
        self.first = command
        if command.step <= self.acknowledged[0]:
            raise BrokenPromiseError(
                f"{self.component}: step {self.acknowledged[0]} was acknowledged, and yet a copy goes on with {command}"
            )
        if not self.stands_on(*self.acknowledged):
            raise BrokenPromiseError(
                f"{self.component}: {self.acknowledged} was acknowledged and is not in the past of {command}"
            )


class Judge:
    """Takes in what the actuator wrote and what readers saw; raises as soon as a promise is broken."""

    def __init__(self, components: Iterable[str], longer_than_ms: int) -> None:
        """
        Args:
            longer_than_ms: an interval between two commands that is told as a pause.
        """
        self.histories = {component: History(component) for component in components}
        self._longer_than_ns = longer_than_ms * MS

    def hear(self, said: Iterable[Command | Safe]) -> None:
        """Take in the lines that the actuator wrote.

        Raises:
            BrokenPromiseError: names the component and the commands.
        """
        for one in said:
            history = self.histories[one.component]
            if isinstance(one, Safe):
                history.acknowledge(one.step, one.seal)
            else:
                history.take(one, self._longer_than_ns)

    def pauses(self) -> list[Pause]:
        """Of all components."""
        return [pause for history in self.histories.values() for pause in history.pauses]


def percentile(values: list[float], share: float) -> float:
    """The smallest value that is not exceeded by this share of them; 0 of none."""
    ordered = sorted(values)
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0
