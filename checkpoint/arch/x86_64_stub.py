"""x86-64 machine code for a restore: the wait loop of a vessel, and the loop that makes many system calls at once.

Data only, each with its assembly beside it. Sources: System V ABI (AMD64 supplement), elf(5), syscall(2).
"""

from __future__ import annotations

import struct
from typing import Final

from checkpoint.arch import x86_64

LOAD_ADDRESS: Final = 0x400000
"""Where the little programs below are mapped. A restore unmaps them before it maps the snapshot, so any place would do."""

WAIT: Final = bytes.fromhex(
    "b822000000"  # again:  mov  eax, 34        pause(2)
    "0f05"  #               syscall
    "ebf7"  #               jmp  again
)
"""Waits for ever. A vessel runs this until a restorer seizes it."""

WATCH: Final = bytes.fromhex(
    "48b80300000001000000"  #         mov  rax, {fd 3, POLLIN}
    "50"  #                           push rax
    "4889e7"  #               again:  mov  rdi, rsp
    "be01000000"  #                   mov  esi, 1
    "48c7c2ffffffff"  #               mov  rdx, -1
    "b807000000"  #                   mov  eax, 7         poll(2)
    "0f05"  #                         syscall
    "83f801"  #                       cmp  eax, 1
    "75e5"  #                         jne  again
    "31ff"  #                         xor  edi, edi
    "b8e7000000"  #                   mov  eax, 231       exit_group(2)
    "0f05"  #                         syscall
)
"""Waits until descriptor 3 is readable (a pidfd: until its process has ended), then ends with status 0."""

CALL_LOOP: Final = bytes.fromhex(
    "4839eb"  #     next:  cmp  rbx, rbp       rbx: this call, rbp: end of the table
    "7433"  #              je   stop
    "488b03"  #            mov  rax, [rbx]
    "488b7b08"  #          mov  rdi, [rbx+8]
    "488b7310"  #          mov  rsi, [rbx+16]
    "488b5318"  #          mov  rdx, [rbx+24]
    "4c8b5320"  #          mov  r10, [rbx+32]
    "4c8b4328"  #          mov  r8,  [rbx+40]
    "4c8b4b30"  #          mov  r9,  [rbx+48]
    "0f05"  #              syscall
    "48894338"  #          mov  [rbx+56], rax
    "483b4340"  #          cmp  rax, [rbx+64]  least result that is as expected
    "7c0c"  #              jl   stop
    "483b4348"  #          cmp  rax, [rbx+72]  greatest
    "7f06"  #              jg   stop
    "4883c350"  #          add  rbx, 80
    "ebc8"  #              jmp  next
    "cc"  #         stop:  int3
)
"""Makes the calls of a table in order and stops by a breakpoint: at its end, or at the first whose result was not expected.

Needs no stack. Each call is ten little-endian words: number, six arguments, result, least, greatest (signed).
"""

CALL: Final = struct.Struct("<7Q3q")

MAKE_CALL: Final = (
    "488b03"  #            mov  rax, [rbx]
    "488b7b08"  #          mov  rdi, [rbx+8]
    "488b7310"  #          mov  rsi, [rbx+16]
    "488b5318"  #          mov  rdx, [rbx+24]
    "4c8b5320"  #          mov  r10, [rbx+32]
    "4c8b4328"  #          mov  r8,  [rbx+40]
    "4c8b4b30"  #          mov  r9,  [rbx+48]
    "0f05"  #              syscall
    "488b4b38"  #          mov  rcx, [rbx+56]   where the result goes
    "4885c9"  #            test rcx, rcx
    "7403"  #              jz   on
    "488901"  #            mov  [rcx], rax
    "4883c340"  #   on:    add  rbx, 64
)
"""Hexadecimal: the call of the row at rbx is made, its result stored where the row says, and rbx goes to the next row."""

OWN_LOOP: Final = bytes.fromhex(
    "53"  #                push rbx
    "55"  #                push rbp
    "4889fb"  #            mov  rbx, rdi        first argument: this call
    "4889f5"  #            mov  rbp, rsi        second: end of the table
    "4839eb"  #     next:  cmp  rbx, rbp
    "742f"  #              je   done
    f"{MAKE_CALL}"
    "ebcc"  #              jmp  next
    "5d"  #         done:  pop  rbp
    "5b"  #                pop  rbx
    "c3"  #                ret
)
"""A function of C that makes the calls of a table in a process of ours, all of them, also when some fail.

Each call is eight little-endian words: number, six arguments, address where the result goes, 0 for nowhere.
"""

SECOND_LOOP: Final = bytes.fromhex(
    "53"  #                push rbx
    "55"  #                push rbp
    "4154"  #              push r12
    "4155"  #              push r13
    "4989fc"  #            mov  r12, rdi        argument: the board
    "4531ed"  #            xor  r13d, r13d      the last order that was heard
    "418b0424"  #    wait: mov  eax, [r12]      the order
    "4439e8"  #            cmp  eax, r13d
    "7516"  #              jne  heard
    "4c89e7"  #            mov  rdi, r12
    "be80000000"  #        mov  esi, 128        FUTEX_WAIT | FUTEX_PRIVATE_FLAG
    "89c2"  #              mov  edx, eax
    "4531d2"  #            xor  r10d, r10d      no timeout
    "b8ca000000"  #        mov  eax, 202        futex(2)
    "0f05"  #              syscall
    "ebe1"  #              jmp  wait
    "4189c5"  #     heard: mov  r13d, eax
    "83f8ff"  #            cmp  eax, -1
    "7457"  #              je   over
    "a901000000"  #        test eax, 1
    "7449"  #              jz   rest            an even one: to rest
    "498b5c2410"  #        mov  rbx, [r12+16]   first row
    "498b6c2418"  #        mov  rbp, [r12+24]   end of the rows
    "49895c2420"  #  next: mov  [r12+32], rbx   done so far
    "4839eb"  #            cmp  rbx, rbp
    "7435"  #              je   rest
    "45392c24"  #          cmp  [r12], r13d
    "752f"  #              jne  rest            there is another order
    f"{MAKE_CALL}"
    "ebc1"  #              jmp  next
    "4d896c2408"  #  rest: mov  [r12+8], r13    done with that order
    "eb82"  #              jmp  wait
    "415d"  #       over:  pop  r13
    "415c"  #              pop  r12
    "5d"  #                pop  rbp
    "5b"  #                pop  rbx
    "c3"  #                ret
)
"""A function of C that makes the calls of tables like those of `OWN_LOOP`, one table after the other, as it is told to.

It is told by a board of five words: the order (32 bits: odd, make the calls; even, rest; -1, return), the last one that it is
done with, the first row and the end of the rows, and the first row that is not made yet. Between two orders it sleeps (futex(2)).
A processor that does not show others its stores in their order needs barriers before the stores to the second and the last word.
"""

SYSTEM_CALLS: Final = {
    "accept4": 288,
    "arch_prctl": 158,
    "bind": 49,
    "capset": 126,
    "chdir": 80,
    "chroot": 161,
    "clone3": 435,
    "close": 3,
    "connect": 42,
    "dup3": 292,
    "epoll_create1": 291,
    "epoll_ctl": 233,
    "eventfd2": 290,
    "execve": 59,
    "exit": 60,
    "exit_group": 231,
    "fallocate": 285,
    "fchmod": 91,
    "fchmodat": 268,
    "fchdir": 81,
    "fchown": 93,
    "fchownat": 260,
    "fcntl": 72,
    "flock": 73,
    "fstat": 5,
    "ftruncate": 77,
    "futex": 202,
    "getdents64": 217,
    "getpeername": 52,
    "get_robust_list": 274,
    "getpid": 39,
    "getpriority": 140,
    "getsockname": 51,
    "getsockopt": 55,
    "inotify_add_watch": 254,
    "inotify_init1": 294,
    "inotify_rm_watch": 255,
    "io_destroy": 207,
    "io_getevents": 208,
    "io_setup": 206,
    "io_submit": 209,
    "ioctl": 16,
    "ioprio_get": 252,
    "ioprio_set": 251,
    "kcmp": 312,
    "linkat": 265,
    "kill": 62,
    "listen": 50,
    "lseek": 8,
    "madvise": 28,
    "memfd_create": 319,
    "membarrier": 324,
    "mkdirat": 258,
    "mknodat": 259,
    "mlock2": 325,
    "mlockall": 151,
    "mmap": 9,
    "mprotect": 10,
    "mremap": 25,
    "mseal": 462,
    "munmap": 11,
    "newfstatat": 262,
    "open_by_handle_at": 304,
    "openat": 257,
    "personality": 135,
    "pidfd_getfd": 438,
    "pidfd_open": 434,
    "pipe2": 293,
    "pkey_alloc": 330,
    "pkey_free": 331,
    "pkey_mprotect": 329,
    "ppoll": 271,
    "prctl": 157,
    "pread64": 17,
    "prlimit64": 302,
    "process_vm_readv": 310,
    "process_vm_writev": 311,
    "ptrace": 101,
    "pwrite64": 18,
    "read": 0,
    "readlinkat": 267,
    "recvfrom": 45,
    "rseq": 334,
    "rt_sigaction": 13,
    "rt_sigqueueinfo": 129,
    "rt_tgsigqueueinfo": 297,
    "sched_getaffinity": 204,
    "sched_getparam": 143,
    "sched_getscheduler": 145,
    "sched_getattr": 315,
    "sched_setaffinity": 203,
    "sched_setattr": 314,
    "sched_setscheduler": 144,
    "seccomp": 317,
    "sendmsg": 46,
    "sendto": 44,
    "set_robust_list": 273,
    "set_tid_address": 218,
    "setfsgid": 123,
    "setfsuid": 122,
    "setgroups": 116,
    "setitimer": 38,
    "setpgid": 109,
    "setpriority": 141,
    "setresgid": 119,
    "setresuid": 117,
    "setsid": 112,
    "setsockopt": 54,
    "setxattr": 188,
    "shmat": 30,
    "shutdown": 48,
    "sigaltstack": 131,
    "signalfd4": 289,
    "socket": 41,
    "socketpair": 53,
    "symlinkat": 266,
    "timer_create": 222,
    "timer_delete": 226,
    "timer_settime": 223,
    "timerfd_create": 283,
    "timerfd_settime": 286,
    "umask": 95,
    "unlinkat": 263,
    "unshare": 272,
    "utimensat": 280,
    "wait4": 61,
    "waitid": 247,
    "write": 1,
}
"""Numbers of the system calls that a restore makes inside a vessel, and of those of `OWN_LOOP` (asm/unistd_64.h)."""


EPOLL_EVENT: Final = struct.Struct("<IQ")
"""struct epoll_event, which is packed on x86-64."""
VDSO_CALLS: Final = {
    "__vdso_clock_gettime": 228,
    "__vdso_gettimeofday": 96,
    "__vdso_time": 201,
    "__vdso_clock_getres": 229,
    "__vdso_getcpu": 309,
}
"""Functions of the vdso that can be had from any other, each with the system call that does the same. Not among them is
__vdso_getrandom: what a program keeps for it has another form with each kernel, and without the kernel's data it makes the
system call by itself. Source: vdso(7); lib/vdso/getrandom.c.
"""


def jump_to(address: int) -> bytes:
    """``notrack jmp [rip+0]`` and where to: 15 bytes that go on at any address, all registers as they are."""
    return b"\x3e\xff\x25" + bytes(4) + struct.pack("<Q", address)


def call_and_return(number: int) -> bytes:
    """``mov eax, number; syscall; ret``: a function that is a system call."""
    return b"\xb8" + struct.pack("<I", number) + x86_64.SYSCALL + b"\xc3"


def with_registers(registers: bytes, **values: int) -> bytes:
    """A copy of NT_PRSTATUS with some registers changed; the thread is not in a system call any more."""
    return x86_64.encode_registers(x86_64.decode_registers(registers) | {x86_64.CALL_NUMBER: x86_64.NO_CALL, **values})


ERESTARTSYS: Final = -512
ALWAYS_INTERRUPTED: Final = frozenset(
    ("pause", "rt_sigsuspend", "select", "pselect6", "ppoll", *x86_64.RESTART_BLOCK_USERS, *x86_64.ENDED_BY_A_STOP)
)
"""Calls that return EINTR after any signal handler; the others are made again after one with SA_RESTART. Source: signal(7)."""


def in_interrupted_call(registers: bytes, interrupted: str) -> bytes:
    """Registers that go on as a snapshot's do, unless a signal handler comes first: then an interrupted call returns EINTR.

    Args:
        registers: set to make the interrupted call again.
        interrupted: that call's name; "" when there is none.
    """
    if not interrupted:
        return with_registers(registers)
    values = x86_64.decode_registers(registers)
    result = x86_64.ERESTARTNOHAND if interrupted in ALWAYS_INTERRUPTED else ERESTARTSYS
    after = values["rip"] + len(x86_64.SYSCALL)
    return with_registers(registers, rip=after, rax=result, orig_rax=values["rax"])


def at_call(registers: bytes, instruction: int, number: int, arguments: tuple[int, ...]) -> bytes:
    """Registers that make one system call with the syscall instruction at an address."""
    return with_registers(registers, rip=instruction, rax=number, **dict(zip(x86_64.ARGUMENTS, arguments, strict=False)))


def call_result(registers: bytes) -> int:
    """The result of a system call: a negative error number, or its value."""
    value = x86_64.decode_registers(registers)[x86_64.RESULT]
    return value - (1 << 64) if value >> 63 else value


def at_table(registers: bytes, loop: int, first: int, end: int) -> bytes:
    """Registers that make the calls of a table by a `CALL_LOOP` at an address."""
    return with_registers(registers, rip=loop, rbx=first, rbp=end)


def stopped_call(registers: bytes) -> int:
    """Address of the call at which `CALL_LOOP` stopped; the end of the table when all went well."""
    return x86_64.decode_registers(registers)["rbx"]


_INSTRUCTION_SETS: Final = """
abm adx aes amx_bf16 amx_fp16 amx_int8 amx_tile avx avx2 avx512_4fmaps avx512_4vnniw avx512_bf16 avx512_bitalg
avx512_fp16 avx512_vbmi2 avx512_vnni avx512_vp2intersect avx512_vpopcntdq avx512bw avx512cd avx512dq avx512er avx512f
avx512ifma avx512pf avx512vbmi avx512vl avx_vnni bmi1 bmi2 clflushopt clwb clzero cmov cx16 cx8 enqcmd erms f16c fma
fma4 fsgsbase fsrm gfni hle lahf_lm lwp movbe movdir64b movdiri mmx pclmulqdq pku popcnt prefetchw rdpid rdrand rdseed
rdtscp rtm serialize sha_ni sse sse2 sse4_1 sse4_2 sse4a ssse3 tbm user_shstk vaes vpclmulqdq waitpkg xop xsave xsavec
xsaveopt
"""
INSTRUCTION_SETS: Final = frozenset(_INSTRUCTION_SETS.split())
"""Flags of /proc/cpuinfo that stand for instructions which a program may use. Source: arch/x86/include/asm/cpufeatures.h."""


def program(code: bytes) -> bytes:
    """A static executable that runs ``code`` and nothing else: one segment, no libraries, a stack that cannot execute."""
    header_size, segment_size = 64, 56
    offset = header_size + 2 * segment_size
    size = offset + len(code)
    identity = b"\x7fELF" + bytes([2, 1, 1, 0]) + bytes(8)
    executable, x86_64 = 2, 62
    header = identity + struct.pack(
        "<HHIQQQIHHHHHH", executable, x86_64, 1, LOAD_ADDRESS + offset, header_size, 0, 0, header_size, segment_size, 2, 64, 0, 0
    )
    load, read_execute = 1, 5
    text = struct.pack("<IIQQQQQQ", load, read_execute, 0, LOAD_ADDRESS, LOAD_ADDRESS, size, size, 4096)
    gnu_stack, read_write = 0x6474E551, 6
    stack = struct.pack("<IIQQQQQQ", gnu_stack, read_write, 0, 0, 0, 0, 0, 16)
    return header + text + stack + code
