"""Restore process attributes other than memory and files, by system calls inside the vessel.

Each function adds its calls to a table; `checkpoint.engines.ptrace.restore.process` defines the order. If the vessel has no right
to restore an attribute, the restore adds a note, except where the program would go wrong without the attribute.

Sources: prctl(2), rt_sigaction(2), timer_create(2), sched(7), credentials(7), capabilities(7), rseq(2).
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import struct
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.engine import RestoreOptions
from checkpoint.errors import MismatchError, RestoreError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable
from checkpoint.model import Credentials, IntervalTimer, PosixTimer, ProcessState, SignalAction, ThreadState
from checkpoint.resources.files import proc_and_sys, unlinked
from checkpoint.resources.process import scheduling as thread_scheduling

_NO_FILE: Final = 0xFFFFFFFF
_MM_MAP: Final = struct.Struct("<12Q2I")
_SIGTRAP: Final = 5
_UNCHANGEABLE: Final = (9, 19)
"""SIGKILL and SIGSTOP."""

SI_TIMER: Final = -2
SS_ONSTACK: Final = 1

PR_TIMER_CREATE_RESTORE_IDS: Final = 77
PR_TIMER_CREATE_RESTORE_IDS_GET: Final = 2
TIMER_ID_LIMIT: Final = 1024
"""Largest timer number that is reached by creating and deleting timers, on kernels that cannot be told the number."""

_NS_PER_US: Final = 1000
_US_PER_S: Final = 1_000_000
_NS_PER_S: Final = 1_000_000_000

CLOCK_MONOTONIC_COARSE: Final = 6
"""Its resolution is the kernel's tick."""

_CPU_TIME_CLOCKS: Final = (2, 3)
"""CLOCK_PROCESS_CPUTIME_ID and CLOCK_THREAD_CPUTIME_ID; a negative clock counts some process's CPU time too."""

DIRECTORY_MODE: Final = 0o755
"""Of a working directory that is missing; the umask takes from it."""

RLIM_INFINITY: Final = (1 << 64) - 1
RAISED_LIMITS: Final = (1, 2, 7, 8, 9)
"""RLIMIT_FSIZE, RLIMIT_DATA, RLIMIT_NOFILE, RLIMIT_MEMLOCK, RLIMIT_AS: those that a restore itself may meet."""

CAP_SETGID: Final = 6
CAP_SETUID: Final = 7
CAP_SETPCAP: Final = 8
CAP_SYS_RAWIO: Final = 17
CAP_SYS_CHROOT: Final = 18
CAP_SYS_PTRACE: Final = 19
CAP_SYS_ADMIN: Final = 21
CAP_SYS_RESOURCE: Final = 24
CAP_SYSLOG: Final = 34
CAP_PERFMON: Final = 38
CAP_BPF: Final = 39
CAP_CHECKPOINT_RESTORE: Final = 40
OPENING: Final = sum(1 << one for one in (CAP_SYS_RAWIO, CAP_SYS_PTRACE, CAP_SYSLOG, CAP_PERFMON, CAP_BPF))
"""Capabilities that open what a file system uid alone would not."""

PR_CAPBSET_DROP: Final = 24
PR_CAP_AMBIENT: Final = 47
PR_CAP_AMBIENT_RAISE: Final = 2
PR_CAP_AMBIENT_CLEAR_ALL: Final = 4
SECBIT_KEEP_CAPS: Final = 1 << 4
NO_ID: Final = 0xFFFFFFFF
_CAPABILITY_VERSION_3: Final = 0x20080522


class Vessel(Struct, frozen=True):
    """What the vessel is before it becomes the program.

    Attributes:
        inner_pid: its PID as it sees it itself.
        credentials: who it runs as.
        affinity: processors that it may use.
        hard_limits: by RLIMIT number; -1 is infinity.
    """

    pid: int
    inner_pid: int
    credentials: Credentials
    affinity: frozenset[int]
    hard_limits: Mapping[int, int]

    def may(self, capability: int) -> bool:
        """Whether a capability is in force."""
        return bool(self.credentials.capabilities[2] >> capability & 1)

    @property
    def may_choose_executable(self) -> bool:
        """Whether it may say what /proc/PID/exe shows."""
        return self.may(CAP_CHECKPOINT_RESTORE) or self.may(CAP_SYS_ADMIN)


def look_at_vessel(pid: int) -> Vessel:
    """What a vessel is and may do."""
    status = procfs.status(pid)
    credentials = Credentials(status.uids, status.gids, status.groups, status.capabilities)
    return Vessel(pid, status.pids[-1], credentials, frozenset(os.sched_getaffinity(pid)), _hard_limits(pid))


def _hard_limits(pid: int) -> dict[int, int]:
    return {number: resource.prlimit(pid, number)[1] for number in range(16)}


# --- The address space's marks ---------------------------------------------------------------------------------------


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


# --- Signals ---------------------------------------------------------------------------------------------------------


def signal_actions(table: CallTable, actions: Iterable[SignalAction]) -> None:
    """Set what every signal does, but SIGTRAP: the table's own end resets that one, see `trap_action`."""
    for action in actions:
        if action.signal not in (*_UNCHANGEABLE, _SIGTRAP):
            what = f"set the action of signal {action.signal}"
            table.call(what, "rt_sigaction", action.signal, table.place(packed_action(action)), 0, abi.SIGSET_SIZE)


def packed_action(action: SignalAction) -> bytes:
    """The kernel's struct sigaction."""
    return struct.pack("<4Q", action.handler, action.flags, action.restorer, action.mask)


def trap_action(actions: Iterable[SignalAction]) -> SignalAction:
    """What SIGTRAP did in the program."""
    return next((action for action in actions if action.signal == _SIGTRAP), SignalAction(_SIGTRAP, 0, 0, 0, 0))


def pending_signals(table: CallTable, process: ProcessState, inner_pid: int) -> None:
    """Queue what was pending for the process: every signal is blocked in the vessel, so they wait for the program.

    The signal of a periodic timer is queued by the timer itself, which `posix_timers` lets expire at once; SIGTRAP, by which
    tables end, by `pending_traps`.
    """
    for number, siginfo in _of_tables(process, process.pending):
        table.call(f"queue signal {number}", "rt_sigqueueinfo", inner_pid, number, table.place(siginfo))


def pending_of_thread(table: CallTable, process: ProcessState, thread: ThreadState, inner_pid: int, tid: int) -> None:
    """Queue what was pending for one thread; it alone may do so.

    Source: do_rt_tgsigqueueinfo() in kernel/signal.c: nobody pretends to the kernel's own signals but to himself.
    """
    for number, siginfo in _of_tables(process, thread.pending):
        table.call(f"queue signal {number}", "rt_tgsigqueueinfo", inner_pid, tid, number, table.place(siginfo))


def _of_tables(process: ProcessState, pending: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    return ((number, siginfo) for number, siginfo in _not_of_periodic_timers(process, pending) if number != _SIGTRAP)


def pending_traps(process: ProcessState, pending: Iterable[bytes]) -> Iterator[bytes]:
    """Each SIGTRAP that was pending: queued when no table is run any more, the mask as it was."""
    return (siginfo for number, siginfo in _not_of_periodic_timers(process, pending) if number == _SIGTRAP)


def _not_of_periodic_timers(process: ProcessState, pending: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    periodic = {timer.timer_id for timer in process.posix_timers if timer.interval_ns}
    for siginfo in pending:
        if timer_of(siginfo) not in periodic:
            yield struct.unpack_from("<i", siginfo)[0], siginfo


def timer_of(siginfo: bytes) -> int | None:
    """Number of the POSIX timer that sent a signal; None when something else did."""
    _, _, code, _, timer_id = struct.unpack_from("<5i", siginfo)
    return int(timer_id) if code == SI_TIMER else None


# --- The thread ------------------------------------------------------------------------------------------------------


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


# --- Timers ----------------------------------------------------------------------------------------------------------


def interval_timers(table: CallTable, timers: Iterable[IntervalTimer], elapsed_ns: int) -> None:
    """Arm the alarms of setitimer(2) again. Real time went on meanwhile; the program's CPU time did not.

    The kernel adds a tick to a CPU time that it is given, and tells it when asked. Source: set_cpu_itimer, kernel/time/itimer.c.
    """
    tick_us = round(time.clock_getres(CLOCK_MONOTONIC_COARSE) * _US_PER_S)
    for timer in timers:
        value_us = timer.value_us
        if timer.which == 0 and value_us:
            value_us = max(value_us - elapsed_ns // _NS_PER_US, 1)
        elif value_us:
            value_us = max(value_us - tick_us, 1)
        packed = struct.pack("<4q", *divmod(timer.interval_us, _US_PER_S), *divmod(value_us, _US_PER_S))
        table.call(f"arm interval timer {timer.which}", "setitimer", timer.which, table.place(packed), 0)


def posix_timers(
    table: CallTable, process: ProcessState, threads: Sequence[ThreadState], vessel: Vessel, elapsed_ns: int
) -> None:
    """Make the timers of timer_create(2) again, with the numbers that they had, and arm them.

    A kernel that does not let us say the number (before Linux 6.15) counts up to it; what comes before is deleted.
    """
    timers, inner_pid = process.posix_timers, vessel.inner_pid
    if not timers:
        return
    chosen_ids = timer_numbers_can_be_chosen()
    highest = max(timer.timer_id for timer in timers)
    if not chosen_ids and highest > TIMER_ID_LIMIT:
        raise RestoreError(
            f"cannot restore: it has a timer number {highest}, and this kernel counts up to it; use Linux 6.15 or later"
        )
    overdue = {timer_of(siginfo) for pending in (process.pending, *(one.pending for one in threads)) for siginfo in pending}
    others = {one.tid for one in threads[1:]}
    if chosen_ids:
        table.call("choose timer numbers", "prctl", PR_TIMER_CREATE_RESTORE_IDS, 1)
    next_id = 0
    for timer in sorted(timers, key=lambda timer: timer.timer_id):
        while not chosen_ids and next_id < timer.timer_id:
            _create_timer(table, PosixTimer(next_id, 1, 1, 0, 0, 0, 0, 0), inner_pid)
            table.call(f"delete timer {next_id}", "timer_delete", next_id)
            next_id += 1
        known = replace(timer, clock=_clock_here(timer.clock, process.pid, inner_pid))
        _create_timer(table, known, timer.tid if timer.tid in others else inner_pid)
        next_id = timer.timer_id + 1
    if chosen_ids:
        table.call("stop choosing timer numbers", "prctl", PR_TIMER_CREATE_RESTORE_IDS, 0)
    for timer in timers:
        if timer.value_ns:
            left_ns = 1 if timer.interval_ns and timer.timer_id in overdue else _left_of(timer, elapsed_ns)
            packed = struct.pack("<4q", *divmod(timer.interval_ns, _NS_PER_S), *divmod(left_ns, _NS_PER_S))
            table.call(f"arm timer {timer.timer_id}", "timer_settime", timer.timer_id, 0, table.place(packed), 0)


def _clock_here(clock: int, pid: int, inner_pid: int) -> int:
    """The number of a clock that may count the processor time of the process itself, by a PID that is another one here.

    Source: linux/posix-timers_types.h: the complement of the PID, shifted by three bits.
    """
    return clock - (~pid << 3) + (~inner_pid << 3) if clock < 0 and ~(clock >> 3) == pid else clock


def timer_numbers_can_be_chosen() -> bool:
    """Whether the kernel lets timer numbers be chosen (Linux 6.15); asking changes nothing."""
    return bool(ctypes.CDLL(None).prctl(PR_TIMER_CREATE_RESTORE_IDS, PR_TIMER_CREATE_RESTORE_IDS_GET, 0, 0, 0) >= 0)


def _create_timer(table: CallTable, timer: PosixTimer, tid: int) -> None:
    """Make one timer; ``tid`` is whom it signals if it signals a thread."""
    event = struct.pack("<Qiii", timer.value & RLIM_INFINITY, timer.signal, timer.notify, tid).ljust(64, b"\0")
    number = table.place(struct.pack("<i", timer.timer_id))
    table.call(f"create timer {timer.timer_id}", "timer_create", timer.clock, table.place(event), number)


def _left_of(timer: PosixTimer, elapsed_ns: int) -> int:
    if timer.clock in _CPU_TIME_CLOCKS or timer.clock < 0:
        return timer.value_ns
    return max(timer.value_ns - elapsed_ns, 1)


# --- Limits and the rest of the process --------------------------------------------------------------------------------


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


# --- Rights ----------------------------------------------------------------------------------------------------------


def own_eyes(table: CallTable, process: ProcessState, vessel: Vessel) -> None:
    """From here on open files as the program's user, who may have put other ones in their place: see `RestoreOptions`.

    Other rights by which views of the kernel and of other processes open are laid down until `rights`, too.

    Sources: capabilities(7), "Effect of user ID changes on capabilities": those for files go with a file system uid other than 0;
    ptrace(2), "Ptrace access mode checking".
    """
    if not (vessel.may(CAP_SETUID) and vessel.may(CAP_SETGID)):
        return
    theirs, (inheritable, permitted, effective, _, _) = process.credentials, vessel.credentials.capabilities
    _set_capabilities(table, effective & ~OPENING, permitted, inheritable)
    groups = table.place(struct.pack(f"<{len(theirs.groups)}I", *theirs.groups))
    table.call("set the groups", "setgroups", len(theirs.groups), groups)
    table.call("set the filesystem's gid", "setfsgid", theirs.gids[3])
    _see_as(table, process)


def _see_as(table: CallTable, process: ProcessState) -> None:
    table.call("set the filesystem's uid", "setfsuid", process.credentials.uids[3])
    table.call("end with the parent, still", "prctl", abi.PR_SET_PDEATHSIG, signal.SIGKILL)  # a change of user takes it back


@contextmanager
def our_eyes(table: CallTable, process: ProcessState, vessel: Vessel, options: RestoreOptions) -> Iterator[None]:
    """After `own_eyes`, have the calls that the body adds open files as the vessel again: what nobody can put another one for."""
    is_switched = options.own_eyes and vessel.may(CAP_SETUID) and vessel.may(CAP_SETGID)
    if is_switched:
        table.call("set the filesystem's uid to ours", "setfsuid", vessel.credentials.uids[3])
    yield
    if is_switched:
        _see_as(table, process)


def rights(table: CallTable, process: ProcessState, vessel: Vessel, *, ordinary: bool = False) -> tuple[str, ...]:
    """Become the user that the program ran as, with its capabilities: notes for what the vessel has no right to become.

    Everything that needs rights must stand before this in the table.

    Args:
        ordinary: it is not root's, and gets no inheritable capability: files may turn one into a right (capabilities(7)).
    """
    theirs, ours = process.credentials, vessel.credentials
    notes: list[str] = []
    if ordinary and (inheritable := theirs.capabilities[0]):
        theirs = replace(theirs, capabilities=(0, *theirs.capabilities[1:]))
        notes.append(f"inheritable capabilities {inheritable:#x} are not kept: only a program of root gets them")
    same_user = (theirs.uids, theirs.gids, set(theirs.groups)) == (ours.uids, ours.gids, set(ours.groups))
    if not same_user and vessel.may(CAP_SETUID) and vessel.may(CAP_SETGID):
        _bounding_set(table, theirs, vessel)
        _become_user(table, theirs, ours)
    elif not same_user:
        notes.append(f"runs as uid {ours.uids[1]} gid {ours.gids[1]}; it was uid {theirs.uids[1]} gid {theirs.gids[1]}")
    else:
        _bounding_set(table, theirs, vessel)
    notes += _capabilities(table, theirs, ours)
    if theirs.no_new_privs:
        table.call("forbid new privileges", "prctl", abi.PR_SET_NO_NEW_PRIVS, 1)
    if not theirs.securebits & ~SECBIT_KEEP_CAPS:
        table.attempt("", "prctl", abi.PR_SET_KEEPCAPS, int(process.keep_caps))
    return tuple(notes)


def _bounding_set(table: CallTable, theirs: Credentials, vessel: Vessel) -> None:
    lacking = vessel.credentials.capabilities[3] & ~theirs.capabilities[3]
    if not vessel.may(CAP_SETPCAP):
        return
    for capability in range(64):
        if lacking >> capability & 1:
            table.attempt("", "prctl", PR_CAPBSET_DROP, capability)


def _become_user(table: CallTable, theirs: Credentials, ours: Credentials) -> None:
    table.call("keep capabilities over the change of user", "prctl", abi.PR_SET_KEEPCAPS, 1)
    groups = table.place(struct.pack(f"<{len(theirs.groups)}I", *theirs.groups))
    table.call("set the groups", "setgroups", len(theirs.groups), groups)
    table.call(f"become gid {theirs.gids[1]}", "setresgid", *theirs.gids[:3])
    _set_file_id(table, "setfsgid", theirs.gids)  # before the user, whose change takes the right to
    table.call(f"become uid {theirs.uids[1]}", "setresuid", *theirs.uids[:3])
    if theirs.uids[3] not in theirs.uids[:3]:
        _set_capabilities(table, ours.capabilities[1], ours.capabilities[1], ours.capabilities[0])  # the change took them
    _set_file_id(table, "setfsuid", theirs.uids)


def _set_file_id(table: CallTable, name: str, ids: tuple[int, int, int, int]) -> None:
    """Set the id by which files are opened, where it is not the effective one: the call does not tell whether it did.

    Source: setfsuid(2), "Bugs": asked for what cannot be, it answers with the id in force.
    """
    if ids[3] != ids[1]:
        table.call("", name, ids[3])
        table.call(f"have files opened by id {ids[3]} ({name})", name, NO_ID, least=ids[3], most=ids[3])


def _set_capabilities(table: CallTable, effective: int, permitted: int, inheritable: int) -> None:
    sets = (effective, permitted, inheritable)
    low, high = [word & 0xFFFFFFFF for word in sets], [word >> 32 for word in sets]
    header = table.place(struct.pack("<Ii", _CAPABILITY_VERSION_3, 0))
    table.call("set the capabilities", "capset", header, table.place(struct.pack("<6I", *low, *high)))


def _capabilities(table: CallTable, theirs: Credentials, ours: Credentials) -> list[str]:
    """Capabilities, and what securebits forbid afterwards; raised to all that there are in between, where something needs it."""
    inheritable, permitted, effective, _, ambient = theirs.capabilities
    have = ours.capabilities[1]
    is_same = theirs.capabilities == ours.capabilities and theirs.uids == ours.uids
    if not is_same:
        table.attempt("", "prctl", PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL)
        kept = inheritable & (have | ours.capabilities[0])
        _set_capabilities(table, have, have, kept)
        for capability in range(64):
            if ambient >> capability & 1:
                table.attempt("an ambient capability is not kept", "prctl", PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, capability)
    if theirs.securebits & ~SECBIT_KEEP_CAPS:
        table.attempt("securebits are not kept", "prctl", abi.PR_SET_SECUREBITS, theirs.securebits)
    if not is_same:
        _set_capabilities(table, effective & have, permitted & have, kept)
    if permitted & ~have:
        return [f"capabilities {permitted & ~have:#x} of the program are not kept: failover does not have them"]
    return []


def last_marks(table: CallTable, process: ProcessState) -> None:
    """What a change of user undoes, so it comes last: dumpable, and the signal at the parent's death (ours until now)."""
    if process.dumpable in (0, 1):
        table.call("set dumpable", "prctl", abi.PR_SET_DUMPABLE, process.dumpable)
    table.call("set the signal at the parent's death", "prctl", abi.PR_SET_PDEATHSIG, process.parent_death_signal)
