"""Restore pipes whose two ends both belong to the process, with their content.

Programs wake themselves by such a pipe from a signal handler (xz does). A pipe with an end in another process is refused until
that process can move as well.

Facts: ``descriptors``; ``pipe``, a number that both ends have in common; ``end``, 0 to read, 1 to write; ``flags`` of fcntl(2);
``capacity`` in bytes; ``content``: the bytes in it, with the reading end, b"" with the writing one; ``packets``: the length of
each packet of the content, where there are several (O_DIRECT).

Sources: pipe(7), tee(2), fcntl(2) F_SETPIPE_SZ.
"""

from __future__ import annotations

import array
import ctypes
import errno
import fcntl
import os
import select
import stat
import termios
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec.structs import replace

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, RESULT_TO, OwnCalls, row
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of

KIND: Final = "pipes"

CAPABILITIES: Final = (
    preserved(Area.PIPES, "pipes that only the program has", "with the data in them"),
    refused(
        Area.PIPES,
        "a pipe to another process",
        "redirect it to a file, or start the programs so that one component holds both ends",
        "to another process: only pipes of which",
        "that another process holds too",
    ),
)

F_SETPIPE_SZ: Final = 1031
F_GETPIPE_SZ: Final = 1032
SPLICE_F_NONBLOCK: Final = 2
DEFAULT_CAPACITY: Final = 65536

_libc = ctypes.CDLL(None, use_errno=True)
_libc.tee.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_size_t, ctypes.c_uint)
_libc.tee.restype = ctypes.c_ssize_t


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """One end of a pipe, if an open file is one."""
    if not is_pipe(held.first):
        return None
    facts: dict[str, Fact] = {
        "descriptors": held.numbers,
        "pipe": held.first.inode,
        "end": int(writes(held.first)),
        "flags": held.first.flags & ~os.O_CLOEXEC,
        "capacity": held.capacity,
        "content": held.content or b"",
    }
    packets = held.observed.get("packets")
    if isinstance(packets, list) and len(packets) > 1:
        facts["packets"] = packets
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a pipe cannot be kept."""
    if not is_pipe(held.first):
        return None
    what = f"{held.name} is a pipe"
    if not held.both_ends:
        return f"{what} to another process: only pipes of which the program holds both ends are kept; redirect it to a file"
    if other_holders.has_end(held):
        return f"{what} that another process holds too: protect the program when that has ended"
    return None


def is_pipe(one: Descriptor) -> bool:
    """Whether a descriptor is an end of a pipe without a name."""
    return stat.S_ISFIFO(one.mode) and one.target.startswith("pipe:")


def writes(one: Descriptor) -> bool:
    """Whether it is the writing end."""
    return one.flags & os.O_ACCMODE == os.O_WRONLY


def is_half(held: OpenFile) -> bool:
    """Whether no process has the other end of a pipe any more.

    Source: pipe(7): POLLHUP for a reader without writers, POLLERR for a writer without readers.
    """
    try:
        with copy_of(held.pid, held.first.number) as pipe:
            asked = select.poll()
            asked.register(pipe, 0)
            return bool(asked.poll(0))
    except OSError:
        return False  # closed meanwhile


def look_into(held: OpenFile) -> tuple[int, list[bytes]]:
    """A pipe's capacity and, for the reading end, its content, by packets; it stays there. The process stands still.

    Raises:
        CaptureError: it cannot be looked into.
    """
    reads = not writes(held.first)
    try:
        with copy_of(held.pid, held.first.number) as pipe:
            capacity = fcntl.fcntl(pipe, F_GETPIPE_SZ)
            return capacity, packets_in(pipe, capacity) if reads else []
    except OSError as error:
        raise CaptureError(
            f"cannot look into the pipe {held.name} of pid {held.pid}: {error.strerror}; capture it again"
        ) from error


def with_content(held: OpenFile, capacity: int, pieces: Sequence[bytes]) -> OpenFile:
    """The same, with what was seen of it."""
    packets: list[Fact] = [len(piece) for piece in pieces]
    return replace(held, both_ends=True, capacity=capacity, content=b"".join(pieces), observed={"packets": packets})


def capacities_of_empty(ends: Sequence[int]) -> list[int]:
    """The capacity of each pipe in which nothing waits, by an end of it that we have; 0 of another one, and of what is none."""
    waiting, capacities = np.full(len(ends), -1, dtype=np.int32), np.zeros(len(ends), dtype=np.int64)
    table = OwnCalls(2 * len(ends))
    table.entries[: len(ends)] = row("ioctl", 0, termios.FIONREAD)
    table.entries[: len(ends), FIRST_ARGUMENT + 2] = waiting.ctypes.data + 4 * np.arange(len(ends))
    table.entries[len(ends) :] = row("fcntl", 0, F_GETPIPE_SZ)
    table.entries[len(ends) :, RESULT_TO] = capacities.ctypes.data + 8 * np.arange(len(ends))
    table.entries[:, FIRST_ARGUMENT] = np.tile(np.array(ends, dtype=np.int64), 2).view(np.uint64)
    table.run()
    found: list[int] = np.where((waiting == 0) & (capacities > 0), capacities, 0).tolist()
    return found


def packets_in(pipe: int, capacity: int) -> list[bytes]:
    """The content of a pipe, by its reading end: each packet for itself, bytes without packets as one piece. It stays there.

    Raises:
        OSError: another process reads it meanwhile.
    """
    waiting = array.array("i", [0])
    fcntl.ioctl(pipe, termios.FIONREAD, waiting)
    if not waiting[0]:
        return []
    pieces = _teed(pipe, waiting[0], capacity)
    if sum(map(len, pieces)) != waiting[0]:
        raise BlockingIOError(errno.EAGAIN, "another process reads it meanwhile")
    return pieces


def copy_of_content(pipe: int, capacity: int) -> bytes:
    """The same of a pipe without packets.

    Raises:
        OSError: another process reads it meanwhile, or there are packets.
    """
    pieces = packets_in(pipe, capacity)
    if len(pieces) > 1:
        raise OSError(errno.EOPNOTSUPP, "it holds several packets (O_DIRECT)")
    return b"".join(pieces)


def peek(pipe: int) -> bytes:
    """The bytes that wait in a pipe, by its reading end; they stay there. b"" where we cannot look into it, as in a terminal."""
    try:
        capacity = fcntl.fcntl(pipe, F_GETPIPE_SZ)
        return b"".join(_teed(pipe, capacity, capacity))
    except OSError:
        return b""


def _teed(pipe: int, size: int, capacity: int) -> list[bytes]:
    """A copy of the first bytes of a pipe, as far as there are any; each packet for itself.

    Raises:
        OSError: it is no pipe, or there is none to copy into.
    """
    reader, writer = os.pipe()
    try:
        fcntl.fcntl(writer, F_SETPIPE_SZ, capacity)
        copied = _libc.tee(pipe, writer, size, SPLICE_F_NONBLOCK)
        if copied < 0 and ctypes.get_errno() != errno.EAGAIN:
            abi.raise_errno("tee of a pipe")
        pieces: list[bytes] = []
        while copied > 0:
            pieces.append(os.read(reader, copied))
            copied -= len(pieces[-1])
        return pieces
    finally:
        os.close(reader)
        os.close(writer)


def rebuild(table: CallTable, ends: Sequence[Resource], first: int) -> dict[int, int]:
    """Make the pipes, filled once each, at numbers from ``first`` on: the descriptor of each open file, by its resource's id().

    An end that was opened again, through /proc/self/fd, is an open file of its own, with flags of its own.

    Args:
        ends: every resource of this kind.
    """
    made: dict[int, int] = {}
    for pipe in dict.fromkeys(number_of(held.facts["pipe"]) for held in ends):
        opened = [held for held in ends if number_of(held.facts["pipe"]) == pipe]
        pair = table.obtain_pair("make a pipe", "pipe2", table.place(bytes(8)), os.O_CLOEXEC)
        _fill(table, opened, pair)
        for held in opened:
            made[id(held)] = _opened(table, held, pair, opened, first + len(made))
        for descriptor in pair:
            table.close(descriptor)
    return made


def _fill(table: CallTable, opened: Sequence[Resource], pair: tuple[int, int]) -> None:
    """Give a pipe its size and its content: every open file that reads has told the same."""
    name, capacity = opened[0].name, number_of(opened[0].facts["capacity"])
    if capacity != DEFAULT_CAPACITY:
        table.call(f"size the pipe of {name}", "fcntl", pair[0], F_SETPIPE_SZ, capacity, least=capacity)
    content = next((one.facts["content"] for one in opened if one.facts["content"]), b"")
    assert isinstance(content, bytes)
    packets = next((one.facts["packets"] for one in opened if "packets" in one.facts), [len(content)] if content else [])
    assert isinstance(packets, list)
    if any(number_of(one.facts["flags"]) & os.O_DIRECT for one in opened) or len(packets) > 1:
        table.call(f"have the pipe of {name} keep packets", "fcntl", pair[1], fcntl.F_SETFL, os.O_DIRECT)
    begin = 0
    for size in map(number_of, packets):
        place = table.place(content[begin : begin + size])
        table.call(f"fill the pipe of {name}", "write", pair[1], place, size, least=size)
        begin += size
    table.call(f"set the flags of the pipe of {name}", "fcntl", pair[1], fcntl.F_SETFL, 0)


def _opened(table: CallTable, held: Resource, pair: tuple[int, int], opened: Sequence[Resource], place: int) -> int:
    """One open file of a pipe, at a number of its own: the end as it was made, or opened again where that one is given away."""
    end, flags = number_of(held.facts["end"]), number_of(held.facts["flags"])
    plain = (os.O_RDONLY, os.O_WRONLY)[end]
    if held is next((one for one in opened if number_of(one.facts["flags"]) & os.O_ACCMODE == plain), None):
        table.duplicate(pair[end], place, os.O_CLOEXEC)
    else:
        again = table.open(f"/proc/self/fd/{pair[end]}", flags & os.O_ACCMODE)
        table.duplicate(again, place, os.O_CLOEXEC)
        table.close(again)
    if status := flags & (os.O_NONBLOCK | os.O_DIRECT):
        table.call(f"set the flags of {held.name}", "fcntl", place, fcntl.F_SETFL, status)
    return place
