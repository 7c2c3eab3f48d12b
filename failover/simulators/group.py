"""One process of simulated robots, all those of some labs: ``python -m failover.simulators``, which `run` starts.

At each activation of its task its labs move on by a tick, items are put on the board, and each robot's controller acts. The main
thread carries out what programs ask the devices for. At a pace of "max" there is no real time, and no device answers.
"""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import msgspec

from failover.boards import SCHEDULE_NAME, boottime
from failover.boards.board import board
from failover.boards.schedule_file import ScheduleFile
from failover.core.schedule import orders
from failover.drivers.many import ManyDrivers
from failover.errors import FailoverError, ScheduleError
from failover.schedule.task import scheduled
from failover.simulators import devices
from failover.simulators.guests import NAME, Guest
from failover.simulators.lateness import Spans
from failover.simulators.messages import SIZE_SIZE, Spec, Told
from failover.simulators.world.life import Life, items_of
from failover.simulators.world.parts import TICK_S

NS: Final = 1_000_000_000

PRIORITY: Final = 1
"""Of SCHED_RR: below all that agents and tasks have."""

SKIPPED_MAX: Final = 20
"""Ticks that are skipped before this process gives its priority back: the simulation does not fit on this machine."""

LOOK_TICKS: Final = 64
"""Without real time: between two looks whether it is to end."""


class Group:
    """The labs of one process, on the board."""

    def __init__(self, spec: Spec, stack: contextlib.ExitStack) -> None:
        """
        Raises:
            BoardError: the board cannot be had.
        """
        self.spec = spec
        self.lives = [Life(spec.world, lab) for lab in spec.world.labs]
        self.is_over = threading.Event()
        self.stop: Callable[[], None] = self.is_over.set
        self.late, self.took = Spans(), Spans()
        self.activations = self.missed = 0
        self._began_s = self._began_cpu_s = 0.0
        own = stack.enter_context(board(spec.place or None, NAME))
        self.place: Path = own.directory
        group = (self.place / "own").stat().st_gid
        self._guests: list[list[Guest]] = []
        for life in self.lives:
            guests = []
            for robot in life.robots:
                guests.append(Guest(self.place, spec.world.prefix, robot.name, items_of(robot), group))
                stack.callback(guests[-1].close)
            self._guests.append(guests)
        self._tell()  # who finds the robots finds their values

    # --- Ticks ------------------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """The first tick comes next."""
        self._began_s, self._began_cpu_s = time.monotonic(), time.process_time()

    def tick(self) -> None:
        """The world moves on, and tells."""
        for life in self.lives:
            life.turn()
        self._tell()

    def _tell(self) -> None:
        for life, guests in zip(self.lives, self._guests, strict=True):
            for robot, values in life.values():
                guests[robot].put(values, life.tick + 1)

    def act(self, due_ns: int = 0, deadline_ns: int = 0) -> None:
        """Each robot's controller, one after the other; ``due_ns``: CLOCK_MONOTONIC of this process; 0: in no real time."""
        for life in self.lives:
            for robot in range(len(life.robots)):
                began_ns = boottime.now_monotonic_ns() if due_ns else 0
                life.control(robot)
                self.activations += 1
                if due_ns:
                    ended_ns = boottime.now_monotonic_ns()
                    self.late.note(began_ns - due_ns)
                    self.took.note(ended_ns - began_ns)
                    self.missed += ended_ns > due_ns + deadline_ns

    def skip(self, ticks: int) -> None:
        """Activations that were not begun: the world moved on without controllers."""
        for life in self.lives:
            for _ in range(ticks):
                life.turn()
            self.missed += ticks * len(life.robots)

    @property
    def is_done(self) -> bool:
        """Whether the time of the simulation has passed."""
        return self.is_over.is_set() or (bool(self.spec.ticks) and self.lives[0].tick >= self.spec.ticks)

    def figures(self) -> Told:
        """Until now."""
        used = resource.getrusage(resource.RUSAGE_SELF)
        return Told(
            activations=self.activations,
            missed=self.missed,
            ticks=self.lives[0].tick,
            seconds=time.monotonic() - self._began_s,
            late=(self.late.counts, self.late.longest_ns),
            took=(self.took.counts, self.took.longest_ns),
            cpu_s=time.process_time() - self._began_cpu_s,
            memory=used.ru_maxrss << 10,
            digests={lab.name: life.digest for lab, life in zip(self.spec.world.labs, self.lives, strict=True)},
        )

    def told(self) -> dict[str, Any]:
        """The same for a person who asks the process."""
        found = self.figures()
        return {
            "activations": found.activations,
            "missed": found.missed,
            "seconds": round(found.seconds, 1),
            "late_ms": self.late.told(),
            "took_ms": self.took.told(),
        }


# --- In real time -----------------------------------------------------------------------------------------------------


def live(group: Group, stop: int) -> None:
    """Tick at the instants of the schedule, and answer programs, until it is over.

    Args:
        stop: a descriptor that can be read when it is to end.

    Raises:
        DriverError, NameFormatError, ScheduleError: it cannot begin.
    """
    spec = group.spec
    path = f"{spec.world.prefix}/World/{spec.number}"
    found = [one for life in group.lives for one in devices.devices(spec.world, life)]
    trouble: list[BaseException] = []
    with ManyDrivers(devices.process(path, group.told), found) as serving:
        ticking = threading.Thread(target=_ticking, args=(group, path, serving, trouble), name="failover ticks")
        group.stop = serving.stop
        serving.end_with(stop)
        gc.freeze()  # a look at all these names would hold controllers up, and find nothing
        _begin_together(stop)
        ticking.start()
        _go_ahead()
        serving.serve()
        group.is_over.set()
        ticking.join()
    if trouble:
        raise trouble[0]


def _go_ahead() -> None:
    """Run both threads ahead of ordinary processes, where this user may: a browser that starts takes all processors for 50 ms.

    Both, as each waits for the interpreter's lock while the other one has it.
    """
    _schedule(os.SCHED_RR, PRIORITY)


def _schedule(policy: int, priority: int) -> None:
    with contextlib.suppress(PermissionError):
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread), policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def _ticking(group: Group, path: str, serving: ManyDrivers, trouble: list[BaseException]) -> None:
    """The thread of the task; whatever ends it ends the process."""
    try:
        _run_task(group, path)
    except BaseException as error:  # noqa: BLE001  the main thread raises it
        trouble.append(error)
    finally:
        serving.stop()


def _run_task(group: Group, path: str) -> None:
    spec = group.spec
    period_s = TICK_S / spec.pace
    phase_s = period_s * (spec.number - 1) / spec.of
    deadline_ns = round(period_s * NS)
    task = scheduled(path, period=period_s, phase=phase_s, deadline=period_s, place=group.place)
    skipped = 0
    try:
        group.begin()
        while not group.is_done and (tick := task.wait_activation()) is not None:
            if tick.missed:
                skipped += tick.missed
                if skipped > SKIPPED_MAX:
                    _schedule(os.SCHED_OTHER, 0)  # other processes need the processors, too
                group.skip(tick.missed)
            group.tick()
            group.act(tick.due_ns, deadline_ns)
    finally:
        task.close()
        _forget(group.place, path)


def _forget(place: Path, task: str) -> None:
    """Take the task off the schedule: no process is to run it."""
    with contextlib.suppress(ScheduleError, OSError):
        file = ScheduleFile.open(place / SCHEDULE_NAME)
        try:
            file.give(lambda rows, _: orders.removed(rows, [task]))
        finally:
            file.close()


# --- In no real time --------------------------------------------------------------------------------------------------


def race(group: Group, stop: int) -> None:
    """Tick as fast as this machine can, until it is over."""
    _begin_together(stop)
    group.begin()
    while not group.is_done:
        group.tick()
        group.act()
        if group.lives[0].tick % LOOK_TICKS == 0 and select.select([stop], [], [], 0)[0]:
            group.is_over.set()


# --- The process ------------------------------------------------------------------------------------------------------


def _say(told: Told) -> None:
    with contextlib.suppress(BrokenPipeError):  # no process listens any more
        content = memoryview(msgspec.json.encode(told) + b"\n")
        while content:
            content = content[os.write(1, content) :]


def _begin_together(stop: int) -> None:
    """Wait until all processes are ready; at the end of standard input, too: then the first look ends it."""
    _say(Told(ready=True))
    os.read(stop, 1)


def _spec(descriptor: int) -> Spec:
    """What comes first on standard input; its size stands before it, so that nothing behind it is read."""
    size = int.from_bytes(os.read(descriptor, SIZE_SIZE), "big")
    content = bytearray()
    while len(content) < size and (more := os.read(descriptor, size - len(content))):
        content += more
    return msgspec.json.decode(bytes(content), type=Spec)


def main() -> int:
    """Simulate some labs; what there is to say goes to standard output, a line of JSON each."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = sys.stdin.fileno()
    try:
        spec = _spec(stop)
        with contextlib.ExitStack() as stack:
            group = Group(spec, stack)
            signal.signal(signal.SIGTERM, lambda *_: group.stop())
            (live if spec.pace else race)(group, stop)
            _say(group.figures())
    except (FailoverError, OSError) as error:
        _say(Told(error=str(error)))
        return 1
    return 0
