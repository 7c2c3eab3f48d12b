"""Types that all processor files share: registers by name, calls to make inside a tracee, calls that a stop ends."""

from __future__ import annotations

from typing import Final

from msgspec import Struct

Registers = dict[str, int]
"""General registers by name, unsigned."""

MILLISECONDS: Final = "ms"
TIMESPEC: Final = "timespec"
SOCKET: Final = "socket"


class Timeout(Struct, frozen=True):
    """How long a call waits.

    Attributes:
        argument: index of the argument that tells; of a `SOCKET`, of its descriptor.
        form: `MILLISECONDS` (an int, negative for ever), `TIMESPEC` (address of one, 0 for ever), or `SOCKET`.
        at_end: what the call returns when that time is over.
        option: of a `SOCKET`: SO_RCVTIMEO or SO_SNDTIMEO.
    """

    argument: int
    form: str
    at_end: int
    option: int = 0


class Call(Struct, frozen=True):
    """One system call to be made inside the tracee; its result goes to the next word of the table's results."""

    name: str
    arguments: tuple[int, ...] = ()


class Unkept(Struct, frozen=True):
    """A question to a process about something that no restore can give it.

    Attributes:
        usual: the answer of a process without it; where the kernel does not know the call, the answer is an error.
        what: names the thing that a process with another answer has.
    """

    call: Call
    usual: int
    what: str


class TablePlaces(Struct, frozen=True):
    """Addresses inside the borrowed table that the code reads and writes.

    Attributes:
        frame: of `frame_size` bytes, as many as the processor's code needs for itself.
    """

    state: int
    ended: int
    done: int
    serial: int
    mask: int
    timeout: int
    empty_set: int
    resume: int
    registers: int
    results: int
    frame: int


class EntryCalls(Struct, frozen=True):
    """The calls of the first entry, in this order: map the code pages, map the table pages, advise, open a userfaultfd."""

    code_pages: Call
    table_pages: Call
    advice: Call
    faults: Call
