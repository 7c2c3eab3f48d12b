"""Restore rings of asynchronous I/O (io_setup(2)) at their addresses, under their numbers, with their unread events.

A ring is memory that the program shares with the kernel; the program knows it by its address. Its pages travel like those of
other shared memory; this module describes how the kernel becomes their owner again. The kernel also keeps the position of the
next event (the ring's tail) for itself, so the restore moves a new ring to this position by requests that do nothing.

The kernel reports nothing about pending requests. Requests through the page cache are done when io_submit(2) returns. The capture
waits for direct ones (O_DIRECT) at the block device. A poll (IOCB_CMD_POLL) is lost.

Source: fs/aio.c: aio_setup_ring(), ioctx_alloc(), aio_ring_mremap(), aio_complete(); io_setup(2), io_submit(2);
Documentation/ABI/stable/sysfs-block, "inflight".
"""

from __future__ import annotations

import os
import stat
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError, RestoreError
from checkpoint.linux.abi import PAGE_SIZE
from checkpoint.linux.procfs.mounts import type_of_mount
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Vma
from checkpoint.resources.open_file import OpenFile
from checkpoint.sentences import AS_SOON_AS

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "rings of asynchronous I/O (io_setup)",
        "at their addresses, with the events that were not read yet; a poll under way (IOCB_CMD_POLL) is lost, because "
        "the kernel does not tell of it",
    ),
    refused(
        Area.PIPES,
        "asynchronous direct I/O (O_DIRECT) that is under way, or on a file system that does not tell what is under way",
        f"wait: {AS_SOON_AS} the I/O is done; use a file system on a block device",
        "opened for direct I/O (O_DIRECT), and its file system does not say",
    ),
    refused(
        Area.THERE,
        "a ring of asynchronous I/O on a machine with many more processors, or with too many of these rings",
        "raise fs.aio-max-nr; let the program ask for more events",
        "rings of asynchronous I/O have",
        "a ring of asynchronous I/O of",
    ),
)

NAME: Final = "/[aio] (deleted)"
NOTE: Final = (
    "it has a ring of asynchronous I/O (io_setup): a poll that is under way by it (IOCB_CMD_POLL) is lost, because "
    "the kernel does not show it: use epoll for that"
)
HEADER: Final = struct.Struct("<8I")
"""struct aio_ring: number, count of events, head, tail, magic, features (2), length of itself."""
EVENT_SIZE: Final = 32
REQUEST: Final = struct.Struct("<QIIHhIQQqQII")
"""struct iocb (linux/aio_abi.h)."""
IOCB_CMD_PREAD: Final = 0
AT_ONCE: Final = 32
"""Requests that are made before their events are read away: a ring takes 127 at least."""
NUMBERS_MAX: Final = 1 << 16
"""Numbers of rings that are given out on the way to those of the program: as many as there may be (fs.aio-max-nr) by default."""
EVENTS_OF_A_PROCESSOR: Final = 8
SPARE_EVENTS: Final = 2
MREMAP_MAYMOVE_FIXED: Final = 1 | 2

COUNTED: Final = "/sys/dev/block/{}:{}/inflight"
"""Where the kernel says how many requests are under way to a block device."""
WAIT_NS: Final = 3_000_000
"""How long a freeze waits for direct I/O to be done: a disk answers in less, mostly."""
SYNCHRONOUS: Final = ("tmpfs", "ramfs", "hugetlbfs")
"""File systems whose direct I/O is done when it is asked for."""


def is_ring(vma: Vma | MapsLine) -> bool:
    """Whether a mapping is one."""
    return vma.name == NAME and vma.shared


# --- Capture -----------------------------------------------------------------------------------------------------------


def await_requests(component: str, opened: Iterable[OpenFile]) -> None:
    """Wait until no direct I/O of the program can be under way. It has a ring, and stands still.

    Raises:
        CaptureError: some may be.
    """
    for place, held in _direct(opened).items():
        deadline_ns = time.monotonic_ns() + WAIT_NS
        while _under_way(place):
            if time.monotonic_ns() > deadline_ns:
                raise CaptureError(
                    f"cannot capture {component}: asynchronous requests to {held.first.target} ({held.name}, O_DIRECT) may be "
                    "under way, for its device is busy; try again"
                )


def refuse(opened: Iterable[OpenFile]) -> Iterator[str]:
    """Why direct I/O of a program with a ring cannot be awaited."""
    for place, held in _direct(opened).items():
        if not place.exists() and type_of_mount(held.pid, held.first.target) not in SYNCHRONOUS:
            yield (
                f"{held.name} is {held.first.target}, opened for direct I/O (O_DIRECT), and its file system does not say whether "
                "its requests are under way: let the program open it without, or use a file system on a block device"
            )


def _direct(opened: Iterable[OpenFile]) -> dict[Path, OpenFile]:
    """Files that are open for direct I/O, one for each device: where the kernel counts its requests."""
    found = {}
    for held in opened:
        one = held.first
        if one.flags & os.O_DIRECT and (stat.S_ISREG(one.mode) or stat.S_ISBLK(one.mode)):
            device = one.rdev if stat.S_ISBLK(one.mode) else one.device
            found[Path(COUNTED.format(os.major(device), os.minor(device)))] = held
    return found


def _under_way(place: Path) -> bool:
    try:
        return any(map(int, place.read_text().split()))
    except FileNotFoundError:
        return False  # one of a file system that `refuse` knows


# --- Restore -----------------------------------------------------------------------------------------------------------


class Ring(Struct, frozen=True):
    """One ring of the program.

    Attributes:
        number: by which the kernel finds it: the place in its table; None of one that a child has inherited, which is of no use.
        tail: how many places from its beginning the next event goes.
    """

    vma: Vma
    number: int | None
    tail: int

    @property
    def places(self) -> int:
        """How many events it has room for."""
        return self.vma.size // EVENT_SIZE - 1

    @property
    def asked(self) -> int:
        """For how many events a ring of the same size is asked for."""
        return (self.places - SPARE_EVENTS) // 2


def rings_of(vmas: Iterable[Vma], content_at: Callable[[int, int], bytes | None]) -> tuple[Ring, ...]:
    """The rings of a program.

    Args:
        content_at: its memory: given address and size.

    Raises:
        RestoreError: a ring says of itself what no kernel does; the program may write there.
    """
    found = []
    for vma in filter(is_ring, vmas):
        header = content_at(vma.start, HEADER.size)
        number, _, _, tail, *_ = HEADER.unpack(header) if header else (None, 0, 0, 0)
        ring = Ring(vma, number, tail)
        if tail >= max(ring.places, 1) or (number or 0) >= NUMBERS_MAX:
            raise RestoreError(
                f"cannot restore: its ring of asynchronous I/O at {vma.start:#x} says that it is number {number}, and at event "
                f"{tail} of {ring.places}, which cannot be: the program has written to it"
            )
        found.append(ring)
    return tuple(found)


def mismatches(vmas: Iterable[Vma]) -> Iterator[str]:
    """Why this machine cannot make them."""
    rings = [Ring(vma, None, 0) for vma in vmas if is_ring(vma)]
    if not rings:
        return
    least = PAGE_SIZE * -(-(SPARE_EVENTS + 1 + EVENTS_OF_A_PROCESSOR * _possible_processors()) * EVENT_SIZE // PAGE_SIZE)
    for ring in rings:
        if ring.vma.size < least:
            yield (
                f"it has a ring of asynchronous I/O of {ring.vma.size >> 10} KiB, and on a machine that may have "
                f"{_possible_processors()} processors none is smaller than {least >> 10} KiB: let the program ask for more events"
            )
    wanted, used, limit = sum(ring.asked for ring in rings), _system("aio-nr"), _system("aio-max-nr")
    if used + wanted > limit:
        yield f"its rings of asynchronous I/O have {wanted} events, and {limit - used} are left here: raise fs.aio-max-nr"


def _possible_processors() -> int:
    """How many processors may ever be there. Source: Documentation/admin-guide/cputopology.rst."""
    ranges = (one.split("-") for one in Path("/sys/devices/system/cpu/possible").read_text().split(","))
    return sum(int(one[-1]) - int(one[0]) + 1 for one in ranges)


def _system(name: str) -> int:
    return int(Path(f"/proc/sys/fs/{name}").read_text())


def slots(rings: Sequence[Ring]) -> list[Ring | None]:
    """The rings as the kernel gives out numbers, the least that is free; None where one is made for its number alone."""
    numbered = {ring.number: ring for ring in rings if ring.number is not None}
    places = [numbered.get(number) for number in range(max(numbered, default=-1) + 1)]
    return [*places, *(ring for ring in rings if ring.number is None)]


def make(table: CallTable, places: Iterable[Ring | None]) -> list[int]:
    """Add the calls that make them: where in memory the kernel will have written the address of each."""
    answers = []
    for ring in places:
        answers.append(table.place(bytes(8)))
        count = ring.asked if ring else 1
        table.call(f"make a ring of asynchronous I/O for {count} events", "io_setup", count, answers[-1])
    return answers


def move(table: CallTable, places: Iterable[Ring | None], addresses: Iterable[int]) -> None:
    """Add the calls that move each where the program knows it, and have the kernel go on at its tail.

    Args:
        addresses: where each is.
    """
    empty = table.obtain("make an empty file", "memfd_create", table.place_path("empty"), 0)
    for ring, address in zip(places, addresses, strict=True):
        if ring is None:
            table.call("remove a ring of asynchronous I/O that only took a number", "io_destroy", address)
            continue
        start, size = ring.vma.start, ring.vma.size
        what = f"move a ring of asynchronous I/O to {start:#x}"
        table.call(what, "mremap", address, size, size, MREMAP_MAYMOVE_FIXED, start, least=start, most=start)
        _drive(table, ring, empty)
    table.close(empty)


def _drive(table: CallTable, ring: Ring, empty: int) -> None:
    """Make as many requests as bring the tail where it was, each of which reads nothing of an empty file."""
    request = table.place(REQUEST.pack(0, 0, 0, IOCB_CMD_PREAD, 0, empty, 0, 0, 0, 0, 0, 0))
    listed, events = table.place(struct.pack("<Q", request) * AT_ONCE), table.place(bytes(EVENT_SIZE * AT_ONCE))
    what, start = f"drive a ring of asynchronous I/O to its event {ring.tail}", ring.vma.start
    for done in range(0, ring.tail, AT_ONCE):
        count = min(AT_ONCE, ring.tail - done)
        table.call(what, "io_submit", start, count, listed, least=count, most=count)
        table.call(what, "io_getevents", start, count, count, events, 0, least=count, most=count)
