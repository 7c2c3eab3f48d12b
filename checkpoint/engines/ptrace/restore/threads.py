"""Restore the threads of a program besides its first: created inside the vessel, each with the id that the others know.

The restore traces them from their creation (PTRACE_O_TRACECLONE), so none runs before its state is complete. They share
everything that the threads of a process share; each sets its own state by a table of calls like the first thread's.

Source: clone(2) (clone3, set_tid), ptrace(2).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
import struct
from collections.abc import Iterable
from typing import Final

from checkpoint.arch import cpu, stubs
from checkpoint.errors import CheckpointError, ProcessGoneError, RestoreError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace import call_table
from checkpoint.linux.trace.call_table import CallTable, Stub
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.resources.process import exited_processes
from checkpoint.resources.process.exited_processes import Departed, Descriptors

CLONE_VM: Final = 0x100
CLONE_FS: Final = 0x200
CLONE_FILES: Final = 0x400
CLONE_SIGHAND: Final = 0x800
CLONE_THREAD: Final = 0x10000
CLONE_SYSVSEM: Final = 0x40000
FLAGS: Final = CLONE_VM | CLONE_FS | CLONE_FILES | CLONE_SIGHAND | CLONE_THREAD | CLONE_SYSVSEM
"""Things that pthread_create(3) shares; those that it sets (thread-local storage, id addresses) come with registers and table."""

ANY_ID: Final = 0
PTRACE_EVENT_FORK: Final = 1
_ARGUMENTS: Final = struct.Struct("<10Q")
"""struct clone_args of linux/sched.h, as far as set_tid_size: the ids wanted are a list of their own."""


class IdInUseError(RestoreError):
    """Another thread or process has the wanted id."""


def spawn(leader: Tracee, registers: bytes, base: int, tid: int) -> Tracee:
    """Have the first thread give birth to one with the id ``tid``; it stands still at its first instruction.

    Args:
        registers: any of the leader's, to begin with.
        base: of the area that holds the loop, whose syscall instruction is used; the leader stands still in it.

    Raises:
        RestoreError: that id cannot be had.
    """
    thread = leader.child(_birth(leader, registers, base, (FLAGS, 0, tid), f"thread {tid}"), leader.memory)
    thread.wait(call_table.RUN_TIMEOUT_S)
    return thread


def spawn_process(parent: Tracee, registers: bytes, base: int, pid: int, exit_signal: int, flags: int) -> Tracee:
    """Have a process give birth to one with the id ``pid``; it stands still at its first instruction. As `spawn`.

    Args:
        exit_signal: what the parent is sent when it ends.
        flags: of clone(2): what both share.

    Raises:
        IdInUseError: another thread or process has that id.
    """
    process = parent.child(_birth(parent, registers, base, (flags, exit_signal, pid), f"process {pid}"))
    process.wait(call_table.RUN_TIMEOUT_S)
    return process


def spawn_any(parent: Tracee, registers: bytes, base: int) -> Tracee:
    """Have a process give birth to one with any id; no signal tells the parent of its end. As `spawn`."""
    process = parent.child(_birth(parent, registers, base, (0, 0, ANY_ID), "stand-in for a process that has ended"))
    process.wait(call_table.RUN_TIMEOUT_S)
    return process


def open_what_is_left(
    parent: Tracee, registers: bytes, stub: Stub, ended: Iterable[Departed], descriptors: Iterable[int]
) -> tuple[set[int], Descriptors]:
    """Have a process open what is left of others that have ended: for each a child is born, and ended before it runs.

    Args:
        registers: as for `spawn`.
        descriptors: that it has.

    Returns:
        Those that it has now, and where among the nameless objects the new ones are.
    """
    opened, made = set(descriptors), Descriptors()
    for one in ended:
        child = spawn_any(parent, registers, stub.base)
        try:
            number = procfs.status(child.pid).pids[-1]
            table = CallTable(stub.base, descriptors=opened)
            made |= one.open(table, number)
            stub.run(table)
            opened = table.descriptors
        finally:
            end(child, ())
        table = CallTable(stub.base)
        exited_processes.forget(table, number)
        stub.run(table)
    return opened, made


def _birth(parent: Tracee, registers: bytes, base: int, wanted: tuple[int, int, int], what: str) -> int:
    """The id, as we see it, of the thread or process that was born.

    Args:
        wanted: flags of clone3(2), exit signal, id.
    """
    place = base + abi.PAGE_SIZE
    flags, exit_signal, tid = wanted
    listed = (0, 0) if tid == ANY_ID else (place + _ARGUMENTS.size, 1)
    arguments = _ARGUMENTS.pack(flags, 0, 0, 0, exit_signal, 0, 0, 0, *listed)
    parent.memory.write(place, arguments + struct.pack("<i", tid))
    instruction = base + stubs.CALL_LOOP.index(cpu.SYSCALL)
    call = stubs.SYSTEM_CALLS["clone3"], (place, _ARGUMENTS.size)
    parent.set_registers(stubs.at_call(registers, instruction, *call))
    born = 0
    for _ in ("entry", "birth or exit"):
        parent.request("step", abi.PTRACE_SYSCALL)
        if parent.wait(call_table.RUN_TIMEOUT_S).event in (abi.PTRACE_EVENT_CLONE, PTRACE_EVENT_FORK):
            born = _born(parent)
            parent.request("step", abi.PTRACE_SYSCALL)
            parent.wait(call_table.RUN_TIMEOUT_S)
    if not born:
        number = -stubs.call_result(parent.registers())
        kind = IdInUseError if number == errno.EEXIST else RestoreError
        raise kind(f"cannot restore its {what}: {_reason(number)}")
    return born


def _born(leader: Tracee) -> int:
    """The id, as we see it, of the thread that the leader tells of."""
    message = ctypes.c_ulong()
    leader.request("ask for the newborn of", abi.PTRACE_GETEVENTMSG, 0, ctypes.addressof(message))
    return message.value


def _reason(number: int) -> str:
    if number == errno.EEXIST:
        return "that id is in use; free it, or run the program in PIDs of its own (failover run isolates)"
    if number == errno.EPERM:
        return "choosing an id needs CAP_CHECKPOINT_RESTORE; give it to the agent, or allow user namespaces"
    return os.strerror(number)


def end(leader: Tracee, others: Iterable[Tracee]) -> None:
    """Kill a vessel that will be no program: all of it ends for its tracer first, or its parent would wait for it in vain."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(leader.pid, signal.SIGKILL)
    for thread in (*others, leader):
        with contextlib.suppress(ProcessGoneError, CheckpointError):
            while True:
                thread.wait(call_table.RUN_TIMEOUT_S)
