"""What a guard says to a program that keeps its state: one packet at its beginning, then one for each commit that is safe.

The program finds the number of its end of the socket in its environment (`VARIABLE`). `Begin` waits there from before its first
instruction, so a program never waits for it. The program says nothing; its segment is found by `cooperative.open_segment`.
"""

from __future__ import annotations

from typing import Final

import msgspec

VARIABLE: Final = "FAILOVER_TASK"
"""Number of the descriptor: a SOCK_SEQPACKET socket with messages of `checkpoint.channel`."""

RESTARTED: Final = "restarted"
TAKEN_OVER: Final = "taken over"


class Origin(msgspec.Struct, frozen=True):
    """Where the state comes from that a program goes on with.

    Attributes:
        robot: where it was committed.
        generation: of the checkpoint that holds it.
        why: `RESTARTED` on the same robot, `TAKEN_OVER` from another.
        age_ns: between the commit and the start of the program.
    """

    robot: str
    generation: int
    why: str
    age_ns: int


class Begin(msgspec.Struct, frozen=True, tag=True):
    """Begin, or go on. With descriptors: the counters of its streams, and its state as a segment if there is an origin.

    Attributes:
        epoch: of the primacy under which it runs: the fencing token.
        pipes: inode numbers of its standard output and error: whoever finds others there has redirected them.
    """

    component: str
    epoch: int
    pipes: tuple[int, int]
    origin: Origin | None = None


class Safe(msgspec.Struct, frozen=True, tag=True):
    """A standby holds everything up to this commit of this segment's lineage."""

    commit: int


Message = Begin | Safe
