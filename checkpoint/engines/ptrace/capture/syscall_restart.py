"""Prepare interrupted system calls in a snapshot, so that the restored program makes them again.

The live program needs none of this: it gets its registers back unchanged and the kernel decides (except for the calls of
`checkpoint.engines.ptrace.capture.eintr_syscalls`). After a restore no kernel remembers the call, so the snapshot is prepared to
make it again, with the rest of its time where the program can be given it.

Source: signal(7), restart_syscall(2), nanosleep(2).
"""

from __future__ import annotations

import ctypes
import errno
import operator
from collections.abc import Container
from typing import Final

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.engines.ptrace.capture.eintr_syscalls import Waiting
from checkpoint.errors import CaptureError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.trace import interrupted_syscalls, restart_blocks, syscall_reentry
from checkpoint.linux.trace.tracee import Tracee

CODE_LOOKED_AT = 32
"""Bytes before a ``syscall`` instruction in which the C library loads the call's number."""

Place = tuple[int, ...]
"""Instruction pointer, stack pointer and arguments: the same while one call is restarted again and again."""
_OF_PLACE: Final = (arch.INSTRUCTION_POINTER, arch.STACK_POINTER, *arch.ARGUMENTS)
_RESTART: Final = arch.SYSCALLS["restart_syscall"]
_BEHIND: Final = len(arch.SYSCALL) if arch.FORGETS_CALLS else 0
"""Bytes from where a thread stands that is stopped in a call to where the call's instruction ends."""
_place_in: Final = operator.itemgetter(*map(arch.REGISTER_NAMES.index, _OF_PLACE))


class Interruption:
    """Remembers which call a thread stands in, over several stops of the same call.

    After the first stop the kernel goes on by restart_syscall(2), and the number of the call itself is gone from the registers.

    Attributes:
        waiting: of those calls that do not go on by themselves.
        begins_anew: it may not call restart_syscall(2).
    """

    def __init__(self, memory: Memory, *, makes_again: bool = False) -> None:
        self.waiting = Waiting(memory, makes_again=makes_again)
        self.begins_anew = False
        self._memory = memory
        self._place: Place = ()
        self._number = -1

    def is_disturbed(self, result: int) -> bool:
        """Whether a stop in a call may have changed what it returns, signed; or it is to be noted that none has any more."""
        return self.waiting.is_disturbed(result) or (self.begins_anew and result == arch.RESTART_BLOCK)

    def undisturbed(self, registers: Registers) -> Registers:
        """The registers that the live program gets back: see `Waiting.undisturbed`."""
        registers = self.waiting.undisturbed(registers)
        if not self.begins_anew or ctypes.c_int64(registers[arch.RESULT]).value != arch.RESTART_BLOCK:
            return registers
        number, registers = self._interrupted(registers, arch.call_number(registers))
        known = arch.SYSCALL_NAMES.get(number) in arch.RESTART_BLOCK_USERS
        return arch.made_again({**registers, arch.CALL_NUMBER: number}, 0) if known else registers

    def going_on(self, tracee: Tracee, registers: bytes) -> bytes:
        """The registers that a thread gets back which is about to make a call: by which it goes on as if it had not been stopped.

        Where the registers of a stop inside a call say so themselves this is not asked.

        Args:
            tracee: stands where it has come to by itself, if anything is to be found out.
        """
        decoded = arch.decode_registers(registers)
        number = decoded[arch.NUMBER]
        if tracee.is_as_found:
            tracee.left_alone = b""
        if not tracee.is_as_found or (number != _RESTART and not arch.may_go_on(decoded)):
            return registers
        if not syscall_reentry.is_before_a_call(tracee, decoded):
            return registers
        self._interrupted(decoded, number)
        if number != _RESTART and not tracee.stopped_by:
            registers = restart_blocks.shown(tracee, decoded)
            decoded = arch.decode_registers(registers)
        if decoded[arch.NUMBER] != _RESTART:
            return registers
        anew = arch.encode_registers(self._of_forgotten(decoded))
        if self.begins_anew and not tracee.is_as_found:
            tracee.set_registers(anew)
            return anew
        tracee.left_alone = anew  # a thread that restores itself has the kernel forget the call that it would go on with
        return registers

    def remembers(self, registers: bytes) -> bool:
        """Whether `settled` needs to ask the program nothing, for these registers as `Tracee.registers` gives them."""
        _, result, number = arch.stand_of(registers)
        if result != arch.RESTART_BLOCK or number != _RESTART:
            return True
        return bool(_place_in(arch.words_of(registers)) == self._place)

    def settled(self, registers: Registers) -> tuple[Registers, str]:
        """The registers that a snapshot goes on with, and the name of the call that is made again ("" if none)."""
        number = arch.call_number(registers)
        result = ctypes.c_int64(registers[arch.RESULT]).value
        if number < 0:
            return self._of_forgotten(registers) if arch.FORGETS_CALLS else registers, ""
        if result in arch.RESTARTABLE:
            return _again(registers, number)
        if result == arch.RESTART_BLOCK:
            return self._from_restart_block(registers, number)
        return registers, ""

    def _of_forgotten(self, registers: Registers) -> Registers:
        """As `settled`, of a thread that is told as standing in no call, and may be about to go on with one."""
        number = registers[arch.NUMBER]
        place = tuple(registers[name] for name in _OF_PLACE)
        if number != _RESTART:
            self._place, self._number = place, number
            return registers
        if place != self._place:
            return registers
        number, registers = self._interrupted(registers, number)
        if arch.SYSCALL_NAMES.get(number) in arch.RESTART_BLOCK_USERS:
            return {**registers, arch.NUMBER: number}
        behind = registers[arch.INSTRUCTION_POINTER] + len(arch.SYSCALL)
        return {**registers, arch.RESULT: -errno.EINTR, arch.INSTRUCTION_POINTER: behind}

    def _from_restart_block(self, registers: Registers, number: int) -> tuple[Registers, str]:
        number, registers = self._interrupted(registers, number)
        if arch.SYSCALL_NAMES.get(number) not in arch.RESTART_BLOCK_USERS:
            ended = {**registers, arch.RESULT: -errno.EINTR, arch.CALL_NUMBER: arch.NO_CALL}
            return ended, ""
        return _again(registers, number)

    def _interrupted(self, registers: Registers, number: int) -> tuple[int, Registers]:
        """The call itself, and the registers with which it waits for the rest of its time."""
        place = tuple(registers[name] for name in _OF_PLACE)
        if number == _RESTART:
            number = self._number if place == self._place else self._read_from_code(registers[arch.INSTRUCTION_POINTER] + _BEHIND)
        self._place, self._number = place, number
        name = arch.SYSCALL_NAMES.get(number, "")
        if name in arch.REMAINING_TIME:
            asked, remaining = (arch.ARGUMENTS[index] for index in arch.REMAINING_TIME[name])
            if registers[remaining]:
                registers = {**registers, asked: registers[remaining]}
        return number, registers

    def _read_from_code(self, instruction_pointer: int) -> int:
        try:
            code = self._memory.read(instruction_pointer - CODE_LOOKED_AT, CODE_LOOKED_AT)
        except CaptureError:
            return -1
        found = arch.call_number_before(code)
        return -1 if found is None else found


class Interruptions:
    """The interruptions of all threads of one process."""

    def __init__(self, *, makes_again: bool = False) -> None:
        """
        Args:
            makes_again: the program makes calls that EINTR has ended again itself (`eintr_syscalls.makes_calls_again`).
        """
        self._makes_again = makes_again
        self._by_tid: dict[int, Interruption] = {}

    def of(self, tracee: Tracee) -> Interruption:
        """The interruption of one thread."""
        if tracee.pid not in self._by_tid:
            self._by_tid[tracee.pid] = Interruption(tracee.memory, makes_again=self._makes_again)
        return self._by_tid[tracee.pid]

    def keep_only(self, tids: Container[int]) -> None:
        """Forget threads that have ended."""
        self._by_tid = {tid: kept for tid, kept in self._by_tid.items() if tid in tids}

    def mend(self, tracee: Tracee) -> None:
        """Let a thread that stands still, and has not been given registers, go on as if it had not been stopped."""
        interruption = self.of(tracee)
        if arch.FORGETS_CALLS and interruption.begins_anew:
            tracee.suspend_filters()
            interruption.going_on(tracee, tracee.registers())
        found = arch.decode_registers(tracee.registers())
        if arch.FORGETS_CALLS:
            found = interrupted_syscalls.told(tracee, found)
        mended = interruption.undisturbed(found)
        if mended != found:
            tracee.set_registers(arch.encode_registers(mended))


def _again(registers: Registers, number: int) -> tuple[Registers, str]:
    again = {
        **registers,
        arch.RESULT: number,
        arch.CALL_NUMBER: arch.NO_CALL,
        arch.INSTRUCTION_POINTER: registers[arch.INSTRUCTION_POINTER] - len(arch.SYSCALL),
    }
    return again, arch.SYSCALL_NAMES.get(number, str(number))


def outside_critical_section(pointer: int, memory: Memory, rseq_address: int) -> int:
    """Where the kernel itself would have a thread go on after a preemption: within a restartable sequence at its abort point.

    Args:
        pointer: the instruction that it stands at.

    Source: rseq(2); kernel/rseq.c, rseq_ip_fixup(): struct rseq holds the address of struct rseq_cs at offset 8.
    """
    section = int.from_bytes(memory.read(rseq_address + 8, 8), "little")
    if not section:
        return pointer
    described = memory.read(section, 32)
    start, length, abort = (int.from_bytes(described[offset : offset + 8], "little") for offset in (8, 16, 24))
    return abort if start <= pointer < start + length else pointer
