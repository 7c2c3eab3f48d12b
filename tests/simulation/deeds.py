"""How a simulated robot carries out the orders of its rules: programs, snapshots, transfers.

Everything takes a while and may fail.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from msgspec.structs import replace

from checkpoint.model import Position
from failover.core import acts
from failover.core.events import (
    ActFailed,
    Captured,
    CaptureFailed,
    Event,
    Exited,
    Inquired,
    Leased,
    Restored,
    ShipEnded,
    Started,
    Stopped,
    Stored,
    StoreFailed,
    Unchanged,
    Warmed,
)
from failover.core.types import PEERS_MAX
from tests.simulation.robots import KEEPS_STATE, Program, Robot

if TYPE_CHECKING:
    from tests.simulation.world import World

REFUSES = 1 << 8
"""The wait status of a program that cannot read its state."""

WARM_FAILS = 0.2
"""Of the programs that are started in advance."""

LACKING = 0.3
"""Of the times that a robot is asked whether a component could go on there."""
LACK = ("the device /dev/ttyUSB0 is missing here",)


class Deeds:
    """Carries out acts in one world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._digests = itertools.count(1)

    def carry_out(self, robot: Robot, act: acts.Act) -> None:
        """Begin with an act; what comes of it is an event."""
        match act:
            case acts.Start() | acts.Restore() | acts.Stop():
                self._whole_program(robot, act)
            case acts.Capture():
                self._capture(robot, act)
            case acts.Ship():
                self._ship(robot, act)
            case acts.Acknowledge():
                robot.keeper[act.component] = act.position
            case acts.Discard():
                kept = robot.store.get(act.component, [])
                robot.store[act.component] = [position for position in kept if position != act.position]
            case acts.Admit():
                robot.admitted[act.component] = (act.sender, act.epoch)
            case acts.Forget():
                kept = [position for position in robot.store.get(act.component, []) if position.generation not in act.generations]
                robot.store[act.component] = kept
            case acts.Drop():
                robot.store.pop(act.component, None)
            case acts.Freeze() | acts.Thaw() | acts.SetLease() | acts.End() | acts.LetGo():
                self._guard(robot, act)
            case acts.Warm() | acts.Cool():
                self._warm(robot, act)
            case acts.Inquire():
                self._inquire(robot, act)
            case acts.Look():
                if self._world.archive is not None:
                    self._world.archive.look(robot, act.component)
            case acts.Answer():
                self._world.note(f"{robot.name} answers: {'; '.join((act.sentence, *act.risks))}")

    def _guard(self, robot: Robot, act: acts.Freeze | acts.Thaw | acts.SetLease | acts.End | acts.LetGo) -> None:
        program = robot.programs.get(act.component)
        if isinstance(act, acts.SetLease):
            robot.leases[act.component] = act.until_ns
        if program is None or program.exit_status is not None:
            return
        self._world.settle(robot, program)
        program.epoch = max(program.epoch, act.epoch)
        match act:
            case acts.Freeze():
                program.frozen = True
            case acts.Thaw():
                robot.unheld.add(act.component)
                program.frozen, program.lapsed, program.lease_ns = False, False, act.lease_until_ns
            case acts.SetLease():
                program.lease_ns = act.until_ns
                program.lapsed = program.lapsed and 0 < act.until_ns <= self._world.local(robot)
                if act.is_asked:
                    self._world.feed(robot, Leased(act.component, act.epoch, act.until_ns))
            case acts.End():
                self._world.program_ends(robot.name, act.component, act.signal)
            case acts.LetGo():
                del robot.programs[act.component]

    def _warm(self, robot: Robot, act: acts.Warm | acts.Cool) -> None:
        """A program that waits takes a while to get there, and sometimes fails and is tried again."""
        name, life = act.component, robot.life
        robot.warm.pop(name, None)
        if isinstance(act, acts.Cool):
            return
        launch = robot.warm[name] = replace(act.spec.launch)  # one of its own, to be told from the next

        def done(ready: bool) -> None:
            if robot.life != life or robot.warm.get(name) is not launch:
                return
            self._world.feed(robot, Warmed(name, act.epoch, ready, "" if ready else "it ended at once"))
            if not ready:
                self._world.after(self._world.soon(50, 100), lambda: done(True))

        fails = self._world.random.random() < WARM_FAILS
        self._world.after(self._world.soon(20, 200) * robot.slow, lambda: done(not fails))

    def _inquire(self, robot: Robot, act: acts.Inquire) -> None:
        """Another robot looks what it lacks; if no message gets through, this robot learns nothing."""
        life = robot.life
        now_and_then = LACK if self._world.random.random() < LACKING else ()

        def done() -> None:
            asked = self._world.robots[act.to].lacks
            lacks = now_and_then if asked is None else asked
            if robot.life == life and self._world.passes(robot.name, act.to) and self._world.passes(act.to, robot.name):
                self._world.feed(robot, Inquired(act.component, act.epoch, act.to, lacks))

        self._world.after(self._world.soon(20, 300) * robot.slow, done)

    def _whole_program(self, robot: Robot, act: acts.Start | acts.Restore | acts.Stop) -> None:
        name, life = act.component, robot.life
        robot.serial[name] = serial = robot.serial.get(name, 0) + 1
        robot.capturing.discard(name)
        robot.warm.pop(name, None)
        if not isinstance(act, acts.Stop):
            robot.leases[name] = act.lease_until_ns
        if isinstance(act, acts.Restore):
            robot.programs.pop(name, None)
        if not isinstance(act, acts.Start):
            robot.keeper.pop(name, None)

        def done() -> None:
            if robot.life != life or robot.serial[name] != serial:
                return
            match act:
                case acts.Stop():
                    robot.programs.pop(name, None)
                    self._world.feed(robot, Stopped(name, act.epoch))
                case acts.Start():
                    robot.programs[name] = Program(act.epoch, robot.leases[name], since_ns=self._world.now_ns)
                    self._world.feed(robot, Started(name, act.epoch))
                case acts.Restore():
                    self._restored(robot, act)

        self._world.after(self._world.soon(2, 40) * robot.slow, done)

    def _restored(self, robot: Robot, act: acts.Restore) -> None:
        if act.position not in robot.store.get(act.component, []):
            self._world.feed(robot, ActFailed(act.component, act.epoch, f"{act.position} is not in the store", act.position))
            return
        if robot.failing:
            robot.failing -= 1
            self._world.faults += 1
            self._world.feed(robot, ActFailed(act.component, act.epoch, "there is no memory"))
            return
        program = Program(act.epoch, robot.leases[act.component], self._world.values[act.position], since_ns=self._world.now_ns)
        robot.programs[act.component] = program
        self._world.note(f"{robot.name}: {act.component} goes on from {act.position.generation}/{act.position.sequence}")
        self._world.feed(robot, Restored(act.component, act.epoch, act.position))
        if robot.refuses:
            self._refuse(robot, act.component, program)

    def _refuse(self, robot: Robot, component: str, program: Program) -> None:
        """The program cannot read its state here, and says so by its exit code."""
        program.exit_status = REFUSES
        self._world.feed(
            robot, Exited(component, program.epoch, REFUSES, f"{component} ended with exit code 1 before it kept anything")
        )

    def _capture(self, robot: Robot, act: acts.Capture) -> None:
        name, life, serial = act.component, robot.life, robot.serial.get(act.component, 0)
        program = robot.programs.get(name)
        if program is not None:
            program.epoch = max(program.epoch, act.epoch)
        robot.capturing.add(name)
        robot.unheld.discard(name)

        def done() -> None:
            if robot.life != life or robot.serial.get(name, 0) != serial:
                return
            robot.capturing.discard(name)
            program = robot.programs.get(name)
            if program is None or program.exit_status is not None:
                self._world.feed(robot, CaptureFailed(name, act.epoch, "the program is gone"))
                return
            if not self._world.unfrozen(robot, name):
                self._world.feed(robot, CaptureFailed(name, act.epoch, "its guard holds it still"))
                return
            known = robot.keeper.get(name)
            may_be_unchanged = self._world.unchanged and known is not None and not act.base and not act.hold
            if known is not None and may_be_unchanged and self._world.random.random() < self._world.unchanged:
                self._world.feed(robot, Unchanged(name, act.epoch, act.sequence, known))
                return
            self._world.settle(robot, program)
            program.frozen = program.frozen or (act.hold and name not in robot.unheld)
            position = Position(act.generation, act.sequence, next(self._digests).to_bytes(8, "big"))
            parent = None if act.base else robot.keeper.get(name)
            self._world.values[position] = program.value
            self._write(robot, name, position, Captured(name, act.epoch, position, parent, freeze_us=900))

        self._world.after(self._world.soon(1, 8) * robot.slow, done)

    def _write(self, robot: Robot, component: str, position: Position, then: Event) -> None:
        """Keep a snapshot in a robot's store, durably; only then it is told."""
        life, written = robot.life, (component, position)
        robot.writing.append(written)

        def done() -> None:
            if robot.life != life:
                return
            robot.writing.remove(written)
            if position not in robot.store.get(component, []):
                robot.store[component] = [*robot.store.get(component, []), position]
            self._world.feed(robot, then)

        self._world.after(self._world.soon(0, 2) * robot.slow, done)

    def _ship(self, robot: Robot, act: acts.Ship) -> None:
        life, to = robot.life, self._world.robots[act.to]

        def arrive() -> None:
            ok = (
                robot.life == life
                and self._world.passes(robot.name, act.to)
                and self._world.passes(act.to, robot.name)
                and to.node is not None
            )
            sender, epoch = to.admitted.get(act.component, ("", 0))
            admitted = sender == robot.name and epoch_of(act.position) >= epoch
            if robot.life == life:
                self._world.feed(robot, ShipEnded(act.component, act.epoch, act.position, act.to, ok and admitted))
            if ok and admitted:
                self._store(to, robot.name, act)

        self._world.after((self._world.soon(2, 30) + self._world.network.delay_ns) * robot.slow, arrive)

    def _store(self, robot: Robot, sender: str, act: acts.Ship) -> None:
        life = robot.life

        def done() -> None:
            if robot.life != life:
                return
            kept = robot.store.get(act.component, [])
            if robot.broken_store:
                self._world.feed(robot, StoreFailed(act.component, epoch_of(act.position), sender, "no space left", False))
            elif act.parent is not None and act.parent not in kept:
                self._world.feed(
                    robot, StoreFailed(act.component, epoch_of(act.position), sender, "its parent is not here", True)
                )
            else:
                keeps = act.spec.launch.engine == KEEPS_STATE
                told = act.acknowledged
                stored = Stored(act.component, epoch_of(act.position), act.position, sender, act.spec, keeps, told)
                self._write(robot, act.component, act.position, stored)

        self._world.after(self._world.soon(1, 10) * robot.slow, done)


def epoch_of(position: Position) -> int:
    """The epoch under which a snapshot was captured, as its file says."""
    return position.generation // (PEERS_MAX + 1)
