"""Restore the attributes of a process and its threads that have no file of their own, by system calls inside the vessel.

Marks of the address space, alternate stack, name, scheduling, directories, limits. Others: `signals`, `timers`, `rights`.

Each function adds its calls to a table; `checkpoint.engines.ptrace.restore.process` defines the order. If the vessel has no right
to restore an attribute, the restore adds a note, except where the program would go wrong without the attribute.

Sources: prctl(2), sched(7), getrlimit(2), rseq(2).
"""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Iterable
from typing import Final

from checkpoint.engines.ptrace.restore.vessel import CAP_SYS_CHROOT, CAP_SYS_RESOURCE, Vessel
from checkpoint.errors import MismatchError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable
from checkpoint.model import ProcessState, ThreadState
from checkpoint.resources.files import proc_and_sys, unlinked
from checkpoint.resources.process import scheduling as thread_scheduling

_NO_FILE: Final = 0xFFFFFFFF
_MM_MAP: Final = struct.Struct("<12Q2I")
SS_ONSTACK: Final = 1

DIRECTORY_MODE: Final = 0o755
"""The mode of a working directory that was missing; the umask takes bits from it."""

RLIM_INFINITY: Final = (1 << 64) - 1
RAISED_LIMITS: Final = (1, 2, 7, 8, 9)
"""RLIMIT_FSIZE, RLIMIT_DATA, RLIMIT_NOFILE, RLIMIT_MEMLOCK, RLIMIT_AS: those that a restore itself may meet."""


def memory_layout(table: CallTable, process: ProcessState, *, with_executable: bool, brought: int | None = None) -> None:
    """Set the marks of heap, stack, arguments, environment and auxiliary vector, and what /proc/PID/exe shows.

    Args:
        brought: descriptor of the executable, where it is not this machine's own file; None: it is. It is closed.
    """
    layout = process.layout
    executable = _NO_FILE
    if with_executable:
        own = brought is None
        executable = table.open(process.executable.path, os.O_RDONLY | os.O_CLOEXEC) if own else brought  # type: ignore[assignment]
    packed = _MM_MAP.pack(
        *(
            layout.start_code,
            layout.end_code,
            layout.start_data,
            layout.end_data,
            layout.start_brk,
            layout.brk,
            layout.start_stack,
        ),
        *(layout.arg_start, layout.arg_end, layout.env_start, layout.env_end),
        *(table.place(layout.auxv) if layout.auxv else 0, len(layout.auxv), executable),
    )
    what = f"set the marks of the address space (prctl PR_SET_MM_MAP, executable {process.executable.path})"
    table.call(what, "prctl", abi.PR_SET_MM, abi.PR_SET_MM_MAP, table.place(packed), len(packed), 0)
    if executable != _NO_FILE:
        table.close(executable)


def thread_marks(table: CallTable, thread: ThreadState) -> None:
    """Alternate stack, robust list, the address cleared at its end, restartable sequences, name."""
    address, flags, size = thread.altstack
    stack = struct.pack("<QiiQ", address, flags & ~SS_ONSTACK, 0, size)
    table.call("set the alternate signal stack", "sigaltstack", table.place(stack), 0)
    if thread.robust_list[0]:
        table.call("set the robust list", "set_robust_list", *thread.robust_list)
    table.call("set the address that is cleared at the end", "set_tid_address", thread.clear_tid)
    if thread.rseq is not None:
        rseq = thread.rseq
        table.call("register restartable sequences", "rseq", rseq.address, rseq.size, rseq.flags, rseq.signature)
    table.call("set the name", "prctl", abi.PR_SET_NAME, table.place(os.fsencode(thread.name) + b"\0"))


def scheduling(table: CallTable, thread: ThreadState, vessel: Vessel, whose: str = "") -> None:
    """Priority, policy, processors, I/O priority, timer slack.

    Args:
        whose: added to the notes.
    """
    table.attempt(f"nice {thread.nice} is not kept{whose}", "setpriority", 0, 0, thread.nice)
    if thread.policy & ~os.SCHED_RESET_ON_FORK != thread_scheduling.SCHED_DEADLINE and thread.policy:
        priority = table.place(struct.pack("<i", thread.priority))
        table.attempt(f"scheduling policy {thread.policy} is not kept{whose}", "sched_setscheduler", 0, thread.policy, priority)
    allowed = vessel.affinity & set(thread.affinity)
    if allowed and allowed != vessel.affinity:
        mask = sum(1 << processor for processor in allowed).to_bytes(max(allowed) // 64 * 8 + 8, "little")
        table.attempt(f"the choice of processors is not kept{whose}", "sched_setaffinity", 0, len(mask), table.place(mask))
    if thread.io_priority:
        table.attempt(f"the I/O priority is not kept{whose}", "ioprio_set", 1, 0, thread.io_priority)
    table.attempt(f"the timer slack is not kept{whose}", "prctl", abi.PR_SET_TIMERSLACK, thread.timer_slack_ns)


def make_directories(table: CallTable, directories: Iterable[str]) -> None:
    """Make what leads to the working directory, each as the program would: empty, and its user's."""
    for directory in directories:
        table.call(f"make the directory {directory}", "mkdirat", AT_FDCWD, table.place_path(directory), DIRECTORY_MODE)


def enter_directory(table: CallTable, directory: str, opened: int | None) -> None:
    """Make a directory the working one; one that is gone is made again, and goes again; `exited_processes` has entered /proc's.

    Args:
        opened: a descriptor that the program has of it, if it is gone.
    """
    if opened is not None:
        table.call(f"enter the working directory {directory}", "fchdir", opened)
    elif proc_and_sys.left_by_ended(directory):
        return
    elif procfs.is_gone(directory):
        made = unlinked.make_directory(table, directory.removesuffix(procfs.DELETED), DIRECTORY_MODE)
        table.call(f"enter the working directory {directory}", "fchdir", made)
        table.close(made)
    else:
        table.call(f"enter the working directory {directory}", "chdir", table.place_path(directory))


def may_not_enter(root: str) -> str:
    """Why a program cannot have its root directory."""
    return f"its root directory is {root}, and to enter it takes CAP_SYS_CHROOT: restore it as root"


def enter_root(table: CallTable, process: ProcessState, vessel: Vessel) -> None:
    """Have the program see the root directory that it had (chroot): after all that is opened by our paths, with its rights left.

    Raises:
        MismatchError: the vessel may not.
    """
    root = process.root_directory
    if root == "/":
        return
    if not vessel.may(CAP_SYS_CHROOT):
        reason = may_not_enter(root)
        raise MismatchError(reason, (reason,))
    table.call(f"make {root} its root directory", "chroot", table.place_path(root))


def surroundings(table: CallTable, process: ProcessState) -> None:
    """Umask, execution domain, session, and the process's own switches."""
    table.call("set the umask", "umask", process.umask)
    table.call("set the execution domain", "personality", process.personality)
    if process.sid == process.pid:
        table.attempt("", "setsid")  # of several processes each has come to its session when it was born (`birth_order`)
    elif process.pgid == process.pid:
        table.attempt("", "setpgid", 0, 0)
    if process.child_subreaper:
        table.call("become a subreaper", "prctl", abi.PR_SET_CHILD_SUBREAPER, 1)
    if process.thp_disabled:
        table.call("switch huge pages off", "prctl", abi.PR_SET_THP_DISABLE, 1)


def begin_member(table: CallTable) -> None:
    """One process of several: what the end of others has sent it is forgotten, and it ends with its parent until it is complete.

    Source: do_sigaction() in kernel/signal.c: setting an action that ignores a signal forgets those that are pending.
    """
    table.call("forget whose end was told", "rt_sigaction", signal.SIGCHLD, table.place(bytes(32)), 0, abi.SIGSET_SIZE)
    table.call("end with the parent", "prctl", abi.PR_SET_PDEATHSIG, signal.SIGKILL)


def raise_limits(table: CallTable, vessel: Vessel) -> None:
    """Lift the limits that a restore itself would meet, as far as they go; `limits` sets the program's own."""
    for number in RAISED_LIMITS:
        hard = vessel.hard_limits[number]
        packed = struct.pack("<2Q", hard & RLIM_INFINITY, hard & RLIM_INFINITY)
        table.attempt("", "prlimit64", 0, number, table.place(packed), 0)


def limits(table: CallTable, process: ProcessState, vessel: Vessel) -> tuple[str, ...]:
    """Set the program's limits: notes for those that had to be lowered to what the vessel may have."""
    notes = []
    for number, (soft, hard) in sorted(process.limits.items()):
        ceiling = vessel.hard_limits.get(number, -1) & RLIM_INFINITY
        wanted_soft, wanted_hard = soft & RLIM_INFINITY, hard & RLIM_INFINITY
        if wanted_hard > ceiling and not vessel.may(CAP_SYS_RESOURCE):
            notes.append(f"limit {number} is {ceiling} here, it was {wanted_hard}")
            wanted_soft, wanted_hard = min(wanted_soft, ceiling), ceiling
        packed = table.place(struct.pack("<2Q", wanted_soft, wanted_hard))
        table.attempt(f"limit {number} is not kept", "prlimit64", 0, number, packed, 0)
    return tuple(notes)


def last_marks(table: CallTable, process: ProcessState) -> None:
    """Set, last, what a change of user undoes: dumpable, and the signal at the parent's death (ours until now)."""
    if process.dumpable in (0, 1):
        table.call("set dumpable", "prctl", abi.PR_SET_DUMPABLE, process.dumpable)
    table.call("set the signal at the parent's death", "prctl", abi.PR_SET_PDEATHSIG, process.parent_death_signal)
