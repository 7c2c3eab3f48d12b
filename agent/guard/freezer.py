"""Freezes a component without a tracer: a ptrace stop ends when its tracer dies, so a lease must not depend on one.

Two ways, one contract. A cgroup of version 2 freezes every process in it, also those that the program started, and the program
cannot notice. Where the guard may not make a cgroup, it sends SIGSTOP to every descendant until no new one appears. A program can
notice that: its parent sees a stop, and a SIGCONT follows.

Sources: cgroup-v2.rst of the kernel ("cgroup.freeze", "cgroup.kill"), signal(7), proc_pid_stat(5).
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Final, Literal, Protocol

SETTLE_S: Final = 1.0
"""How long a freeze may take to reach every thread; one that waits for a disk is only held when the disk answers."""

SETTLE_STEP_S: Final = 0.001
STANDING: Final = frozenset("TZX")
"""States of /proc/PID/stat in which a process runs nothing, whichever other process lives or dies."""
HELD: Final = STANDING | {"t"}
"""The same, with a tracer that holds it now: once SIGSTOP is pending, it stands also when that tracer dies."""

THREADS: Final = 17
"""The index of the number of threads in the fields of `_stat`; the state's is 0. Source: proc_pid_stat(5)."""


class Freezer(Protocol):
    """Something that can hold a component still. All methods raise OSError only for faults that should not happen."""

    kind: Literal["cgroup", "SIGSTOP"]

    def birthplace(self) -> AbstractContextManager[None]:
        """Processes that this process starts within the body are born inside."""

    def add(self, pid: int) -> None:
        """Take a process that is there already, and those that it starts from now on."""

    def freeze(self) -> bool:
        """Hold everything; True once every thread stands, False if one does not yet (it will as soon as it leaves the kernel)."""

    def expose(self) -> None:
        """Hold the frozen processes so that a tracer can make calls in them, too; none of them runs by itself meanwhile."""

    def thaw(self) -> None:
        """Let everything go on."""

    def kill(self) -> None:
        """SIGKILL to everything, frozen or not."""

    def close(self) -> None:
        """Remove what this freezer has made; all processes in it have ended."""


class CgroupFreezer:
    """A cgroup v2 directory made for one component."""

    kind: Literal["cgroup", "SIGSTOP"] = "cgroup"

    def __init__(self, directory: Path) -> None:
        """Make the cgroup.

        Raises:
            OSError: the place is not delegated to us, or is no cgroup v2 with a freezer.
        """
        directory.mkdir()
        self._directory = directory
        self._exposed: list[int] = []
        try:
            self._write("cgroup.freeze", "0")
        except OSError:
            directory.rmdir()
            raise

    @contextmanager
    def birthplace(self) -> Iterator[None]:
        """Go in, and back out: there is no instant at which a newborn process is outside."""
        home = own_cgroup()
        assert home is not None
        self._write("cgroup.procs", "0")
        try:
            yield
        finally:
            (home / "cgroup.procs").write_text("0", encoding="ascii")

    def add(self, pid: int) -> None:
        """Move the process in; one that was born here is here already."""
        self._write("cgroup.procs", str(pid))

    def freeze(self) -> bool:
        """Freeze, and wait for the kernel's word that it is so."""
        self._write("cgroup.freeze", "1")
        deadline = time.monotonic() + SETTLE_S
        with open(self._directory / "cgroup.events", encoding="ascii") as events:
            changed = select.poll()
            changed.register(events, select.POLLPRI)
            while "frozen 1" not in events.read():
                rest = deadline - time.monotonic()
                if rest <= 0:
                    return False
                changed.poll(rest * 1000)
                events.seek(0)
        return True

    def expose(self) -> None:
        """Let SIGSTOP hold it instead: a thread that its cgroup holds does not come back to a tracer that lets it make a call.

        The signal is pending before the cgroup lets go, so that a thread goes from the one into the other (get_signal() in the
        kernel's signal.c). It also outlives the tracer: a process that was stopped before it was seized stands when it is let go.
        """
        fresh = [pid for pid in self._processes() if _state(pid) not in STANDING]
        for pid in fresh:
            _send(pid, signal.SIGSTOP)
        self._exposed += fresh
        self._write("cgroup.freeze", "0")
        deadline = time.monotonic() + SETTLE_S
        while not {_state(pid) for pid in fresh} <= HELD | {""} and time.monotonic() < deadline:
            time.sleep(SETTLE_STEP_S)

    def thaw(self) -> None:
        """Thaw."""
        self._write("cgroup.freeze", "0")
        while self._exposed:
            _send(self._exposed.pop(), signal.SIGCONT)

    def kill(self) -> None:
        """Kill all at once (Linux 5.14), else one by one."""
        try:
            self._write("cgroup.kill", "1")
        except FileNotFoundError:
            for pid in self._processes():
                _send(pid, signal.SIGKILL)

    def close(self) -> None:
        """Remove the cgroup, and those that the program made in it, once its last process has been reaped."""
        deadline = time.monotonic() + SETTLE_S
        while True:
            try:
                for below, _, _ in os.walk(self._directory, topdown=False):
                    os.rmdir(below)
            except FileNotFoundError:
                return
            except OSError:
                if time.monotonic() > deadline:
                    return  # an unkillable process; the next guard of that name makes another directory
                time.sleep(SETTLE_STEP_S)
            else:
                return

    def _processes(self) -> list[int]:
        return [int(pid) for pid in (self._directory / "cgroup.procs").read_text(encoding="ascii").split()]

    def _write(self, name: str, text: str) -> None:
        with open(self._directory / name, "w", encoding="ascii") as file:
            file.write(text)


class SignalFreezer:
    """SIGSTOP and SIGCONT to a process and its descendants; orphans among them are this process's children (subreaper)."""

    kind: Literal["cgroup", "SIGSTOP"] = "SIGSTOP"

    def __init__(self) -> None:
        self._roots: list[int] = []
        self._pidfds: dict[int, int] = {}
        self._stopped: set[int] = set()

    @contextmanager
    def birthplace(self) -> Iterator[None]:
        """This freezer has no place to be born in: `add` takes each new process."""
        yield

    def add(self, pid: int, pidfd: int = -1) -> None:
        """Remember the process.

        Args:
            pidfd: of one that is not our child: once it has ended, its number may be another process's. Stays the caller's.
        """
        self._roots.append(pid)
        if pidfd >= 0:
            self._pidfds[pid] = pidfd

    def freeze(self) -> bool:
        """Stop all; again until no new one appears and none runs."""
        deadline = time.monotonic() + SETTLE_S
        while True:
            states = {pid: _state(pid) for pid in self._everybody()}
            running = {pid for pid, state in states.items() if state not in STANDING} - self._stopped
            if not running and set(states.values()) <= HELD:
                return True
            for pid in running:
                self._send(pid, signal.SIGSTOP)
            self._stopped |= running
            if time.monotonic() > deadline:
                return False
            time.sleep(SETTLE_STEP_S)

    def expose(self) -> None:
        """It is held by SIGSTOP already."""

    def thaw(self) -> None:
        """Continue those that we stopped; a process that stood before by itself stays as it was."""
        for pid in sorted(self._stopped, reverse=True):
            self._send(pid, signal.SIGCONT)
        self._stopped.clear()

    def kill(self) -> None:
        """Kill all; parents first, so that none starts another."""
        for pid in self._everybody():
            self._send(pid, signal.SIGKILL)

    def close(self) -> None:
        """Nothing was made."""

    def _send(self, pid: int, number: int) -> None:
        if pid not in self._pidfds:
            _send(pid, number)
            return
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfds[pid], number)

    def _everybody(self) -> list[int]:
        """The processes, their orphans and all descendants, parents before children."""
        children = _children()
        found: list[int] = []
        waiting = [*self._roots, *children.get(os.getpid(), [])]
        while waiting:
            pid = waiting.pop(0)
            if pid not in found and _state(pid) != "":
                found.append(pid)
                waiting += children.get(pid, [])
        return found


CGROUP_PREFIX: Final = "failover-"
"""Of the names of our cgroups; the rest is random: PIDs of two namespaces can be equal."""


def own_cgroup() -> Path | None:
    """The cgroup v2 directory that this process is in; None where no such filesystem is mounted."""
    mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    points = [line.split()[4] for line in mounts if " - cgroup2 " in line]
    lines = Path("/proc/self/cgroup").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    paths = [line.removeprefix("0::") for line in lines if line.startswith("0::")]
    return Path(points[0]) / paths[0].lstrip("/") if points and paths else None


def choose(place: str, name: str) -> tuple[Freezer, tuple[str, ...]]:
    """The best freezer that we may have, with a sentence if it is the lesser one.

    Args:
        place: the cgroup v2 directory to make ours in; "" for this process's own.
        name: of our directory there.
    """
    parent = Path(place) if place else own_cgroup()
    if parent is None:
        reason = "no cgroup v2 filesystem is mounted"
    else:
        try:
            return CgroupFreezer(parent / name), ()
        except OSError as error:
            reason = (
                f"cannot make a cgroup in {parent}: {error.strerror}; delegate one to the agent's user (Delegate=yes in a unit)"
            )
    return SignalFreezer(), (f"the guard freezes it by SIGSTOP, which it can notice: {reason}",)


def _children() -> dict[int, list[int]]:
    """Every process's children, by one pass over /proc."""
    table: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            fields = _stat(entry)
            if len(fields) > 1:
                table.setdefault(int(fields[1]), []).append(int(entry))
    return table


def _state(pid: int) -> str:
    """The state letter of a process; "" if it is gone. Of one whose first thread has ended while others live, one of theirs."""
    fields = _stat(str(pid)) or [""]
    if fields[0] == "Z" and int(fields[THREADS]) > 1:
        return _state_of_others(pid)
    return fields[0]


def _state_of_others(pid: int) -> str:
    """The state of a thread that runs, if any does; "Z" once all have ended."""
    found = "Z"
    with suppress(FileNotFoundError, ProcessLookupError):
        for tid in os.listdir(f"/proc/{pid}/task"):
            state = (_stat(f"{pid}/task/{tid}") or ["Z"])[0]
            if state not in HELD:
                return state
            found = state if state not in "ZX" else found
    return found


def _stat(whose: str) -> list[str]:
    """The fields after the name in /proc/PID/stat, or in that of a thread: state, parent …; nothing if it is gone."""
    try:
        with open(f"/proc/{whose}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def _send(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        pass
