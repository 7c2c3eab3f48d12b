"""Create namespaces for one program: PIDs, clocks, mounts; inside a user namespace where we have no rights.

Only a short-lived child calls these functions, before the program is started; never a process that lives on.

Sources: namespaces(7), user_namespaces(7), pid_namespaces(7), time_namespaces(7), clone(2), capabilities(7).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct

from checkpoint.model import Clocks

CLONE_PARENT: Final = 0x00008000
CLONE_NEWNS: Final = 0x00020000
CLONE_NEWTIME: Final = 0x00000080
CLONE_NEWUSER: Final = 0x10000000
CLONE_NEWPID: Final = 0x20000000

PR_SET_PDEATHSIG: Final = 1
PR_SET_KEEPCAPS: Final = 8
PR_CAP_AMBIENT: Final = 47
PR_CAP_AMBIENT_RAISE: Final = 2
PR_SET_PTRACER: Final = 0x59616D61

CAP_SYS_ADMIN: Final = 21
CAP_CHECKPOINT_RESTORE: Final = 40

_SYS_CLONE3: Final = 435
_SYS_CLOSE_RANGE: Final = 436
_CLOSE_RANGE_CLOEXEC: Final = 4
_MS_NOSUID_NODEV: Final = 2 | 4
_MS_NOSUID_NODEV_NOEXEC: Final = 2 | 4 | 8
_MS_NOSUID: Final = 2
_MS_NOEXEC: Final = 8
_MS_REC_SLAVE: Final = 16384 | (1 << 19)
_CAPABILITY_VERSION_3: Final = 0x20080522
_NS_PER_S: Final = 1_000_000_000

# Holds the interpreter's lock across the call: in a child made by clone3 there is no other thread to hand it back.
_libc = ctypes.PyDLL(None, use_errno=True)


class _CloneArguments(ctypes.Structure):
    """struct clone_args of clone(2), version 1 (80 bytes, Linux 5.5)."""

    _fields_ = [
        (name, ctypes.c_uint64)
        for name in (
            *("flags", "pidfd", "child_tid", "parent_tid", "exit_signal"),
            *("stack", "stack_size", "tls", "set_tid", "set_tid_size"),
        )
    ]


def sibling(pid: int = 0) -> int:
    """Fork a child of our *parent*: 0 in the child, its PID here.

    Args:
        pid: the PID it must have in the PID namespace it is born into; 0: any.

    Raises:
        OSError: EEXIST when the PID is taken, EPERM when we may not choose.
    """
    wanted = (ctypes.c_int32 * 1)(pid)
    arguments = _CloneArguments(flags=CLONE_PARENT)
    if pid:
        arguments.set_tid = ctypes.addressof(wanted)
        arguments.set_tid_size = 1
    return _checked(
        _libc.syscall(ctypes.c_long(_SYS_CLONE3), ctypes.byref(arguments), ctypes.c_size_t(ctypes.sizeof(arguments))),
        f"clone3(set_tid={pid})" if pid else "clone3",
    )


class Entered(Struct, frozen=True):
    """Which namespaces of its own the caller's next child will have.

    Attributes:
        notes: a sentence for each thing that was wanted and is not had.
    """

    pids: bool
    clocks: bool
    user: bool
    notes: tuple[str, ...] = ()


def enter(pids: bool, clocks: bool) -> Entered:
    """Give the caller's children a PID namespace, a time namespace, or both, as far as this system lets us.

    With PIDs come mounts of their own, so that a /proc that shows these PIDs can be mounted over ours.
    """
    notes: list[str] = []
    if pids and not _may_keep_mounts():
        notes.append(f"no namespace of its own for PIDs: {_IN_A_CHROOT}")
        pids = False
    attempts = [(pids, clocks)] + ([(True, False), (False, True)] if pids and clocks else [])
    for with_pids, with_clocks in attempts:
        if not (with_pids or with_clocks):
            break
        flags = (CLONE_NEWPID | CLONE_NEWNS if with_pids else 0) | (CLONE_NEWTIME if with_clocks else 0)
        user, refusal = _unshare_as_permitted(flags)
        if refusal is None:
            if with_pids:
                _checked(_libc.mount(None, b"/", None, ctypes.c_ulong(_MS_REC_SLAVE), None), "mount(/, MS_SLAVE)")
            return Entered(with_pids, with_clocks, user, tuple(notes))
        wanted = " and ".join(name for name, on in (("PIDs", with_pids), ("clocks", with_clocks)) if on)
        notes.append(f"no namespace of its own for {wanted}: {refusal}")
    return Entered(False, False, False, tuple(notes))


_CURE: Final = "give it CAP_SYS_ADMIN, or allow user namespaces (sysctl user.max_user_namespaces; never in a chroot)"


_IN_A_CHROOT: Final = (
    "every process would see its mounts, for the root directory is that of a chroot and no mount point; bind that directory "
    "to itself first (mount --bind DIRECTORY DIRECTORY)"
)


def _may_keep_mounts() -> bool:
    """Whether mounts can be of one namespace alone here. The mount of the root directory hands them on, and a process that was
    put into a directory of it (chroot(2)) cannot name it. Source: mount_namespaces(7); do_change_type() in fs/namespace.c."""
    lines = Path("/proc/self/mountinfo").read_text().splitlines()
    return any(line.split(" ", 5)[4] == "/" for line in lines)


def _unshare_as_permitted(flags: int) -> tuple[bool, str | None]:
    """Unshare plainly, else inside a new user namespace: (whether a user namespace was made, why nothing could be done)."""
    if _libc.unshare(flags) == 0:
        return False, None
    if ctypes.get_errno() != errno.EPERM:
        return False, os.strerror(ctypes.get_errno())
    uid, gid = os.geteuid(), os.getegid()
    if _libc.unshare(flags | CLONE_NEWUSER) != 0:
        return False, f"{os.strerror(ctypes.get_errno())}; {_CURE}"
    Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1")
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1")
    return True, None


def set_clocks(clocks: Clocks, elapsed_ns: int) -> None:
    """Make the children's monotonic and boot time go on from ``clocks`` plus what has elapsed since.

    Call after ``enter`` and before the first child: the kernel fixes the offsets when a process comes in.

    Args:
        elapsed_ns: time since the reading; below zero counts as zero, so that the program's clocks never go back.

    Raises:
        PermissionError: CAP_SYS_TIME is missing where the namespace belongs.
        OSError: the kernel refuses the offset (ERANGE: the clock would be negative or leave its range).
    """
    elapsed_ns = max(elapsed_ns, 0)
    offsets = Path("/proc/self/timens_offsets")
    now = {name: int(seconds) * _NS_PER_S + int(rest) for name, seconds, rest in map(str.split, offsets.read_text().splitlines())}
    wanted = {"monotonic": (clocks.monotonic_ns, time.CLOCK_MONOTONIC), "boottime": (clocks.boottime_ns, time.CLOCK_BOOTTIME)}
    lines = []
    for name, (reading_ns, clock) in wanted.items():
        seconds, rest = divmod(now[name] + reading_ns + elapsed_ns - time.clock_gettime_ns(clock), _NS_PER_S)
        lines.append(f"{name} {seconds} {rest}\n")
    try:
        offsets.write_text("".join(lines))
    except PermissionError as error:
        reason = "its clocks cannot be set; give the agent CAP_SYS_TIME, see systemd/failover-agent.service"
        raise PermissionError(error.errno, reason) from error


def mount_memory(place: int, uid: int, gid: int, size: int) -> None:
    """Mount an empty file system in memory over a directory, for the caller's mount namespace alone.

    Args:
        place: descriptor of the directory: a name could be made to lead elsewhere meanwhile.
        uid, gid: whose it is.
        size: bytes that it may hold.

    Raises:
        OSError: EPERM without the right to mount.
    """
    options = f"mode=755,uid={uid},gid={gid},size={size}".encode()
    target = f"/proc/self/fd/{place}".encode()
    _checked(_libc.mount(b"failover", target, b"tmpfs", ctypes.c_ulong(_MS_NOSUID_NODEV), options), "mount(tmpfs)")


def mount_proc() -> None:
    """Mount a /proc that shows the caller's PID namespace over the one that is there.

    Raises:
        OSError: EPERM in a container whose own /proc is partly hidden.
    """
    _checked(_libc.mount(b"proc", b"/proc", b"proc", ctypes.c_ulong(_MS_NOSUID_NODEV_NOEXEC), None), "mount(/proc)")


def mount_terminals() -> None:
    """Mount pseudo-terminals of the caller's own over those that are there.

    Their numbers begin at 0, and no other program takes one.

    Raises:
        OSError: there is no /dev/pts, or it may not be mounted.

    Source: Documentation/filesystems/devpts.rst.
    """
    options = b"newinstance,ptmxmode=0666,mode=0620"
    _checked(_libc.mount(b"devpts", b"/dev/pts", b"devpts", ctypes.c_ulong(_MS_NOSUID | _MS_NOEXEC), options), "mount(/dev/pts)")


def keep_restore_right() -> None:
    """Keep CAP_CHECKPOINT_RESTORE over the next execve, for a caller that has it by a user namespace without being its root.

    Raises:
        OSError: the caller has no such right to keep.
    """
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable of capabilities 0-31, then of 32-63
    _checked(_libc.capget(header, sets), "capget")
    sets[5] |= 1 << (CAP_CHECKPOINT_RESTORE - 32)
    _checked(_libc.capset(header, sets), "capset")
    prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, CAP_CHECKPOINT_RESTORE)


def become(uid: int, gid: int, groups: Sequence[int]) -> None:
    """Become an ordinary user for good, in each of the four ids; of root's rights CAP_CHECKPOINT_RESTORE is left, if it is ours.

    By that one threads get their ids again. It opens no file and reaches no process of another user.

    Raises:
        OSError: we may not.
    """
    keeps = bool(_effective() & 1 << CAP_CHECKPOINT_RESTORE)
    prctl(PR_SET_KEEPCAPS, 1)
    os.setgroups(groups)
    os.setresgid(gid, gid, gid)
    os.setresuid(uid, uid, uid)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    kept = 1 << (CAP_CHECKPOINT_RESTORE - 32) if keeps else 0
    sets = (ctypes.c_uint32 * 6)(0, 0, 0, kept, kept, kept)  # effective, permitted, inheritable: see `keep_restore_right`
    _checked(_libc.capset(header, sets), "capset")
    prctl(PR_SET_KEEPCAPS, 0)
    if keeps:
        prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, CAP_CHECKPOINT_RESTORE)


def may_choose_pids() -> bool:
    """Whether we have a right by which a new process gets the PID that we want. Source: clone3(2), set_tid."""
    return bool(_effective() & (1 << CAP_CHECKPOINT_RESTORE | 1 << CAP_SYS_ADMIN))


def _effective() -> int:
    """Our capabilities."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("CapEff:")[2].split()[0], 16)


def prctl(option: int, *arguments: int) -> int:
    """Make one call of prctl(2).

    Raises:
        OSError: as the man page lists them.
    """
    words = [ctypes.c_ulong(word) for word in (*arguments, 0, 0, 0, 0)[:4]]
    return _checked(_libc.prctl(option, *words), f"prctl({option})")


def close_others_on_exec(first: int) -> None:
    """Have every descriptor from ``first`` on closed by the next execve.

    One by one where close_range(2) cannot do that: before Linux 5.11.
    """
    everything = ctypes.c_uint(0xFFFFFFFF)
    if _libc.syscall(_SYS_CLOSE_RANGE, ctypes.c_uint(first), everything, _CLOSE_RANGE_CLOEXEC) == 0:
        return
    for number in map(int, os.listdir("/proc/self/fd")):
        if number >= first:
            with contextlib.suppress(OSError):  # it was that of the listing
                os.set_inheritable(number, False)


def _checked(result: int, what: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
    return int(result)
