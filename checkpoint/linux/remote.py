"""System calls made inside a stopped tracee, by one batch of straight-line code in a few pages that we borrow there.

The pages: ``CODE_SIZE`` bytes r-x, then ``TABLE_SIZE`` bytes rw-. They lie in the middle of the largest hole, are never
given to a child (MADV_DONTFORK), belong to no snapshot, and stay between captures.

A batch, and why a SIGKILL of the tracer at any instant leaves the program unharmed (each step is a test):

1. The thread stands; its registers and mask are known. Code and table are written: registers to give back, mask, state ARMED.
   *Killed here:* nothing leads to the code.
2. Registers: the instruction pointer leads to the code, and no system call is pending. *Killed here:* the batch runs, gives
   the mask and registers back by itself, and jumps to where the program stood.
3. Mask: every signal blocked, so that no handler runs with its return address in a page that a snapshot does not hold.
   *Killed here:* as before; the batch's last call sets the program's mask.
4. The thread runs the batch, says done and waits (rt_sigtimedwait of no signal, 100 ms at most; it leaves a restart block alone).
5. The tracer stops it there: mask back, then registers back, as they were at the first stop, orig_rax and all, so that the
   kernel itself restarts or ends the interrupted call as signals then demand. *Killed between or before:* the wait ends and
   the batch goes on as in 2. A signal that comes just then may run its handler on top of the batch; such pages are marked
   ARMED, and a later tracer leaves them to the program as ordinary memory.

The first entry has no page yet: a stub of constants in the zero tail of the vdso's last page (writing there makes the page
private to the process) maps the pages and opens a userfaultfd, keeping both results in registers. The tail is zeroed afterwards.

No instruction changes a flag or touches the stack. Source: signal(7), ptrace(2), vdso(7); kernel/signal.c, get_signal().
"""

from __future__ import annotations

import ctypes
import itertools
import os
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from checkpoint.arch import x86_64 as arch
from checkpoint.arch.x86_64 import Call
from checkpoint.errors import CaptureError
from checkpoint.linux import abi, procfs
from checkpoint.linux.memory import Memory
from checkpoint.linux.procfs import MapsLine
from checkpoint.linux.tracee import Tracee

CODE_SIZE: Final = 4 * abi.PAGE_SIZE
TABLE_SIZE: Final = 4 * abi.PAGE_SIZE
SIZE: Final = CODE_SIZE + TABLE_SIZE
MAGIC: Final = b"failover borrows these pages; 1\0"
"""Stands at the end of the code pages, and at the beginning of the table."""
BATCH_TIMEOUT_S: Final = 1.0
"""How long a batch may take: its calls never wait, so only a machine that does not run the program at all exceeds this."""
CALL_LIMIT: Final = 200
"""Calls in one batch; ``CODE_SIZE`` holds 220 of the longest."""

IDLE: Final = 0
ARMED: Final = 1
ENDED: Final = 2
ABANDONED: Final = 3

_RESULTS: Final = 0x100
_OUTPUTS: Final = _RESULTS + 8 * CALL_LIMIT
_OUTPUT_ALIGNMENT: Final = 16
_HEAD: Final = struct.Struct("<32sQQQQQQQQ")  # magic, state, done, serial, mask, timeout (2 words), empty set, resume


def _places(table: int) -> arch.TablePlaces:
    words = table + 32
    return arch.TablePlaces(
        state=words,
        ended=ENDED,
        done=words + 8,
        serial=words + 16,
        mask=words + 24,
        timeout=words + 32,
        empty_set=words + 48,
        resume=words + 56,
        registers=words + 64,
        results=table + _RESULTS,
    )


class Batch:
    """System calls put in order for one run; each answers with its place in the results.

    Args:
        table: address of the borrowed table: outputs of the calls go there.
    """

    def __init__(self, table: int) -> None:
        self._table = table
        self.calls: list[Call] = []
        self.output_size = 0

    def output(self, size: int) -> int:
        """Reserve room for what a call writes; answers with its address in the tracee."""
        address = self._table + _OUTPUTS + self.output_size
        self.output_size += -(-size // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT
        if _OUTPUTS + self.output_size > TABLE_SIZE:
            raise CaptureError(f"too much to ask of a process at once: {self.output_size} bytes of answers")
        return address

    def add(self, name: str, *arguments: int) -> int:
        """Add a call."""
        if len(self.calls) >= CALL_LIMIT:
            raise CaptureError(f"too much to ask of a process at once: more than {CALL_LIMIT} system calls")
        self.calls.append(Call(name, arguments))
        return len(self.calls) - 1


@dataclass(frozen=True, slots=True)
class Answers:
    """What a batch brought back.

    Attributes:
        results: of each call, signed: negative is an errno.
    """

    results: tuple[int, ...]
    _outputs: bytes
    _base: int

    def at(self, address: int, size: int) -> bytes:
        """What a call wrote at an address that `Batch.output` gave."""
        offset = address - self._base
        return self._outputs[offset : offset + size]


class BorrowedPages:
    """Our pages in one tracee; every method is called while it stands still, and leaves it standing still.

    Attributes:
        address: of the code pages; the table follows them.
    """

    def __init__(self, memory: Memory, address: int) -> None:
        self.address = address
        self.table = address + CODE_SIZE
        self._memory = memory
        self._places = _places(self.table)
        self._code_key: tuple[Call, ...] | None = None
        self._serial = 0

    @property
    def end(self) -> int:
        """The first address after them."""
        return self.address + SIZE

    def holds(self, address: int) -> bool:
        """Whether an address lies inside."""
        return self.address <= address < self.end

    def state(self) -> int:
        """`IDLE`, `ARMED`, `ENDED` or `ABANDONED`, as it stands in the table."""
        return int.from_bytes(self._memory.read(self._places.state, 8), "little")

    def abandon(self) -> None:
        """Leave the pages to the program as ordinary memory: something of its own may still lead there."""
        self._memory.write(self._places.state, struct.pack("<Q", ABANDONED))

    def run(self, tracee: Tracee, batch: Batch, registers: bytes, mask: int) -> Answers:
        """Make the calls of a batch; afterwards the thread stands exactly as before.

        Args:
            registers: as the thread was stopped with; given back untouched.
            mask: the program's own signal mask.

        Raises:
            ProcessGoneError: it was killed meanwhile.
            CaptureError: the batch did not run in time; the program goes on.
        """
        self._write(batch, arch.decode_registers(registers), mask)
        there = arch.decode_registers(registers)
        there[arch.INSTRUCTION_POINTER] = self.address
        there[arch.CALL_NUMBER] = -1
        tracee.set_registers(arch.encode_registers(there))
        tracee.set_signal_mask(abi.ALL_SIGNALS)
        tracee.cont()
        try:
            self._wait_done()
        finally:
            give_back(tracee, registers, mask)
        self._memory.write(self._places.state, struct.pack("<Q", IDLE))
        return self._answers(batch)

    def _write(self, batch: Batch, registers: arch.Registers, mask: int) -> None:
        key = tuple(batch.calls)
        if key != self._code_key:
            code = arch.batch_code(self.address, key, self._places)
            assert len(code) + len(MAGIC) <= CODE_SIZE, "CALL_LIMIT keeps the code within its pages"
            self._memory.poke(self.address, code)
            self._code_key = key
        self._serial += 1
        resume = resumed(registers)
        head = _HEAD.pack(
            MAGIC, ARMED, 0, self._serial, mask, 0, arch.ENTRY_TIMEOUT_NS, 0, resume[arch.INSTRUCTION_POINTER]
        ) + struct.pack(f"<{len(arch.CLOBBERED)}Q", *(resume[name] for name in arch.CLOBBERED))
        self._memory.write(self.table, head)

    def _wait_done(self) -> None:
        deadline = time.perf_counter() + BATCH_TIMEOUT_S
        done = struct.pack("<Q", self._serial)
        while self._memory.read(self._places.done, 8) != done:
            if time.perf_counter() > deadline:
                raise CaptureError(
                    f"pid {self._memory.pid} did not run for {BATCH_TIMEOUT_S:g} s while it was looked at: it is frozen by its "
                    "cgroup, or higher priorities leave it no processor; capture it again when it runs"
                )
            os.sched_yield()

    def _answers(self, batch: Batch) -> Answers:
        count = len(batch.calls)
        raw = self._memory.read(self._places.results, _OUTPUTS - _RESULTS + batch.output_size)
        results = struct.unpack_from(f"<{count}q", raw)
        return Answers(results, raw[_OUTPUTS - _RESULTS :], self.table + _OUTPUTS)


def give_back(tracee: Tracee, registers: bytes, mask: int) -> None:
    """Stop the thread wherever our code has it, and set it where the program stood. Mask first: see step 5."""
    tracee.freeze()
    tracee.set_signal_mask(mask)
    tracee.set_registers(registers)


def resumed(registers: arch.Registers) -> arch.Registers:
    """The registers with which the live program can go on without the kernel's help: an interrupted call is made again."""
    result = ctypes.c_int64(registers[arch.RESULT]).value
    number = ctypes.c_int64(registers[arch.CALL_NUMBER]).value
    if number < 0:
        return registers
    if result in arch.RESTARTABLE:
        again = number
    elif result == arch.RESTART_BLOCK:
        again = arch.SYSCALLS["restart_syscall"]
    else:
        return registers
    return {
        **registers,
        arch.RESULT: again,
        arch.INSTRUCTION_POINTER: registers[arch.INSTRUCTION_POINTER] - len(arch.SYSCALL),
        arch.CALL_NUMBER: -1,
    }


# The first entry


@dataclass(frozen=True, slots=True)
class Entered:
    """What the first entry brought.

    Attributes:
        faults: a userfaultfd of the tracee's memory, ours now; None where the kernel refused it.
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
    index = batch.add("userfaultfd", abi.O_CLOEXEC | abi.O_NONBLOCK | abi.UFFD_USER_MODE_ONLY)
    inside = pages.run(tracee, batch, registers, mask).results[index]
    if inside < 0:
        return Entered(pages, None, -1, -inside)
    return Entered(pages, _taken(tracee.pid, inside), inside)


def enter(tracee: Tracee, maps: Sequence[MapsLine], registers: bytes, mask: int) -> Entered:
    """Borrow pages in a stopped tracee that has none of ours; it stands as before afterwards.

    The userfaultfd is still open inside; the next batch closes `Entered.inside`.

    Raises:
        ProcessGoneError: it was killed meanwhile.
        CaptureError: no place for the stub, or its memory limit leaves no room.
    """
    place, room = vdso_tail(tracee.memory, maps)
    hole = largest_hole(maps)
    stub = arch.entry_code(place, _entry_calls(hole), resumed(arch.decode_registers(registers)), mask)
    if len(stub) > room:
        raise CaptureError(
            f"cannot enter pid {tracee.pid}: its vdso has only {room} spare bytes of {len(stub)}; upgrade the kernel"
        )
    tracee.memory.poke(place, stub)
    there = arch.decode_registers(registers)
    there[arch.INSTRUCTION_POINTER] = place + arch.ENTRY_CODE_OFFSET
    there[arch.CALL_NUMBER] = -1
    tracee.set_registers(arch.encode_registers(there))
    tracee.set_signal_mask(abi.ALL_SIGNALS)
    tracee.cont()
    try:
        _wait_in_call(tracee.pid, "rt_sigtimedwait")
        tracee.freeze()
        found = arch.decode_registers(tracee.registers())
    except CaptureError:
        give_back(tracee, registers, mask)
        raise
    code, table, inside = (ctypes.c_int64(found[name]).value for name in arch.ENTRY_REGISTERS)
    faults = _taken(tracee.pid, inside) if inside >= 0 else None
    tracee.set_signal_mask(mask)
    tracee.set_registers(registers)
    tracee.memory.poke(place, bytes(len(stub)))
    if code != hole or table != hole + CODE_SIZE:
        raise CaptureError(
            f"cannot borrow pages in pid {tracee.pid}: {os.strerror(-min(code, table, 0))}; raise its limit of address space"
        )
    pages = BorrowedPages(tracee.memory, hole)
    tracee.memory.poke(pages.table - len(MAGIC), MAGIC)
    return Entered(pages, faults, inside, -inside if inside < 0 else 0)


def _entry_calls(hole: int) -> arch.EntryCalls:
    fixed = abi.MAP_PRIVATE | abi.MAP_ANONYMOUS | abi.MAP_FIXED_NOREPLACE
    read_execute, read_write = abi.PROT_READ | abi.PROT_EXEC, abi.PROT_READ | abi.PROT_WRITE
    return arch.EntryCalls(
        code_pages=Call("mmap", (hole, CODE_SIZE, read_execute, fixed, -1, 0)),
        table_pages=Call("mmap", (hole + CODE_SIZE, TABLE_SIZE, read_write, fixed, -1, 0)),
        advice=Call("madvise", (hole, SIZE, abi.MADV_DONTFORK)),
        faults=Call("userfaultfd", (abi.O_CLOEXEC | abi.O_NONBLOCK | abi.UFFD_USER_MODE_ONLY,)),
    )


def _wait_in_call(pid: int, name: str) -> None:
    """Wait until the thread waits in this system call.

    Source: proc_pid_syscall(5): the number is the first word.
    """
    deadline = time.perf_counter() + BATCH_TIMEOUT_S
    wanted = str(arch.SYSCALLS[name])
    while procfs.read_text(pid, "syscall").partition(" ")[0] != wanted:
        if time.perf_counter() > deadline:
            raise CaptureError(
                f"pid {pid} did not run for {BATCH_TIMEOUT_S:g} s while it was looked at: it is frozen by its cgroup, or higher "
                "priorities leave it no processor; protect it again when it runs"
            )
        os.sched_yield()


def _taken(pid: int, inside: int) -> int:
    pidfd = os.pidfd_open(pid)
    try:
        return abi.pidfd_getfd(pidfd, inside)
    finally:
        os.close(pidfd)


USER_END: Final = 0x7FFF_FFFF_E000
"""The first address that a program cannot have (47-bit addresses, one guard page)."""
USER_START: Final = 1 << 20
"""Below lie vm.mmap_min_addr and what old programs expect to be free."""


def largest_hole(maps: Sequence[MapsLine]) -> int:
    """An address in the middle of the largest unmapped stretch, where neither heap nor stack nor new mappings come soon.

    Raises:
        CaptureError: there is no room.
    """
    ends = [USER_START, *(line.end for line in maps if line.end < USER_END)]
    starts = [*(line.start for line in maps if USER_START <= line.start < USER_END), USER_END]
    size, begin = max((start - end, end) for end, start in zip(sorted(ends), sorted(starts), strict=False))
    if size < 3 * SIZE:
        raise CaptureError("cannot borrow pages: the address space has no hole left")
    return (begin + size // 2) & -abi.PAGE_SIZE


_ELF64_HEADER: Final = struct.Struct("<16sHHIQQQIHHHHHH")
_SPARE_ALIGNMENT: Final = 64


def vdso_tail(memory: Memory, maps: Sequence[MapsLine]) -> tuple[int, int]:
    """The unused end of the vdso's last page: its address and size.

    Raises:
        CaptureError: the process has no vdso.
    """
    begin = vdso_image_end(memory, maps)
    return begin, max(0, next(line.end for line in maps if line.name == "[vdso]") - begin)


def vdso_image_end(memory: Memory, maps: Sequence[MapsLine]) -> int:
    """Where the vdso's own content ends.

    Raises:
        CaptureError: the process has no vdso.

    Source: elf(5): the section headers are the last thing in the image.
    """
    for line in maps:
        if line.name == "[vdso]":
            header = _ELF64_HEADER.unpack(memory.read(line.start, _ELF64_HEADER.size))
            sections_end = int(header[6] + header[11] * header[12])
            return line.start + -(-sections_end // _SPARE_ALIGNMENT) * _SPARE_ALIGNMENT
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


def is_in_stub(instruction_pointer: int, memory: Memory, maps: Sequence[MapsLine]) -> bool:
    """Whether a thread stands in the stub of an earlier tracer's first entry: it leaves it by itself."""
    return any(line.name == "[vdso]" and line.start <= instruction_pointer < line.end for line in maps) and (
        instruction_pointer >= vdso_image_end(memory, maps)
    )
