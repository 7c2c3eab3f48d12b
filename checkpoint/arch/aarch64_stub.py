"""aarch64 machine code for a restore: the wait loop of a vessel, and the loop that makes many system calls at once.

Data only, each with its assembly beside it. Sources: Procedure Call Standard for the Arm 64-bit Architecture, elf(5), syscall(2).
"""

from __future__ import annotations

import struct
from typing import Final

from checkpoint.arch import aarch64

LOAD_ADDRESS: Final = 0x400000
"""Where the little programs below are mapped. A restore unmaps them before it maps the snapshot, so any place would do."""

WAIT: Final = bytes.fromhex(
    "000080d2"  # again: mov  x0, #0
    "010080d2"  #        mov  x1, #0
    "020080d2"  #        mov  x2, #0
    "030080d2"  #        mov  x3, #0
    "040080d2"  #        mov  x4, #0
    "280980d2"  #        mov  x8, #73        ppoll(2)
    "010000d4"  #        svc  #0
    "f9ffff17"  #        b    again
)
"""Waits for ever. A vessel runs this until a restorer seizes it."""

WATCH: Final = bytes.fromhex(
    "690080d2"  #        mov  x9, #3
    "2900c0f2"  #        movk x9, #1, lsl #32
    "e90f1ff8"  #        str  x9, [sp, #-16]!
    "e0030091"  # again: mov  x0, sp
    "210080d2"  #        mov  x1, #1
    "020080d2"  #        mov  x2, #0
    "030080d2"  #        mov  x3, #0
    "040080d2"  #        mov  x4, #0
    "280980d2"  #        mov  x8, #73        ppoll(2)
    "010000d4"  #        svc  #0
    "1f040071"  #        cmp  w0, #1
    "01ffff54"  #        b.ne again
    "000080d2"  #        mov  x0, #0
    "c80b80d2"  #        mov  x8, #94        exit_group(2)
    "010000d4"  #        svc  #0
)
"""Waits until descriptor 3 is readable (a pidfd: until its process has ended), then ends with status 0."""

CALL_LOOP: Final = bytes.fromhex(
    "7f0214eb"  #  next: cmp  x19, x20
    "c0010054"  #        b.eq stop
    "680240a9"  #        ldp  x8, x0, [x19]
    "610a41a9"  #        ldp  x1, x2, [x19, #16]
    "631242a9"  #        ldp  x3, x4, [x19, #32]
    "651a40f9"  #        ldr  x5, [x19, #48]
    "010000d4"  #        svc  #0
    "601e00f9"  #        str  x0, [x19, #56]
    "610a44a9"  #        ldp  x1, x2, [x19, #64]
    "1f0001eb"  #        cmp  x0, x1
    "ab000054"  #        b.lt stop
    "1f0002eb"  #        cmp  x0, x2
    "6c000054"  #        b.gt stop
    "73420191"  #        add  x19, x19, #80
    "f2ffff17"  #        b    next
    "000020d4"  #  stop: brk  #0
)
"""Makes the calls of a table in order and stops by a breakpoint: at its end, or at the first whose result was not expected.

Needs no stack. x19: this call, x20: end of the table. Each call is ten little-endian words: number, six arguments, result,
least, greatest (signed).
"""

CALL: Final = struct.Struct("<7Q3q")

MAKE_CALL: Final = (
    "680240a9"  #        ldp  x8, x0, [x19]
    "610a41a9"  #        ldp  x1, x2, [x19, #16]
    "631242a9"  #        ldp  x3, x4, [x19, #32]
    "652643a9"  #        ldp  x5, x9, [x19, #48]
    "010000d4"  #        svc  #0
    "490000b4"  #        cbz  x9, on
    "200100f9"  #        str  x0, [x9]
    "73020191"  #    on: add  x19, x19, #64
)
"""Hexadecimal: the call of the row at x19 is made, its result stored where the row says, and x19 goes to the next row."""

OWN_LOOP: Final = bytes.fromhex(
    "f353bfa9"  #        stp  x19, x20, [sp, #-16]!
    "f30300aa"  #        mov  x19, x0
    "f40301aa"  #        mov  x20, x1
    "7f0214eb"  #  next: cmp  x19, x20
    "40010054"  #        b.eq done
    f"{MAKE_CALL}"
    "f6ffff17"  #        b    next
    "f353c1a8"  #  done: ldp  x19, x20, [sp], #16
    "c0035fd6"  #        ret
)
"""A function of C that makes the calls of a table in a process of ours, all of them, also when some fail.

Each call is eight little-endian words: number, six arguments, address where the result goes, 0 for nowhere.
"""

SECOND_LOOP: Final = b""
"""None: what the first thread stores it would have to store in an order that this processor keeps only where it is told to."""

SYSTEM_CALLS: Final = {
    "accept4": 242,
    "bind": 200,
    "capset": 91,
    "chdir": 49,
    "chroot": 51,
    "clone3": 435,
    "close": 57,
    "connect": 203,
    "dup3": 24,
    "epoll_create1": 20,
    "epoll_ctl": 21,
    "eventfd2": 19,
    "execve": 221,
    "exit": 93,
    "exit_group": 94,
    "fallocate": 47,
    "fchmod": 52,
    "fchmodat": 53,
    "fchdir": 50,
    "fchown": 55,
    "fchownat": 54,
    "fcntl": 25,
    "flock": 32,
    "fstat": 80,
    "ftruncate": 46,
    "futex": 98,
    "getdents64": 61,
    "getpeername": 205,
    "get_robust_list": 100,
    "getpid": 172,
    "getpriority": 141,
    "getsockname": 204,
    "getsockopt": 209,
    "inotify_add_watch": 27,
    "inotify_init1": 26,
    "inotify_rm_watch": 28,
    "io_destroy": 1,
    "io_getevents": 4,
    "io_setup": 0,
    "io_submit": 2,
    "ioctl": 29,
    "ioprio_get": 31,
    "ioprio_set": 30,
    "kcmp": 272,
    "linkat": 37,
    "kill": 129,
    "listen": 201,
    "lseek": 62,
    "madvise": 233,
    "memfd_create": 279,
    "membarrier": 283,
    "mkdirat": 34,
    "mknodat": 33,
    "mlock2": 284,
    "mlockall": 230,
    "mmap": 222,
    "mprotect": 226,
    "mremap": 216,
    "mseal": 462,
    "munmap": 215,
    "newfstatat": 79,
    "open_by_handle_at": 265,
    "openat": 56,
    "personality": 92,
    "pidfd_getfd": 438,
    "pidfd_open": 434,
    "pipe2": 59,
    "pkey_alloc": 289,
    "pkey_free": 290,
    "pkey_mprotect": 288,
    "ppoll": 73,
    "prctl": 167,
    "pread64": 67,
    "prlimit64": 261,
    "process_vm_readv": 270,
    "process_vm_writev": 271,
    "ptrace": 117,
    "pwrite64": 68,
    "read": 63,
    "readlinkat": 78,
    "recvfrom": 207,
    "rseq": 293,
    "rt_sigaction": 134,
    "rt_sigqueueinfo": 138,
    "rt_tgsigqueueinfo": 240,
    "sched_getaffinity": 123,
    "sched_getparam": 121,
    "sched_getscheduler": 120,
    "sched_getattr": 275,
    "sched_setaffinity": 122,
    "sched_setattr": 274,
    "sched_setscheduler": 119,
    "seccomp": 277,
    "sendmsg": 211,
    "sendto": 206,
    "set_robust_list": 99,
    "set_tid_address": 96,
    "setfsgid": 152,
    "setfsuid": 151,
    "setgroups": 159,
    "setitimer": 103,
    "setpgid": 154,
    "setpriority": 140,
    "setresgid": 149,
    "setresuid": 147,
    "setsid": 157,
    "setsockopt": 208,
    "setxattr": 5,
    "shmat": 196,
    "shutdown": 210,
    "sigaltstack": 132,
    "signalfd4": 74,
    "socket": 198,
    "socketpair": 199,
    "symlinkat": 36,
    "timer_create": 107,
    "timer_delete": 111,
    "timer_settime": 110,
    "timerfd_create": 85,
    "timerfd_settime": 86,
    "umask": 166,
    "unlinkat": 35,
    "unshare": 97,
    "utimensat": 88,
    "wait4": 260,
    "waitid": 95,
    "write": 64,
}
"""Numbers of the system calls that a restore makes inside a vessel, and of those of `OWN_LOOP` (asm-generic/unistd.h)."""


EPOLL_EVENT: Final = struct.Struct("<IxxxxQ")
"""struct epoll_event."""
VDSO_CALLS: Final = {
    "__kernel_clock_gettime": 113,
    "__kernel_gettimeofday": 169,
    "__kernel_clock_getres": 114,
}
"""Functions of the vdso that can be had from any other, each with the system call that does the same. Not among them are
__kernel_getrandom, which makes the system call by itself without the kernel's data, and __kernel_rt_sigreturn, which needs none.
Source: vdso(7); lib/vdso/getrandom.c.
"""


def jump_to(address: int) -> bytes:
    """``ldr x16, …; br x16`` and where to: 16 bytes that go on at any address, all registers as they are but x16.

    x16 is free at the beginning of a function.
    """
    return struct.pack("<IIQ", 0x58000050, 0xD61F0200, address)


def call_and_return(number: int) -> bytes:
    """``mov w8, number; svc #0; ret``: a function that is a system call."""
    return struct.pack("<I", 0x52800008 | number << 5) + aarch64.SYSCALL + b"\xc0\x03\x5f\xd6"


def with_registers(registers: bytes, **values: int) -> bytes:
    """A copy of NT_PRSTATUS with some registers changed."""
    return aarch64.encode_registers(aarch64.decode_registers(registers) | values)


def in_interrupted_call(registers: bytes, interrupted: str) -> bytes:
    """Registers that go on as a snapshot's do: they make an interrupted call again.

    Args:
        interrupted: that call's name; "" when there is none, or none is told.
    """
    return with_registers(registers)


def at_call(registers: bytes, instruction: int, number: int, arguments: tuple[int, ...]) -> bytes:
    """Registers that make one system call with the svc instruction at an address."""
    return with_registers(registers, pc=instruction, x8=number, **dict(zip(aarch64.ARGUMENTS, arguments, strict=False)))


def call_result(registers: bytes) -> int:
    """The result of a system call: a negative error number, or its value."""
    value = aarch64.decode_registers(registers)[aarch64.RESULT]
    return value - (1 << 64) if value >> 63 else value


def at_table(registers: bytes, loop: int, first: int, end: int) -> bytes:
    """Registers that make the calls of a table by a `CALL_LOOP` at an address."""
    return with_registers(registers, pc=loop, x19=first, x20=end)


def stopped_call(registers: bytes) -> int:
    """Address of the call at which `CALL_LOOP` stopped; the end of the table when all went well."""
    return aarch64.decode_registers(registers)["x19"]


_INSTRUCTION_SETS: Final = """
aes asimd asimddp asimdfhm asimdhp asimdrdm atomics bf16 bti crc32 dcpodp dcpop dgh dit fcma flagm flagm2 fp fphp frint hbc
i8mm ilrcpc jscvt lrcpc lse128 lrcpc3 mops mte mte3 paca pacg pmull rng rpres sb sha1 sha2 sha3 sha512 sm3 sm4 sme sme2
ssbs sve sve2 sveaes svebf16 svebitperm svef32mm svef64mm svei8mm svepmull svesha3 svesm4 uscat wfxt
"""
INSTRUCTION_SETS: Final = frozenset(_INSTRUCTION_SETS.split())
"""Names in /proc/cpuinfo that stand for instructions which a program may use. Source: arch/arm64/kernel/cpuinfo.c."""


def program(code: bytes) -> bytes:
    """A static executable that runs ``code`` and nothing else: one segment, no libraries, a stack that cannot execute."""
    header_size, segment_size = 64, 56
    offset = header_size + 2 * segment_size
    size = offset + len(code)
    identity = b"\x7fELF" + bytes([2, 1, 1, 0]) + bytes(8)
    executable, machine = 2, 183
    header = identity + struct.pack(
        "<HHIQQQIHHHHHH", executable, machine, 1, LOAD_ADDRESS + offset, header_size, 0, 0, header_size, segment_size, 2, 64, 0, 0
    )
    load, read_execute = 1, 5
    text = struct.pack("<IIQQQQQQ", load, read_execute, 0, LOAD_ADDRESS, LOAD_ADDRESS, size, size, 1 << 16)
    gnu_stack, read_write = 0x6474E551, 6
    stack = struct.pack("<IIQQQQQQ", gnu_stack, read_write, 0, 0, 0, 0, 0, 16)
    return header + text + stack + code
