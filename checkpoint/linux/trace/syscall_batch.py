"""A batch: the system calls that one thread is to make at once, and the table in which their answers lie.

A desk has a table of its own, whose parts `Plan` places: a head (state, mask, registers to give back), the result of each call,
what the calls write, and at the end room for the code and a note. The order of events: `checkpoint.linux.trace.remote_syscalls`.
"""

from __future__ import annotations

import functools
import struct
from typing import Final

from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Call, TablePlaces
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.trace.tracee import LOST_SIZE

LARGE_DESK: Final = max(arch.LARGE_DESK_SIZE, 4 * abi.PAGE_SIZE)
"""Bytes of the large desk's code, and of its table."""
DESK_COUNT: Final = 32
FRAME_SIZE: Final = arch.frame_size(LOST_SIZE)
"""Bytes at the end of a desk's table that are the code's own."""
_SHARE_OF_A_PAGE: Final = abi.PAGE_SIZE // DESK_COUNT
SMALL_DESK: Final = -(-(arch.SMALL_DESK_SIZE + FRAME_SIZE) // _SHARE_OF_A_PAGE) * _SHARE_OF_A_PAGE
"""Bytes of a small desk's code, and of its table: room for four short calls. All of them are whole pages."""
CODE_SIZE: Final = LARGE_DESK + DESK_COUNT * SMALL_DESK
TABLE_SIZE: Final = CODE_SIZE
SIZE: Final = CODE_SIZE + TABLE_SIZE
MAGIC: Final = b"failover borrows these pages; 2\0"
"""Stands at the end of the code pages, and at the beginning of the table."""
CALL_LIMIT: Final = 200
"""Calls in one batch; ``LARGE_DESK`` holds 220 of the longest."""

IDLE: Final = 0
ARMED: Final = 1
ENDED: Final = 2
ABANDONED: Final = 3

HEAD: Final = struct.Struct(f"<32s8Q{len(arch.CLOBBERED)}Q")
"""Magic, state, done, serial, mask, timeout (2 words), empty set, resume, registers."""
HEAD_SIZE: Final = HEAD.size
_OUTPUT_ALIGNMENT: Final = 16
STATE_OFFSET: Final = 32
IDLE_WORD: Final = struct.pack("<Q", IDLE)
NOTE: Final = struct.Struct("<Ii")
"""At the end of the large desk's table: a descriptor and one more (0: there is no note), and a number."""


class Plan(Struct, frozen=True, dict=True):
    """Where the parts of a desk's table begin: head, then results, then what the calls write.

    Attributes:
        size: of the table; its code has as much room.
        call_limit: calls in one batch.
    """

    size: int
    call_limit: int

    @functools.cached_property
    def results(self) -> int:
        """Offset of the results."""
        return -(-HEAD_SIZE // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT

    @functools.cached_property
    def room(self) -> int:
        """Offset of where the outputs end at the latest: the code's own room, and the note, come after."""
        return (self.size - NOTE.size) // _OUTPUT_ALIGNMENT * _OUTPUT_ALIGNMENT - FRAME_SIZE

    @functools.cached_property
    def outputs(self) -> int:
        """Offset of the outputs, which end before the note."""
        return self.results + -(-8 * self.call_limit // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT


LARGE: Final = Plan(LARGE_DESK, CALL_LIMIT)
SMALL: Final = Plan(SMALL_DESK, 4)


def places_in(table: int, plan: Plan) -> TablePlaces:
    words = table + STATE_OFFSET
    return TablePlaces(
        state=words,
        ended=ENDED,
        done=words + 8,
        serial=words + 16,
        mask=words + 24,
        timeout=words + 32,
        empty_set=words + 48,
        resume=words + 56,
        registers=words + 64,
        results=table + plan.results,
        frame=table + plan.room,
    )


class Batch:
    """System calls put in order for one run; each answers with its place in the results.

    Args:
        table: address of the table of the desk at which they will be made: outputs of the calls go there.
    """

    def __init__(self, table: int, plan: Plan = LARGE) -> None:
        self._table = table
        self._plan = plan
        self.calls: list[Call] = []
        self.output_size = 0

    @property
    def end(self) -> int:
        """Offset in the table after the last output."""
        return self._plan.outputs + self.output_size

    def output(self, size: int) -> int:
        """Reserve room for what a call writes; answers with its address in the tracee."""
        address = self._table + self._plan.outputs + self.output_size
        self.output_size += -(-size // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT
        if self.end > self._plan.room:
            raise CaptureError(f"too much to ask of a process at once: {self.output_size} bytes of answers")
        return address

    def add(self, name: str, *arguments: int) -> int:
        """Add a call."""
        if len(self.calls) >= self._plan.call_limit:
            raise CaptureError(f"too much to ask of a process at once: more than {self._plan.call_limit} system calls")
        self.calls.append(Call(name, arguments))
        return len(self.calls) - 1


class Answers:
    """The results of a batch: a desk's table, read when an answer is asked for.

    Args:
        address: of the table.
        count: of the calls.
    """

    __slots__ = ("_address", "_count", "_plan", "_table")

    def __init__(self, table: bytes, address: int, plan: Plan, count: int) -> None:
        self._table = table
        self._address = address
        self._plan = plan
        self._count = count

    @property
    def results(self) -> tuple[int, ...]:
        """The result of each call, signed: negative is an errno."""
        return struct.unpack_from(f"<{self._count}q", self._table, self._plan.results)

    def at(self, address: int, size: int) -> bytes:
        """The bytes that a call wrote at an address that `Batch.output` gave."""
        offset = address - self._address
        return self._table[offset : offset + size]
