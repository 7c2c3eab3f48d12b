"""Starts the processes of a simulation, has them begin together, and adds up what they tell."""

from __future__ import annotations

import contextlib
import os
import resource
import selectors
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

import msgspec
import xxhash
from msgspec import Struct

from failover.core.naming import worlds
from failover.errors import SimulationError
from failover.simulators.lateness import Spans
from failover.simulators.messages import SIZE_SIZE, Spec, Told
from failover.simulators.world.parts import TICK_S, World, groups

ROBOTS_OF_A_PROCESS: Final = 20
READY_S: Final = 60.0
"""A process imports numpy and makes its names: a second, on a busy machine some."""
END_S: Final = 5.0
"""A process ends within a tick; one that hangs is killed, and the next simulation removes what it left."""


class Summary(Struct, frozen=True):
    """What a simulation did, as ``failover simulate --json`` tells it.

    Attributes:
        seconds: of real time, from the first tick on. world_s: of the world's.
        missed: activations of controllers that had not ended 50 ms of the world's time after they were due, or were skipped;
            None without real time.
        late_ms, took_ms: of the activations: from due to begun, from begun to ended; None without real time.
        cores: processor time of all processes over real time. memory_mb: of all of them, at most.
        digest: of all values of all robots' items; the same for the same world, seed and ticks.
    """

    robots: int
    labs: int
    processes: int
    seed: int
    pace: float | None
    seconds: float
    world_s: float
    activations: int
    missed: int | None
    late_ms: dict[str, float] | None
    took_ms: dict[str, float] | None
    cores: float
    memory_mb: float
    digest: str


class Process:
    """One of them."""

    def __init__(self, spec: Spec, environment: dict[str, str]) -> None:
        self.child = subprocess.Popen(
            [sys.executable, "-P", "-m", "failover.simulators"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,  # a signal's function may close it amid a write, which a buffer forbids
            env=environment,
            start_new_session=True,  # Ctrl-C is for the process that begins them
        )
        self.told: Told | None = None
        self._rest = bytearray()
        content = msgspec.json.encode(spec)
        self._write(len(content).to_bytes(SIZE_SIZE, "big") + content)

    def _write(self, content: bytes) -> None:
        assert self.child.stdin is not None
        rest = memoryview(content)
        with contextlib.suppress(OSError, ValueError):  # it has ended, or a signal has had `end` called
            while rest:
                rest = rest[self.child.stdin.write(rest) :]

    def begin(self) -> None:
        """All are ready."""
        self._write(b"\n")

    def end(self) -> None:
        """It is to tell its figures, and end."""
        assert self.child.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.child.stdin.close()

    def read(self) -> bool:
        """Take in what it says; False: it has said all."""
        assert self.child.stdout is not None
        content = os.read(self.child.stdout.fileno(), 1 << 16)
        self._rest += content
        *lines, rest = bytes(self._rest).split(b"\n")
        self._rest = bytearray(rest)
        for line in lines:
            self.told = msgspec.json.decode(line, type=Told)
            if self.told.error:
                raise SimulationError(self.told.error)
        return bool(content)

    def death(self) -> str:
        """Why it says no more, although it should."""
        status = self.child.wait(END_S)
        return f"a process of the simulation ended with exit status {status} and told no figures; the others were ended"

    def kill(self) -> None:
        """Have it gone, however it is."""
        self.end()
        assert self.child.stdout is not None
        self.child.stdout.close()
        try:
            self.child.wait(END_S)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


class Simulation:
    """All processes; a context manager."""

    def __init__(self, world: World, pace: float, seconds: float, place: str = "") -> None:
        """
        Args:
            pace: the world's time over the real one; 0: as fast as it can.
            seconds: of the world; 0: until `stop`.
            place: of the board; "": as `failover.board`.
        """
        self.world, self.pace = world, pace
        parts = groups(world, ROBOTS_OF_A_PROCESS)
        ticks = max(round(seconds / TICK_S), 1) if seconds else 0
        self._specs = [Spec(world.part(labs), number, len(parts), pace, ticks, place) for number, labs in enumerate(parts, 1)]
        self._processes: list[Process] = []
        self._is_over = False
        self._began_s = self._used_s = 0.0

    def __enter__(self) -> Simulation:
        environment = {name: value for name, value in os.environ.items() if name != worlds.VARIABLE}
        environment |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")  # small arrays: a thread is enough
        try:
            for spec in self._specs:
                self._processes.append(Process(spec, environment))
            self._read(lambda process: process.told is not None, READY_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()

    def _read(self, is_enough: Any, limit_s: float | None) -> None:
        """Take in what the processes say until each has said enough, or has ended.

        Raises:
            SimulationError: one cannot go on, or says nothing in time.
        """
        until_s = time.monotonic() + limit_s if limit_s is not None else None
        with selectors.DefaultSelector() as selector:
            for process in self._processes:
                if not is_enough(process):
                    assert process.child.stdout is not None
                    selector.register(process.child.stdout, selectors.EVENT_READ, process)
            while selector.get_map():
                left_s = None if until_s is None else until_s - time.monotonic()
                if left_s is not None and left_s <= 0:
                    raise SimulationError(f"{len(selector.get_map())} processes of the simulation said nothing for {limit_s:g} s")
                for key, _ in selector.select(left_s):
                    is_open = key.data.read()
                    if is_enough(key.data):
                        selector.unregister(key.fileobj)
                    elif not is_open:
                        raise SimulationError(key.data.death())

    def run(self) -> Summary:
        """Begin, and wait for the end.

        Raises:
            SimulationError: a process could not go on.
        """
        self._began_s = time.monotonic()
        used_s = time.process_time()
        for process in self._processes:
            process.begin()
        if self._is_over:
            self.stop()
        self._read(lambda process: process.told is not None and not process.told.ready, None)
        told = [process.told for process in self._processes if process.told is not None]
        return self._summary(told, time.process_time() - used_s)

    def stop(self) -> None:
        """End `run`: each process tells its figures. For a signal's function."""
        self._is_over = True
        for process in self._processes:
            process.end()

    def _summary(self, told: Sequence[Told], own_cpu_s: float) -> Summary:
        late, took = Spans(), Spans()
        for one in told:
            late.add(Spans(*one.late))
            took.add(Spans(*one.took))
        digests = sorted((lab, digest) for one in told for lab, digest in one.digests.items())
        seconds = max(one.seconds for one in told)
        memory = sum(one.memory for one in told) + (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10)
        return Summary(
            robots=len(self.world.robots),
            labs=len(self.world.labs),
            processes=len(told),
            seed=self.world.seed,
            pace=self.pace or None,
            seconds=round(seconds, 2),
            world_s=round(max(one.ticks for one in told) * TICK_S, 2),
            activations=sum(one.activations for one in told),
            missed=sum(one.missed for one in told) if self.pace else None,
            late_ms=late.told() if self.pace else None,
            took_ms=took.told() if self.pace else None,
            cores=round((sum(one.cpu_s for one in told) + own_cpu_s) / max(seconds, 1e-3), 3),
            memory_mb=round(memory / 1e6, 1),
            digest=xxhash.xxh3_64_hexdigest(msgspec.json.encode(digests)),
        )
