"""A program that keeps its state and reports its lives to an independent log: ``python voyage.py LOG [RUNGS]``.

It commits without pause. Everything in its state follows from the steps that led to it, so a state that was put together out of
two commits, or that belongs to a life that was abandoned, gives itself away. Lines of the log, each one write(2):

    r LIFE NUMBER SEAL EPOCH WHY PORTRAIT    it resumed from, or began with, this step; EPOCH 0 where nothing says
    b LIFE NUMBER SEAL                       it begins to commit this step
    c LIFE NUMBER SEAL                       commit() has returned
    a LIFE NUMBER SEAL                       wait_committed() has returned: this step, or a later one, is safe

A LIFE is one process. SEAL is 64 bits that follow from all the steps until then, and from the lives in which they were made.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import xxhash
from numpy.typing import NDArray

import failover

ROWS: Final = 509
"""Of the grid; a prime, so that steps reach all of them."""
STRIDE: Final = 7
TRAIL: Final = 20
CLOUD_EVERY: Final = 8
"""Steps between two that change a whole MB."""
WAIT_S: Final = 1.0
CRATE: Final = 1000
"""Bytes of one item of the cargo."""
GROWTH: Final = 1.25
"""From one rung to the next: the cargo has 1 kB at the first, 11 MB at the forty-second, 53 MB at the forty-ninth."""


@dataclass
class Voyage:
    """Scalars, text of changing length, and 3 MB of arrays, all of one step."""

    number: int = 0
    seal: int = 0
    trail: list[int] = field(default_factory=lambda: [0] * TRAIL)
    note: str = ""
    grid: NDArray[np.uint64] = field(default_factory=lambda: np.zeros((ROWS, 512), np.uint64))
    cloud: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(1 << 17, np.uint64))
    cargo: list[bytes] = field(default_factory=list)

    def sail(self, life: str, rungs: int) -> None:
        """Become the state of the next step.

        Args:
            rungs: after so many steps the cargo, which grows from step to step, begins small again; 0: there is none.
        """
        self.number += 1
        self.seal = seal_after(self.seal, self.number, life)
        self.trail[self.number % TRAIL] = self.seal
        self.note = note_of(self.number, self.seal)
        self.grid[self.number * STRIDE % ROWS] = self.seal
        if self.number % CLOUD_EVERY == 0:
            self.cloud[:] = self.seal
        if rungs:
            count = round(GROWTH ** (self.number % rungs))
            del self.cargo[max(count - 1, 0) :]
            self.cargo += [crate(self.number, place) for place in range(len(self.cargo), count - 1)]
            self.cargo.append(crate(self.seal, count))

    def portrait(self) -> str:
        """A digest of all of it; "torn" where its parts do not even agree among themselves."""
        rows, cloud = self.grid[:, 0], self.cloud[0]
        agrees = (self.grid == rows[:, None]).all() and (self.cloud == cloud).all()
        agrees = agrees and self.trail[self.number % TRAIL] == self.seal and self.note == note_of(self.number, self.seal)
        agrees = agrees and (not self.cargo or self.cargo[-1] == crate(self.seal, len(self.cargo)))
        agrees = agrees and all(len(held) == CRATE for held in self.cargo)
        return portrait_of(rows.tolist(), int(cloud), self.trail) if agrees else "torn"


def seal_after(seal: int, number: int, life: str) -> int:
    """The seal of a step that was made in this life, after the step with that seal."""
    return xxhash.xxh3_64_intdigest(f"{seal} {number} {life}".encode())


def note_of(number: int, seal: int) -> str:
    """A text that grows and shrinks."""
    return f"{seal:x}" * (number % 300) if number else ""


def crate(seal: int, place: int) -> bytes:
    """One item of the cargo."""
    return (b"%d %d " % (seal, place)).ljust(CRATE, b".")


def portrait_of(rows: Sequence[int], cloud: int, trail: Sequence[int]) -> str:
    """The digest of a state's parts."""
    return xxhash.xxh3_64_hexdigest(repr((list(rows), cloud, list(trail))).encode())


def expected(seals: Sequence[int]) -> str:
    """The portrait that a voyage of these seals has; ``seals[n]`` is the one of step n, ``seals[0]`` is 0."""
    last = len(seals) - 1
    rows, trail = [0] * ROWS, [0] * TRAIL
    for number in range(max(1, last - ROWS + 1), last + 1):
        rows[number * STRIDE % ROWS] = seals[number]
        trail[number % TRAIL] = seals[number]
    return portrait_of(rows, seals[last - last % CLOUD_EVERY], trail)


class Log:
    """The test's own file."""

    def __init__(self, path: str, life: str) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        self._life = life
        os.write(self._descriptor, b"\n")  # whoever was killed in the middle of a line has its own

    def write(self, kind: str, *words: object) -> None:
        """One line."""
        os.write(self._descriptor, f"{kind} {self._life} {' '.join(map(str, words))} .\n".encode())


class Waiting:
    """A thread that asks for the newest commit to be safe, again and again."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self.newest = (0, 0)
        self.has_commit = threading.Event()
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        self.has_commit.wait()
        while True:
            number, seal = self.newest
            with contextlib.suppress(failover.NotCommittedError):
                failover.wait_committed(WAIT_S)
                self._log.write("a", number, seal)


def main() -> None:
    """Resume, and sail until killed."""
    life = secrets.token_hex(4)
    log, rungs = Log(sys.argv[1], life), int(sys.argv[2]) if sys.argv[2:] else 0
    voyage = failover.resume("voyage", default=Voyage())
    resumed = failover.resumed()
    origin = (resumed.epoch, resumed.why.replace(" ", "-")) if resumed else (0, "begun")
    log.write("r", voyage.number, voyage.seal, *origin, voyage.portrait())
    waiting = Waiting(log)
    while True:
        voyage.sail(life, rungs)
        print(voyage.number, voyage.seal)
        log.write("b", voyage.number, voyage.seal)
        failover.commit()
        log.write("c", voyage.number, voyage.seal)
        waiting.newest = voyage.number, voyage.seal
        waiting.has_commit.set()


if __name__ == "__main__":
    main()
