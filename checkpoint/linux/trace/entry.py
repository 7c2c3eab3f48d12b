"""Enter a stopped tracee for the first time: place our borrowed pages, and deal with those of an earlier tracer.

The first entry has no page yet. A stub of constants at the end of the vdso's last page (writing there makes the page private to
the process) maps the pages and opens a userfaultfd, and keeps both results in registers. The entry puts the earlier content back
afterwards: zeros, or, where these are too few, also the names and headers of the image's sections, which no program reads.

Source: vdso(7), userfaultfd(2), pidfd_getfd(2).
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
import time
from collections.abc import Callable, Sequence
from typing import Final

from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Call, EntryCalls
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import descriptors_to
from checkpoint.linux.procfs.live_thread import pidfd_of
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.spawn import vdso
from checkpoint.linux.trace.remote_syscalls import BATCH_TIMEOUT_S, BorrowedPages
from checkpoint.linux.trace.syscall_batch import ABANDONED, CODE_SIZE, MAGIC, SIZE, TABLE_SIZE, Batch
from checkpoint.linux.trace.syscall_desk import STOPPED_TIMEOUT, Guest, give_back, patience_ns, resumed
from checkpoint.linux.trace.tracee import Tracee, rest

FAULTS_FLAGS: Final = abi.O_CLOEXEC | abi.O_NONBLOCK
"""With which the userfaultfd is opened inside."""
FAULTS_TARGET: Final = "anon_inode:[userfaultfd]"
"""Where /proc/PID/fd says that it leads."""


class Entered(Struct, frozen=True):
    """The result of the first entry.

    Attributes:
        faults: a userfaultfd of the tracee's memory, ours now; None where it was refused, there or to us.
        inside: its number in the tracee, where it must still be closed; -1 if none.
        why_not: the errno of a refusal.
    """

    pages: BorrowedPages
    faults: int | None
    inside: int
    why_not: int = 0


def reenter(tracee: Tracee, pages: BorrowedPages, registers: bytes, mask: int) -> Entered:
    """Use pages again that an earlier tracer left; otherwise as `enter`."""
    batch = Batch(pages.table)
    index = batch.add("userfaultfd", FAULTS_FLAGS | abi.UFFD_USER_MODE_ONLY)
    inside = pages.run(tracee, batch, registers, mask).results[index]
    if inside < 0:
        return Entered(pages, None, -1, -inside)
    faults, why_not = _taken(tracee.pid, inside)
    return Entered(pages, faults, inside, why_not)


def enter(tracee: Tracee, maps: Sequence[MapsLine], registers: bytes, mask: int) -> Entered:
    """Borrow pages in a stopped tracee that has none of ours; it stands as before afterwards.

    The userfaultfd is still open inside; the next batch closes `Entered.inside`.

    Raises:
        ProcessGoneError: it was killed meanwhile.
        CaptureError: no place for the stub, or its memory limit leaves no room.
    """
    hole = largest_hole(maps)
    rooms = vdso_rooms(tracee.memory, maps)
    guest = Guest(tracee, registers, mask, tracee.lost_in_calls())
    place, stub = _stub(guest, rooms, hole)
    had = tracee.memory.read(place, max(0, rooms[0].start - place)).ljust(len(stub), b"\0")
    tracee.memory.poke(place, stub)
    there = arch.decode_registers(registers)
    there[arch.INSTRUCTION_POINTER] = place + arch.ENTRY_CODE_OFFSET
    there[arch.CALL_NUMBER] = arch.NO_CALL
    for index, bit in arch.STEPPING:
        there[arch.REGISTER_NAMES[index]] &= ~bit
    tracee.set_registers(arch.encode_registers(there))
    tracee.set_signal_mask(abi.ALL_SIGNALS)
    tracee.cont()
    try:
        _wait_in_call(tracee, "rt_sigtimedwait", lambda: tracee.memory.poke(place, STOPPED_TIMEOUT))  # a stub begins with that
    finally:
        found = give_back(guest, range(place, place + len(stub)).__contains__)
    code, table, inside = (ctypes.c_int64(found[name]).value for name in arch.ENTRY_REGISTERS)
    tracee.memory.poke(place, had)
    if code != hole or table != hole + CODE_SIZE:
        raise CaptureError(
            f"cannot borrow pages in pid {tracee.pid}: {os.strerror(-min(code, table, 0))}; raise its limit of address space"
        )
    pages = BorrowedPages(tracee.memory, hole)
    tracee.memory.poke(pages.table - len(MAGIC), MAGIC)
    faults, why_not = _taken(tracee.pid, inside) if inside >= 0 else (None, -inside)
    return Entered(pages, faults, inside, why_not)


def _stub(guest: Guest, rooms: Sequence[range], hole: int) -> tuple[int, bytes]:
    """Where there is room for what the thread will run, and that.

    Scalable vectors may be too long to lie there. Only a keeper that dies in this very entry would owe them to the program: it
    loses what calls take from them then.

    Raises:
        CaptureError: there is none.
    """
    tracee, registers, mask, lost = guest
    calls, patience = _entry_calls(hole), patience_ns(tracee)
    goes_on, vectors = resumed(arch.decode_registers(tracee.left_alone or registers)), tracee.xstate()
    for with_lost, room in itertools.product((lost, b"") if lost else (b"",), rooms):
        stub = arch.entry_code(room.start, calls, goes_on, mask, patience, vectors, with_lost)
        if len(stub) <= len(room):
            return room.start, stub
    raise CaptureError(
        f"cannot enter pid {tracee.pid}: its vdso has only {len(rooms[-1])} spare bytes of {len(stub)}; upgrade the kernel"
    )


def _entry_calls(hole: int) -> EntryCalls:
    fixed = abi.MAP_PRIVATE | abi.MAP_ANONYMOUS | abi.MAP_FIXED_NOREPLACE
    read_execute, read_write = abi.PROT_READ | abi.PROT_EXEC, abi.PROT_READ | abi.PROT_WRITE
    return EntryCalls(
        code_pages=Call("mmap", (hole, CODE_SIZE, read_execute, fixed, -1, 0)),
        table_pages=Call("mmap", (hole + CODE_SIZE, TABLE_SIZE, read_write, fixed, -1, 0)),
        advice=Call("madvise", (hole, SIZE, abi.MADV_DONTFORK)),
        faults=Call("userfaultfd", (FAULTS_FLAGS | abi.UFFD_USER_MODE_ONLY,)),
    )


def _wait_in_call(tracee: Tracee, name: str, lengthen: Callable[[], None]) -> None:
    """Wait until the thread waits in this system call, also where a SIGSTOP comes first (`Tracee.run_on`).

    Source: proc_pid_syscall(5): the number is the first word.
    """
    pid, began = tracee.pid, time.perf_counter()
    wanted = str(arch.SYSCALLS[name])

    def is_there() -> bool:
        return procfs.read_text(pid, "syscall").partition(" ")[0] == wanted

    while not is_there():
        waited = time.perf_counter() - began
        if waited > BATCH_TIMEOUT_S:
            raise CaptureError(
                f"pid {pid} did not run for {BATCH_TIMEOUT_S:g} s while failover examined it: it is frozen by its cgroup, or "
                "higher priorities leave it no processor; protect it again when it runs"
            )
        tracee.run_on(is_there, lengthen)
        rest(waited)


def _taken(pid: int, inside: int) -> tuple[int | None, int]:
    """A userfaultfd out of the tracee; or None and the errno, where we have no descriptor left, for one."""
    try:
        pidfd = pidfd_of(pid)
        try:
            return abi.pidfd_getfd(pidfd, inside), 0
        finally:
            os.close(pidfd)
    except OSError as error:
        return None, error.errno or errno.EIO


USER_START: Final = 1 << 20
"""Below lie vm.mmap_min_addr and what old programs expect to be free."""


def largest_hole(maps: Sequence[MapsLine]) -> int:
    """An address in the middle of the largest unmapped stretch, where neither heap nor stack nor new mappings come soon.

    Raises:
        CaptureError: there is no room.
    """
    user_end = arch.user_end(max(line.end for line in maps))
    ends = [USER_START, *(line.end for line in maps if line.end < user_end)]
    starts = [*(line.start for line in maps if USER_START <= line.start < user_end), user_end]
    size, begin = max((start - end, end) for end, start in zip(sorted(ends), sorted(starts), strict=False))
    if size < 3 * SIZE:
        raise CaptureError("cannot borrow pages: the address space has no hole left")
    return (begin + size // 2) & -abi.PAGE_SIZE


_SPARE_ALIGNMENT: Final = 64


def vdso_rooms(memory: Memory, maps: Sequence[MapsLine]) -> tuple[range, range]:
    """Addresses at the end of the vdso where code of ours may lie: zeros behind the image; and with what of it no program reads.

    Raises:
        CaptureError: the process has no vdso.
    """
    line, used, whole = _vdso_ends(memory, maps)
    return range(whole, line.end), range(used, line.end)


def _vdso_ends(memory: Memory, maps: Sequence[MapsLine]) -> tuple[MapsLine, int, int]:
    """The mapping, and the addresses of `vdso.ends`, rounded up.

    Raises:
        CaptureError: the process has no vdso.
    """
    for line in maps:
        if line.name == "[vdso]":
            ends = vdso.ends(memory.read(line.start, min(line.size, abi.PAGE_SIZE)))
            used, whole = (line.start + -(-end // _SPARE_ALIGNMENT) * _SPARE_ALIGNMENT for end in ends)
            return line, used, whole
    raise CaptureError(f"cannot enter pid {memory.pid}: it has no vdso (the kernel was started with vdso=0, or it unmapped it)")


# What an earlier tracer left


def leftovers(memory: Memory, maps: Sequence[MapsLine]) -> list[BorrowedPages]:
    """Pages that earlier tracers borrowed and could not give back; those that were left to the program do not count."""
    found = []
    for code, table in itertools.pairwise(maps):
        alike = code.end == table.start and code.inode == table.inode == 0 and not (code.shared or table.shared)
        if not (alike and code.size == CODE_SIZE and code.protection == abi.PROT_READ | abi.PROT_EXEC):
            continue
        if table.size < TABLE_SIZE or memory.read(code.end - len(MAGIC), len(MAGIC)) != MAGIC:
            continue
        pages = BorrowedPages(memory, code.start)
        if pages.state() != ABANDONED:
            found.append(pages)
    return found


def left_open(pid: int) -> tuple[int, ...]:
    """Userfaultfds that earlier tracers opened inside and could not close: the program was frozen by its cgroup in between."""
    return tuple(found.number for found in descriptors_to(pid, FAULTS_TARGET) if is_left_open(found))


def is_left_open(found: Descriptor) -> bool:
    """Whether a descriptor is one of `left_open`: it was never set up (UFFDIO_API), which a program of its own does at once.

    Source: userfaultfd_show_fdinfo() in fs/userfaultfd.c: "API: aa:0:…" before the features are agreed on.
    """
    alike = found.target == FAULTS_TARGET and found.flags & ~os.O_RDWR == FAULTS_FLAGS
    return alike and found.fields.get("API", "").split(":")[1:2] == ["0"]


def is_in_stub(instruction_pointer: int, memory: Memory, maps: Sequence[MapsLine]) -> bool:
    """Whether a thread stands in the stub of an earlier tracer's first entry: it leaves it by itself."""
    return any(line.name == "[vdso]" and line.start <= instruction_pointer < line.end for line in maps) and (
        instruction_pointer >= _vdso_ends(memory, maps)[1]
    )
