"""What the process that begins a simulation, and those that run it, say to one another: JSON over standard input and output."""

from __future__ import annotations

from typing import Final

from msgspec import Struct

from failover.simulators.world.parts import World

SIZE_SIZE: Final = 4
"""Bytes of the size before a `Spec`. What follows it: a byte when all are ready; the end of the stream is the sign to end."""


class Spec(Struct, frozen=True):
    """What one process is to do.

    Attributes:
        number: of this process, from 1; ``of``: so many.
        pace: the world's time over the real one; 0: as fast as it can.
        ticks: when to end; 0: never.
    """

    world: World
    number: int
    of: int
    pace: float = 1.0
    ticks: int = 0
    place: str = ""


class Told(Struct, frozen=True):
    """What one process says, a line of JSON each time: first with ``ready``, last with its figures, or with why it ended.

    Attributes:
        activations: of controllers. missed: those that had not ended by their deadline, or were skipped.
        late, took: `Spans`: counts and the longest.
        cpu_s: processor time since the first tick. memory: bytes, at most.
        digests: lab → digest of all values of its robots.
    """

    ready: bool = False
    error: str = ""
    activations: int = 0
    missed: int = 0
    ticks: int = 0
    seconds: float = 0.0
    late: tuple[list[int], int] = ([], 0)
    took: tuple[list[int], int] = ([], 0)
    cpu_s: float = 0.0
    memory: int = 0
    digests: dict[str, str] = {}
