"""Run many system calls inside a vessel for the price of one stop: a table of calls, each with its allowed results.

The area for the loop, the table and the strings lies in a hole of both address spaces (the vessel's and the program's), so that
it outlives everything that the calls map and unmap.
"""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
import signal
from typing import Final

from msgspec import Struct, field

from checkpoint.arch import cpu
from checkpoint.arch import stubs as arch
from checkpoint.errors import RestoreError
from checkpoint.linux import abi
from checkpoint.linux.trace.tracee import Tracee

AREA_SIZE: Final = 64 << 20
"""Bytes of address space that the area may take: 65,530 mappings (vm.max_map_count) with five calls and a path each fit."""

ANY: Final = -(1 << 63)
MOST: Final = (1 << 63) - 1

AT_FDCWD: Final = -100

_LOWEST_ADDRESS: Final = 0x10000000000
_HIGHEST_ADDRESS: Final = 0x7000_0000_0000
"""The range in which we look for a hole: above every non-PIE program, below the kernel's place for libraries."""
_STEP: Final = 1 << 36
_WIDTH: Final = 47
"""Bits of the smallest address space for which that holds; in a smaller one we look at the same fractions of it."""


class Call(Struct, frozen=True):
    """One system call of a table.

    Attributes:
        what: the call and its object, for messages.
        least, most: results that are as expected; any other stops the table.
        lost: what will differ when it fails; "" when it must not fail.
    """

    what: str
    number: int
    arguments: tuple[int, ...]
    least: int
    most: int
    lost: str = ""


class CallTable(Struct):
    """Calls and the bytes that they point to, to be laid at ``base`` of a vessel.

    Layout: a page for the loop, then the bytes, then the calls.

    Attributes:
        descriptors: those that are open once the calls so far have been made; the kernel gives the lowest free number, so the
            numbers of those still to be opened are known beforehand, and checked when they are.
    """

    base: int
    calls: list[Call] = field(default_factory=list)
    content: bytearray = field(default_factory=bytearray)
    descriptors: set[int] = field(default_factory=lambda: {0, 1, 2})

    def call(self, what: str, name: str, *arguments: int, least: int = 0, most: int = MOST) -> None:
        """Add a call that must have one of these results."""
        self.calls.append(Call(what, arch.SYSTEM_CALLS[name], arguments, least, most))

    def attempt(self, lost: str, name: str, *arguments: int) -> None:
        """Add a call that may fail; ``lost`` is the note for that case, "" if it needs none."""
        self.calls.append(Call(lost, arch.SYSTEM_CALLS[name], arguments, ANY, MOST, lost))

    def open(self, path: str, flags: int, mode: int = 0) -> int:
        """Add the opening of a file: the descriptor that it will have."""
        return self.obtain(f"open {path}", "openat", AT_FDCWD, self.place_path(path), flags, mode)

    def obtain(self, what: str, name: str, *arguments: int) -> int:
        """Add a call that makes a descriptor: the number that it will have."""
        number = self.lowest_descriptor()
        self.call(what, name, *arguments, least=number, most=number)
        self.descriptors.add(number)
        return number

    def obtain_pair(self, what: str, name: str, *arguments: int) -> tuple[int, int]:
        """Add a call that makes two descriptors; the numbers that it writes are not checked."""
        pair = []
        for _ in range(2):
            pair.append(self.lowest_descriptor())
            self.descriptors.add(pair[-1])
        self.call(what, name, *arguments)
        return pair[0], pair[1]

    def close(self, descriptor: int) -> None:
        """Add the closing of a descriptor."""
        self.call(f"close descriptor {descriptor}", "close", descriptor)
        self.descriptors.discard(descriptor)

    def duplicate(self, descriptor: int, number: int, flags: int) -> None:
        """Add a second descriptor for what one stands for.

        Args:
            flags: O_CLOEXEC or 0.
        """
        what = f"make descriptor {number} a copy of {descriptor}"
        self.call(what, "dup3", descriptor, number, flags, least=number, most=number)
        self.descriptors.add(number)

    def close_on_exec(self, descriptor: int) -> None:
        """Have a descriptor closed by execve."""
        self.call(f"mark descriptor {descriptor}", "fcntl", descriptor, fcntl.F_SETFD, fcntl.FD_CLOEXEC)

    def lowest_descriptor(self) -> int:
        """The number that the kernel gives to the next descriptor."""
        return next(number for number in itertools.count() if number not in self.descriptors)

    def place(self, content: bytes) -> int:
        """Lay bytes beside the table: their address in the vessel, a multiple of 16."""
        self.content += bytes(-len(self.content) % 16)
        address = self.base + abi.PAGE_SIZE + len(self.content)
        self.content += content
        return address

    def place_path(self, path: str) -> int:
        """Lay a path beside the table, as C wants it."""
        return self.place(os.fsencode(path) + b"\0")

    @property
    def first(self) -> int:
        """Address of the first call."""
        return self.base + abi.PAGE_SIZE + -(-len(self.content) // 16) * 16

    @property
    def end(self) -> int:
        """Address after the last call."""
        return self.first + len(self.calls) * arch.CALL.size

    def encode(self) -> bytes:
        """Bytes and calls as they lie in the vessel, from the second page of the area on."""
        self.content += bytes(-len(self.content) % 16)
        packed = [
            arch.CALL.pack(call.number, *(_word(a) for a in (*call.arguments, 0, 0, 0, 0, 0, 0)[:6]), 0, call.least, call.most)
            for call in self.calls
        ]
        return bytes(self.content) + b"".join(packed)


def _word(value: int) -> int:
    return value & ((1 << 64) - 1)


def find_hole(taken: list[tuple[int, int]], size: int) -> int:
    """An address with ``size`` free bytes around which no mapping grows.

    Args:
        taken: [start, end) of every mapping there is or will be, in any order.

    Raises:
        RestoreError: the address space is full.
    """
    room = 1 << 30  # on either side, for stacks and heaps to grow into
    highest = max((end for _, end in taken), default=1 << _WIDTH)
    missing = max(_WIDTH - (cpu.user_end(highest) - 1).bit_length(), 0)
    for start in range(*(number >> missing for number in (_LOWEST_ADDRESS, _HIGHEST_ADDRESS, _STEP))):
        if all(end <= start - room or begin >= start + size + room for begin, end in taken):
            return start
    raise RestoreError(f"cannot restore: no {size >> 20} MiB of address space are free between the program's mappings")


class Stub:
    """The area inside a stopped vessel, from which tables of calls are run."""

    def __init__(self, tracee: Tracee, base: int) -> None:
        self.tracee = tracee
        self.base = base
        self._registers = tracee.registers()

    def install(self, instruction: int, size: int) -> None:
        """Map the area with the vessel's own syscall instruction at ``instruction`` and lay the loop in it.

        Args:
            size: bytes for everything that tables will need.
        """
        assert size <= AREA_SIZE
        size = -(-size // abi.PAGE_SIZE) * abi.PAGE_SIZE
        flags = abi.MAP_PRIVATE | abi.MAP_ANONYMOUS | abi.MAP_FIXED_NOREPLACE
        self._single(instruction, "mmap", self.base, size, abi.PROT_READ | abi.PROT_WRITE, flags, -1, 0)
        self.tracee.memory.write(self.base, arch.CALL_LOOP)
        self._single(instruction, "mprotect", self.base, abi.PAGE_SIZE, abi.PROT_READ | abi.PROT_EXEC)

    def run(self, table: CallTable) -> tuple[str, ...]:
        """Make the calls of a table: a note for each attempt that failed.

        Raises:
            RestoreError: a call had an unexpected result; names it.
        """
        assert table.base == self.base
        self.tracee.memory.write(self.base + abi.PAGE_SIZE, table.encode())
        self.tracee.set_registers(arch.at_table(self._registers, self.base, table.first, table.end))
        self.tracee.cont()
        stop = self.tracee.wait(RUN_TIMEOUT_S)
        if stop.signal != signal.SIGTRAP or stop.event:
            raise RestoreError(f"cannot restore: the vessel stopped by signal {stop.signal} in the middle of its system calls")
        stopped = arch.stopped_call(self.tracee.registers())
        packed = self.tracee.memory.read(table.first, table.end - table.first)
        results = [unpacked[7] for unpacked in arch.CALL.iter_unpack(packed)]
        if stopped != table.end:
            index = (stopped - table.first) // arch.CALL.size
            raise RestoreError(f"cannot {table.calls[index].what}: {_reason(results[index])}")
        failed = [(call, result) for call, result in zip(table.calls, results, strict=True) if call.lost and _is_error(result)]
        return tuple(f"{call.lost}: {_reason(result)}" for call, result in failed)

    def _single(self, instruction: int, name: str, *arguments: int) -> int:
        result = single_call(self.tracee, self._registers, instruction, arch.SYSTEM_CALLS[name], *arguments)
        if _is_error(result):
            raise RestoreError(f"cannot {name} in the vessel: {_reason(result)}")
        return result


RUN_TIMEOUT_S: Final = 30.0
"""How long a table may take: opening files on a slow network file system is the longest part."""


def single_call(tracee: Tracee, registers: bytes, instruction: int, number: int, *arguments: int) -> int:
    """Make one system call with a syscall instruction that the tracee already has; it stands after the call then.

    Stops at entry and exit are no signals, so this works with any use of SIGTRAP by the program (a breakpoint would reset a
    blocked or ignored SIGTRAP, see force_sig_info_to_task in kernel/signal.c).
    """
    tracee.set_registers(arch.at_call(registers, instruction, number, arguments))
    for _ in ("entry", "exit"):
        tracee.request("step", abi.PTRACE_SYSCALL)
        stop = tracee.wait(RUN_TIMEOUT_S)
        if stop.signal != signal.SIGTRAP | 0x80:
            raise RestoreError(f"cannot restore: the vessel stopped by signal {stop.signal} in the middle of a system call")
    return arch.call_result(tracee.registers())


def _is_error(result: int) -> bool:
    return -4095 <= result < 0


def _reason(result: int) -> str:
    if _is_error(result):
        return f"{os.strerror(-result)} ({errno.errorcode.get(-result, -result)})"
    return f"unexpected result {result:#x}"
