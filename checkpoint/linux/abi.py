"""Kernel interface definitions: constants, structures and the few C calls that Python does not offer.

This module makes no decisions. Numbers that differ between processors are in `checkpoint.arch`.

Source: the uapi headers of Linux 6.18; each group names its own.
"""

from __future__ import annotations

import ctypes
import errno
import os
from typing import Any, Final

from checkpoint.arch import number_of

PAGE_SIZE: Final = os.sysconf("SC_PAGE_SIZE")
IOV_MAX: Final = 1024
"""Ranges that process_vm_readv(2) takes in one call (UIO_MAXIOV)."""

# linux/ptrace.h
PTRACE_CONT: Final = 7
PTRACE_SINGLESTEP: Final = 9
PTRACE_DETACH: Final = 17
PTRACE_SYSCALL: Final = 24
PTRACE_SETOPTIONS: Final = 0x4200
PTRACE_GETEVENTMSG: Final = 0x4201
PTRACE_GETREGSET: Final = 0x4204
PTRACE_SETREGSET: Final = 0x4205
PTRACE_SEIZE: Final = 0x4206
PTRACE_INTERRUPT: Final = 0x4207
PTRACE_PEEKSIGINFO: Final = 0x4209
PTRACE_GETSIGMASK: Final = 0x420A
PTRACE_SETSIGMASK: Final = 0x420B
PTRACE_SECCOMP_GET_FILTER: Final = 0x420C
PTRACE_SECCOMP_GET_METADATA: Final = 0x420D
PTRACE_GET_RSEQ_CONFIGURATION: Final = 0x420F
PTRACE_GET_SYSCALL_USER_DISPATCH_CONFIG: Final = 0x4211
PTRACE_EVENT_CLONE: Final = 3
PTRACE_EVENT_STOP: Final = 128
PTRACE_O_TRACESYSGOOD: Final = 0x01
PTRACE_O_TRACECLONE: Final = 0x08
PTRACE_O_TRACEEXEC: Final = 0x10
PTRACE_O_EXITKILL: Final = 0x100000
PTRACE_O_SUSPEND_SECCOMP: Final = 0x200000
PTRACE_PEEKSIGINFO_SHARED: Final = 1
WALL: Final = 0x40000000
"""__WALL of waitpid(2): also children that are not ours."""

ENDS: Final = (os.CLD_EXITED, os.CLD_KILLED, os.CLD_DUMPED)
"""The codes of waitid(2) for a process that has ended."""

# linux/elf.h: names of register sets
NT_PRSTATUS: Final = 1

# linux/filter.h
SOCK_FILTER_SIZE: Final = 8
"""Bytes of one instruction of a filter."""

# asm-generic/siginfo.h, asm-generic/signal.h
SIGINFO_SIZE: Final = 128
SIGINFO_PID: Final = 16
"""Offset of si_pid in struct siginfo: after three numbers, and four unused bytes."""
SIGSET_SIZE: Final = 8
SIGNAL_COUNT: Final = 64
ALL_SIGNALS: Final = (1 << SIGNAL_COUNT) - 1

# asm-generic/mman-common.h
PROT_NONE: Final = 0
PROT_READ: Final = 1
PROT_WRITE: Final = 2
PROT_EXEC: Final = 4
MAP_SHARED: Final = 0x01
MAP_PRIVATE: Final = 0x02
MAP_FIXED: Final = 0x10
MAP_ANONYMOUS: Final = 0x20
MAP_GROWSDOWN: Final = 0x0100
MAP_NORESERVE: Final = 0x4000
MAP_STACK: Final = 0x20000
MAP_FIXED_NOREPLACE: Final = 0x100000
MADV_DONTFORK: Final = 10
MADV_GUARD_INSTALL: Final = 102

# linux/userfaultfd.h
O_CLOEXEC: Final = os.O_CLOEXEC
O_NONBLOCK: Final = os.O_NONBLOCK
UFFD_USER_MODE_ONLY: Final = 1
UFFD_API: Final = 0xAA
UFFD_FEATURE_WP_UNPOPULATED: Final = 1 << 13
UFFD_FEATURE_WP_ASYNC: Final = 1 << 15
UFFDIO_API: Final = 0xC018AA3F
UFFDIO_REGISTER: Final = 0xC020AA00
UFFDIO_REGISTER_MODE_WP: Final = 2
UFFDIO_WRITEPROTECT: Final = 0xC018AA06

# linux/fs.h: PAGEMAP_SCAN
PAGEMAP_SCAN: Final = 0xC0606610
PM_SCAN_WP_MATCHING: Final = 1
PM_SCAN_CHECK_WPASYNC: Final = 2
PAGE_IS_WPALLOWED: Final = 1 << 0
PAGE_IS_WRITTEN: Final = 1 << 1
PAGE_IS_FILE: Final = 1 << 2
PAGE_IS_PRESENT: Final = 1 << 3
PAGE_IS_SWAPPED: Final = 1 << 4
PAGE_IS_PFNZERO: Final = 1 << 5
PAGE_IS_GUARD: Final = 1 << 8

# linux/prctl.h
PR_SET_PDEATHSIG: Final = 1
PR_GET_PDEATHSIG: Final = 2
PR_GET_DUMPABLE: Final = 3
PR_SET_DUMPABLE: Final = 4
PR_GET_KEEPCAPS: Final = 7
PR_SET_KEEPCAPS: Final = 8
PR_SET_NAME: Final = 15
PR_GET_SECUREBITS: Final = 27
PR_SET_SECUREBITS: Final = 28
PR_SET_TIMERSLACK: Final = 29
PR_GET_TIMERSLACK: Final = 30
PR_SET_MM: Final = 35
PR_SET_MM_MAP: Final = 14
PR_SET_CHILD_SUBREAPER: Final = 36
PR_GET_CHILD_SUBREAPER: Final = 37
PR_SET_NO_NEW_PRIVS: Final = 38
PR_GET_TID_ADDRESS: Final = 40
PR_SET_THP_DISABLE: Final = 41
PR_GET_THP_DISABLE: Final = 42

# System calls that have one number on every processor (from 424 on), made by ourselves.
NR_PIDFD_GETFD: Final = 438


class IoVec(ctypes.Structure):
    """struct iovec of process_vm_readv(2)."""

    _fields_ = (("base", ctypes.c_uint64), ("length", ctypes.c_uint64))


class PeekSiginfo(ctypes.Structure):
    """struct ptrace_peeksiginfo_args of ptrace(2)."""

    _fields_ = (("offset", ctypes.c_uint64), ("flags", ctypes.c_uint32), ("count", ctypes.c_int32))


class RseqConfiguration(ctypes.Structure):
    """struct ptrace_rseq_configuration of ptrace(2)."""

    _fields_ = (
        ("address", ctypes.c_uint64),
        ("size", ctypes.c_uint32),
        ("signature", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("pad", ctypes.c_uint32),
    )


class UffdApi(ctypes.Structure):
    """struct uffdio_api of ioctl_userfaultfd(2)."""

    _fields_ = (("api", ctypes.c_uint64), ("features", ctypes.c_uint64), ("ioctls", ctypes.c_uint64))


class UffdRegister(ctypes.Structure):
    """struct uffdio_register of ioctl_userfaultfd(2)."""

    _fields_ = (
        ("start", ctypes.c_uint64),
        ("length", ctypes.c_uint64),
        ("mode", ctypes.c_uint64),
        ("ioctls", ctypes.c_uint64),
    )


class UffdWriteProtect(ctypes.Structure):
    """struct uffdio_writeprotect of ioctl_userfaultfd(2); mode 0 takes the protection away."""

    _fields_ = (("start", ctypes.c_uint64), ("length", ctypes.c_uint64), ("mode", ctypes.c_uint64))


class PageScan(ctypes.Structure):
    """struct pm_scan_arg of PAGEMAP_SCAN (Documentation/admin-guide/mm/pagemap.rst)."""

    _fields_ = (
        ("size", ctypes.c_uint64),
        ("flags", ctypes.c_uint64),
        ("start", ctypes.c_uint64),
        ("end", ctypes.c_uint64),
        ("walk_end", ctypes.c_uint64),
        ("vec", ctypes.c_uint64),
        ("vec_len", ctypes.c_uint64),
        ("max_pages", ctypes.c_uint64),
        ("category_inverted", ctypes.c_uint64),
        ("category_mask", ctypes.c_uint64),
        ("category_anyof_mask", ctypes.c_uint64),
        ("return_mask", ctypes.c_uint64),
    )


_libc = ctypes.CDLL(None, use_errno=True)

process_vm_readv = _libc.process_vm_readv
process_vm_readv.argtypes = (
    ctypes.c_int, ctypes.c_void_p, ctypes.c_ulong, ctypes.c_void_p, ctypes.c_ulong, ctypes.c_ulong,
)  # fmt: skip
process_vm_readv.restype = ctypes.c_ssize_t

process_vm_writev = _libc.process_vm_writev
process_vm_writev.argtypes = process_vm_readv.argtypes
process_vm_writev.restype = ctypes.c_ssize_t

ioctl = _libc.ioctl
ioctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_void_p)
ioctl.restype = ctypes.c_int

_syscall = _libc.syscall
_syscall.restype = ctypes.c_long


def raise_errno(what: str) -> Any:
    """Raise the OSError of the C call that has just failed.

    Args:
        what: the call and its object, for the message.
    """
    number = ctypes.get_errno()
    raise OSError(number, f"{what}: {os.strerror(number)}")


def pidfd_getfd(pidfd: int, target: int) -> int:
    """Copy descriptor ``target`` of another process here (close-on-exec).

    Raises:
        OSError: EPERM without the right to trace, EBADF when it has no such descriptor.

    Source: pidfd_getfd(2).
    """
    result = int(_syscall(NR_PIDFD_GETFD, ctypes.c_int(pidfd), ctypes.c_int(target), ctypes.c_uint(0)))
    return result if result >= 0 else int(raise_errno(f"pidfd_getfd of descriptor {target}"))


def userfaultfd(number: int, flags: int) -> int:
    """A userfaultfd of our own memory; negative, with errno, where there is none.

    Args:
        number: of the call on this processor.

    Source: userfaultfd(2).
    """
    return int(_syscall(number, ctypes.c_int(flags)))


KCMP_FILES: Final = 2
KCMP_FILE: Final = 0
KCMP_VM: Final = 1
KCMP_FS: Final = 3
KCMP_EPOLL_TFD: Final = 7


class EpollSlot(ctypes.Structure):
    """struct kcmp_epoll_slot of linux/kcmp.h: the ``skipped`` + 1st thing that an epoll instance knows under a number."""

    _fields_ = (("epoll", ctypes.c_uint32), ("number", ctypes.c_uint32), ("skipped", ctypes.c_uint32))


_kcmp_number: Final = number_of("kcmp")
_held_syscall: Final = ctypes.PyDLL(None, use_errno=True).syscall
"""As `_syscall`, but other threads of the interpreter wait: for short calls, thousands of them while a program stands still."""
_held_syscall.argtypes = (ctypes.c_long,) * 6
_held_syscall.restype = ctypes.c_long


def kcmp(pid1: int, pid2: int, kind: int, index1: int = 0, index2: int = 0) -> int | None:
    """Whether two processes share something: 0 the same, 1 or 2 ordered, 3 unordered; None where the kernel cannot tell.

    Negative when there is no such process or descriptor.

    Source: kcmp(2).
    """
    if _kcmp_number is None:
        return None
    result = int(_held_syscall(_kcmp_number, pid1, pid2, kind, index1, index2))
    if result < 0 and ctypes.get_errno() in (errno.ENOSYS, errno.EPERM):
        return None
    return result


_held_libc: Final = ctypes.PyDLL(None, use_errno=True)


def timerfd() -> int:
    """A descriptor (close-on-exec) that can be read whenever a timer of CLOCK_MONOTONIC has gone off; it is not set yet.

    Raises:
        OSError: there are too many descriptors.

    Source: timerfd_create(2).
    """
    number = int(_libc.timerfd_create(1, O_CLOEXEC))
    return number if number >= 0 else int(raise_errno("timerfd_create"))


def set_timerfd(timer: int, period_ns: int) -> None:
    """Have it go off after so long, again and again; 0: never."""
    setting = (ctypes.c_int64 * 4)(0, period_ns, 0, period_ns)
    if _held_libc.timerfd_settime(timer, 0, setting, None) < 0:
        raise_errno("timerfd_settime")


_robust_list_number: Final = number_of("get_robust_list")


def robust_list(tid: int) -> tuple[int, int]:
    """Head address and length of a thread's list of robust locks; (0, 0) where there is none.

    Raises:
        OSError: EPERM without the right to trace, ESRCH when it has ended.

    Source: get_robust_list(2).
    """
    head, length = ctypes.c_uint64(), ctypes.c_uint64()
    assert _robust_list_number is not None, "there are registers for this processor, so there are numbers"
    if int(_syscall(_robust_list_number, ctypes.c_int(tid), ctypes.byref(head), ctypes.byref(length))) < 0:
        raise_errno(f"get_robust_list of thread {tid}")
    return head.value, length.value


_io_priority_number: Final = number_of("ioprio_get")
IOPRIO_WHO_PROCESS: Final = 1


def io_priority(pid: int) -> int:
    """The I/O priority as ioprio_set(2) takes it; 0 (none of its own) where the kernel does not tell."""
    if _io_priority_number is None:
        return 0
    return max(int(_held_syscall(_io_priority_number, IOPRIO_WHO_PROCESS, pid, 0, 0, 0)), 0)


def set_io_priority(priority: int) -> None:
    """Set our own, as `io_priority` tells it; nothing happens where the kernel does not offer it.

    Raises:
        PermissionError: the class for real time needs CAP_SYS_NICE.

    Source: ioprio_set(2).
    """
    number = number_of("ioprio_set")
    if (
        number is not None
        and int(_syscall(number, ctypes.c_int(IOPRIO_WHO_PROCESS), ctypes.c_int(0), ctypes.c_int(priority))) < 0
    ):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
