"""Make system calls inside a vessel through the vdso's own instruction, without mapping anything of the tracer there.

Source: vdso(7), execve(2); ptrace(2), PTRACE_O_TRACEEXEC, PTRACE_O_TRACESYSGOOD.
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.arch import cpu, stubs
from checkpoint.engines.ptrace.restore.memory import kernel_pages
from checkpoint.errors import RestoreError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace import call_table
from checkpoint.linux.trace.tracee import Stop, Tracee

PTRACE_EVENT_EXEC: Final = 4


def instruction_in(memory: Memory, start: int, size: int) -> int:
    """Where a syscall instruction lies in a vdso.

    Raises:
        RestoreError: nowhere.
    """
    offset = cpu.call_in(memory.read(start, size))
    if offset < 0:
        raise RestoreError("cannot restore: this kernel's vdso has no syscall instruction to leave by")
    return start + offset


class VdsoCalls:
    """Calls that the threads of a vessel make one by one.

    Args:
        tracee: its first thread.
        registers: any of its, to begin with.
        start, size: of the vdso, bytes.

    Raises:
        RestoreError: there is no instruction to make them by.
    """

    def __init__(self, tracee: Tracee, registers: bytes, start: int, size: int) -> None:
        self._tracee = tracee
        self._registers = registers
        self._instruction = instruction_in(tracee.memory, start, size)

    def make(self, name: str, *arguments: int, by: Tracee | None = None) -> None:
        """Have a thread, the first unless another is given, make one call.

        Raises:
            RestoreError: it failed.
        """
        number = stubs.SYSTEM_CALLS[name]
        result = call_table.single_call(by or self._tracee, self._registers, self._instruction, number, *arguments)
        if result < 0:
            raise RestoreError(f"cannot {name} as a step of a restore: {os.strerror(-result)}")


def execute(tracee: Tracee, path: str) -> None:
    """Have a vessel execute a file; it stands at the first instruction of that, of which nothing is to run.

    Raises:
        RestoreError: it cannot be executed.
    """
    mappings = procfs.parse_maps(procfs.read_text(tracee.pid, "maps"))
    image = kernel_pages(mappings)[-1]
    instruction = instruction_in(tracee.memory, image.start, image.size)
    stack = next(line for line in mappings if line.name == "[stack]")
    content = os.fsencode(path) + b"\0"
    place = stack.start + abi.PAGE_SIZE
    arguments = place + -(-len(content) // 16) * 16
    tracee.memory.write(place, content)
    tracee.memory.write(arguments, place.to_bytes(8, "little") + bytes(16))
    call = (stubs.SYSTEM_CALLS["execve"], (place, arguments, arguments + 8))
    tracee.set_registers(stubs.at_call(tracee.registers(), instruction, *call))
    _step(tracee)  # into the call
    if _step(tracee).event != PTRACE_EVENT_EXEC:
        reason = os.strerror(-stubs.call_result(tracee.registers()))
        raise RestoreError(f"cannot execute {path} in the vessel: {reason}")
    _step(tracee)  # out of the call, into a program that has not run yet


def _step(tracee: Tracee) -> Stop:
    tracee.request("step", abi.PTRACE_SYSCALL)
    return tracee.wait(call_table.RUN_TIMEOUT_S)
