"""x86-64 as data: registers, system call numbers, and the machine code for the borrowed pages.

Sections: registers · system calls · interrupted system calls · code of a borrowed page. A second processor is a second file with
the same names in the same order, see `checkpoint.arch`.

Sources: struct user_regs_struct of sys/user.h; arch/x86/entry/syscalls/syscall_64.tbl; Intel SDM volume 2.
"""

from __future__ import annotations

import errno
import operator
import struct
from collections.abc import Mapping, Sequence
from typing import Final

from checkpoint.arch.calls import MILLISECONDS, SOCKET, TIMESPEC, Call, EntryCalls, Registers, TablePlaces, Timeout, Unkept

NAME: Final = "x86_64"
AUDIT_ARCHITECTURE: Final = 0xC000003E
"""AUDIT_ARCH_X86_64 of linux/audit.h, which filters of seccomp(2) look at."""
FEATURES_LINE: Final = "flags"
"""How the line of /proc/cpuinfo begins that names what the processor has."""
WRITE_PROTECTION_SINCE: Final = "6.7"
"""The first Linux that tells of it what was written (PAGEMAP_SCAN, userfaultfd's write protection)."""

# Registers

REGISTER_NAMES: Final = (
    *("r15", "r14", "r13", "r12", "rbp", "rbx", "r11", "r10", "r9", "r8", "rax", "rcx", "rdx", "rsi", "rdi"),
    *("orig_rax", "rip", "cs", "eflags", "rsp", "ss", "fs_base", "gs_base", "ds", "es", "fs", "gs"),
)
"""Order of NT_PRSTATUS: 64-bit words, little-endian."""
_in_order: Final = operator.itemgetter(*REGISTER_NAMES)
_REGISTERS: Final = struct.Struct(f"<{len(REGISTER_NAMES)}Q")
REGISTERS_SIZE: Final = _REGISTERS.size


def words_of(content: bytes) -> tuple[int, ...]:
    """Read NT_PRSTATUS: its words, unsigned, in the order of `REGISTER_NAMES`."""
    return _REGISTERS.unpack(content)


def decode_registers(content: bytes) -> Registers:
    """Read NT_PRSTATUS."""
    return dict(zip(REGISTER_NAMES, _REGISTERS.unpack(content), strict=True))


def encode_registers(registers: Mapping[str, int]) -> bytes:
    """Write NT_PRSTATUS."""
    try:
        return _REGISTERS.pack(*_in_order(registers))
    except struct.error:  # a negative one
        return _REGISTERS.pack(*(registers[name] & _WORD for name in REGISTER_NAMES))


_STAND: Final = struct.Struct("<80xq32xqQ")


def stand_of(content: bytes) -> tuple[int, int, int]:
    """Read NT_PRSTATUS, for many threads in little time: (instruction pointer, result, call number); the last two are signed."""
    result, number, pointer = _STAND.unpack_from(content)
    return pointer, result, number


_WORD: Final = (1 << 64) - 1
INSTRUCTION_POINTER: Final = "rip"
STACK_POINTER: Final = "rsp"
RESULT: Final = "rax"
CALL_NUMBER: Final = "orig_rax"
"""Number of the system call that the thread stands in; -1 outside of one."""
NO_CALL: Final = _WORD
"""As `CALL_NUMBER`, unsigned: the thread is not in a system call, so the kernel has none to restart."""
OUTSIDE_OF_CALLS: Final = ((REGISTER_NAMES.index(CALL_NUMBER), NO_CALL),)
"""Words of NT_PRSTATUS, by place, that say that the thread is in no call."""
STEPPING: Final = ((REGISTER_NAMES.index("eflags"), 1 << 8),)
"""Words of NT_PRSTATUS, by place, and the bit of each by which a program steps through itself: the trap flag."""
LOST_IN_A_CALL: Final = ("rcx", "r11")
"""Registers that every system call changes, besides its result. Source: psABI, A.2.1."""
ARGUMENTS: Final = ("rdi", "rsi", "rdx", "r10", "r8", "r9")
ENDED_ARGUMENTS: Final = ARGUMENTS
"""Where the arguments of a call are that has ended."""

# System calls

SYSCALL: Final = b"\x0f\x05"


def call_in(code: bytes) -> int:
    """Offset of the first instruction in a piece of code that makes a system call; -1: there is none."""
    return code.find(SYSCALL)


SYSCALLS: Final[Mapping[str, int]] = {
    "read": 0, "write": 1, "open": 2, "close": 3, "poll": 7, "mmap": 9, "mprotect": 10, "munmap": 11, "brk": 12,
    "rt_sigaction": 13, "rt_sigprocmask": 14, "readv": 19, "writev": 20, "select": 23, "madvise": 28, "pause": 34,
    "nanosleep": 35, "getitimer": 36, "getpid": 39, "accept": 43, "sendto": 44, "recvfrom": 45, "sendmsg": 46,
    "recvmsg": 47, "semop": 65, "sigaltstack": 131, "rt_sigtimedwait": 128, "rt_sigsuspend": 130, "prctl": 157,
    "futex": 202, "io_getevents": 208, "restart_syscall": 219, "semtimedop": 220, "timer_gettime": 224,
    "timer_getoverrun": 225, "clock_gettime": 228, "clock_nanosleep": 230, "epoll_wait": 232, "waitid": 247,
    "pselect6": 270, "ppoll": 271, "get_robust_list": 274, "epoll_pwait": 281, "accept4": 288, "userfaultfd": 323,
    "membarrier": 324, "modify_ldt": 154, "arch_prctl": 158, "io_uring_enter": 426, "epoll_pwait2": 441, "futex_waitv": 449,
}  # fmt: skip
"""Numbers by name: those that we make or tell of."""
SYSCALL_NAMES: Final[Mapping[int, str]] = {number: name for name, number in SYSCALLS.items()}

ARCH_GET_CPUID: Final = 0x1011
UNKEPT_OUTPUT_SIZE: Final = 16


def unkept(output: int) -> tuple[Unkept, ...]:
    """The switches of this processor that a process may have set for itself, and no restore gives back.

    Args:
        output: address of `UNKEPT_OUTPUT_SIZE` bytes that the calls may write to.

    Source: modify_ldt(2), arch_prctl(2).
    """
    return (
        Unkept(Call("modify_ldt", (0, output, UNKEPT_OUTPUT_SIZE)), 0, "segments of its own (modify_ldt)"),
        Unkept(Call("arch_prctl", (ARCH_GET_CPUID, 0)), 1, "the cpuid instruction switched off (ARCH_SET_CPUID)"),
    )


PORT_RIGHTS: Final[int | None] = 0x201
"""NT_386_IOPERM of linux/elf.h: only a thread that may use I/O ports has this register set."""


def user_end(highest: int) -> int:
    """The first address that a program cannot have (47-bit addresses, one guard page).

    Args:
        highest: the end of a program's highest mapping.
    """
    return 0x7FFF_FFFF_E000


# Interrupted system calls

RESTARTABLE: Final = frozenset((-512, -513, -514))
"""ERESTARTSYS, ERESTARTNOINTR, ERESTARTNOHAND: what a stopped call returns when it is simply to be made again."""
RESTART_BLOCK: Final = -516
"""ERESTART_RESTARTBLOCK: to be gone on with by restart_syscall(2), from what the kernel remembers."""
REMAINING_TIME: Final[Mapping[str, tuple[int, int]]] = {"nanosleep": (0, 1), "clock_nanosleep": (2, 3)}
"""Which argument points to the time asked for, and which to where the kernel has written what remains of it."""
ERESTARTNOHAND: Final = -514
"""A stopped call returns this when it shall be made again, unless a signal handler comes first: that makes it EINTR."""
FORGETS_CALLS: Final = False
"""Whether the registers of a stop inside a call do not say that it is one: see `checkpoint.linux.trace.syscall_reentry`."""

_RECEIVING: Final = Timeout(0, SOCKET, -errno.EAGAIN, 20)
_SENDING: Final = Timeout(0, SOCKET, -errno.EAGAIN, 21)
ENDED_BY_A_STOP: Final[Mapping[str, Timeout | None]] = {
    "semop": None,
    "rt_sigtimedwait": Timeout(2, TIMESPEC, -errno.EAGAIN),
    "semtimedop": Timeout(3, TIMESPEC, -errno.EAGAIN),
    "io_getevents": Timeout(4, TIMESPEC, 0),
    "epoll_wait": Timeout(3, MILLISECONDS, 0),
    "epoll_pwait": Timeout(3, MILLISECONDS, 0),
    "epoll_pwait2": Timeout(3, TIMESPEC, 0),
}
"""Calls that return EINTR merely because of a stop, and their timeouts. Source: signal(7); io_getevents() in fs/aio.c."""
SOCKET_TIMEOUT: Final[Mapping[str, Timeout]] = {
    **dict.fromkeys(("read", "readv", "recvfrom", "recvmsg", "accept", "accept4"), _RECEIVING),
    **dict.fromkeys(("write", "writev", "sendto", "sendmsg"), _SENDING),
}
"""Calls that do so only at a socket that has a timeout. connect(2) is not made again: it would answer EALREADY."""
CALL_NUMBER_BITS: Final = 32
"""Newer kernels look at the lower half of the register with a call's number only, and keep both in `CALL_NUMBER`: the upper one
can hold a mark by which a call is known again, until its result takes that place. 0: marks lie elsewhere."""
MARK_LIMIT: Final = 1 << 31
"""Marks are smaller: the highest bit says that the thread is in no call."""
NUMBER: Final = "rax"
"""Where a program puts the number of a call."""
CALL_SET: Final[int | None] = None
"""The register set that tells the number of a call: there is none, the general registers do."""


def call_number(registers: Mapping[str, int]) -> int:
    """The number of the system call that a thread stands in, without a mark; -1 outside of one."""
    word = registers[CALL_NUMBER]
    return -1 if word >> 63 else word & ((1 << CALL_NUMBER_BITS) - 1)


def mark_of(registers: Mapping[str, int]) -> int:
    """The mark of the system call that a thread stands in, 0 if it has none."""
    return registers[CALL_NUMBER] >> CALL_NUMBER_BITS


def marked(number: int, mark: int) -> int:
    """A call's number with a mark."""
    return mark << CALL_NUMBER_BITS | number


def has_room_for_mark(registers: Mapping[str, int]) -> bool:
    """Whether the call that a thread stands in has room for a mark, where any has."""
    return True


def recalled(registers: Registers, number: int, first_argument: int) -> Registers:
    """The registers of a thread in which a call has just ended, with what they do not say: they say all of it."""
    return registers


def made_again(registers: Registers, mark: int) -> Registers:
    """Have the kernel make a call again as soon as the program runs, unless a signal handler comes first."""
    return {**registers, RESULT: ERESTARTNOHAND, CALL_NUMBER: marked(call_number(registers), mark)}


RESTART_BLOCK_USERS: Final = ("clock_nanosleep", "nanosleep", "poll", "futex")


def may_go_on(registers: Mapping[str, int]) -> bool:
    """Whether a call may be one that the kernel remembers the end of without saying so: it says so, by `RESTART_BLOCK`."""
    return False


def call_number_before(code: bytes) -> int | None:
    """Find the system call number that the instructions before a ``syscall`` have loaded.

    Args:
        code: the bytes that end with the ``syscall`` instruction.

    Returns:
        The immediate of the last ``mov eax, imm32``, if there is one.
    """
    place = code.rfind(b"\xb8", 0, len(code) - len(SYSCALL) - 4)
    return None if place < 0 else int(struct.unpack_from("<I", code, place + 1)[0])


# Code of a borrowed page (see `checkpoint.linux.trace.remote_syscalls`)

_MOVE_IMMEDIATE: Final = {"rax": 0, "rcx": 1, "rdx": 2, "rbx": 3, "rsp": 4, "rbp": 5, "rsi": 6, "rdi": 7} | {
    f"r{number}": number for number in range(8, 16)
}
"""Register numbers of the instruction encoding; 8 and above need a REX bit."""
CLOBBERED: Final = ("rax", "rdi", "rsi", "rdx", "r10", "r8", "r9", "rcx", "r11")
"""Registers that the calls change: we give them back, in this order in the table."""
LARGE_DESK_SIZE: Final = 16384
SMALL_DESK_SIZE: Final = 512
"""Bytes of a desk's code, and of its table without the frame: for 200 of the longest calls, and for four."""


def frame_size(lost: int) -> int:
    """Bytes at the end of a desk's table that its code needs for itself: none.

    Args:
        lost: bytes of the register set of `extended.LOST_IN_CALLS`; 0: there is none.
    """
    return 0


def frame_of_lost(frame: int, lost: bytes) -> tuple[int, bytes]:
    """Where in a frame it stands what a thread has lost in our calls, and that as it stands there: nowhere, and nothing."""
    return frame, b""


class _Code:
    """Straight-line machine code that is put together for one address; no instruction in it changes a flag or the stack."""

    def __init__(self, address: int) -> None:
        self._address = address
        self.content = bytearray()

    def set(self, register: str, value: int) -> None:
        """``mov register, value``."""
        number = _MOVE_IMMEDIATE[register]
        value &= _WORD
        if value >> 32:
            self.content += bytes((0x48 | number >> 3, 0xB8 + (number & 7))) + struct.pack("<Q", value)
        else:
            self.content += (b"\x41" if number > 7 else b"") + bytes((0xB8 + (number & 7),)) + struct.pack("<I", value)

    def load(self, register: str, address: int) -> None:
        """``mov register, [rip + …]``."""
        self._relative(0x8B, register, address)

    def store(self, register: str, address: int) -> None:
        """``mov [rip + …], register``."""
        self._relative(0x89, register, address)

    def store_value(self, value: int, address: int) -> None:
        """``mov qword [rip + …], value``."""
        displacement = address - (self._address + len(self.content) + 11)
        self.content += b"\x48\xc7\x05" + struct.pack("<ii", displacement, value)

    def move(self, target: str, source: str) -> None:
        """``mov target, source``."""
        high, low = _MOVE_IMMEDIATE[source], _MOVE_IMMEDIATE[target]
        self.content += bytes((0x48 | (high >> 3) << 2 | low >> 3, 0x89, 0xC0 | (high & 7) << 3 | low & 7))

    def call(self, number: int, arguments: Sequence[int]) -> None:
        """Make a system call."""
        for register, value in zip(ARGUMENTS, arguments, strict=False):
            self.set(register, value)
        self.set("rax", number)
        self.content += SYSCALL

    def jump_through(self, address: int) -> None:
        """``notrack jmp [rip + …]``: allowed where indirect branches are tracked."""
        displacement = address - (self._address + len(self.content) + 7)
        self.content += b"\x3e\xff\x25" + struct.pack("<i", displacement)

    def _relative(self, opcode: int, register: str, address: int) -> None:
        number = _MOVE_IMMEDIATE[register]
        displacement = address - (self._address + len(self.content) + 7)
        self.content += bytes((0x48 | (number >> 3) << 2, opcode, (number & 7) << 3 | 5)) + struct.pack("<i", displacement)


SHOWS_STORES_IN_ORDER: Final = True
"""Whether a reader that sees a thread's last store also sees its earlier ones, without a second look."""


def batch_code(address: int, calls: Sequence[Call], places: TablePlaces) -> bytes:
    """The batch: make every call once, then wait for the tracer; if it does not come, give everything back and go on.

    Args:
        address: where it will lie.
    """
    code = _Code(address)
    for index, call in enumerate(calls):
        code.call(SYSCALLS[call.name], call.arguments)
        code.store("rax", places.results + 8 * index)
    code.load("rax", places.serial)
    code.store("rax", places.done)
    code.call(SYSCALLS["rt_sigtimedwait"], (places.empty_set, 0, places.timeout, 8))
    code.call(SYSCALLS["rt_sigprocmask"], (2, places.mask, 0, 8))
    code.store_value(places.ended, places.state)
    for index, register in enumerate(CLOBBERED):
        code.load(register, places.registers + 8 * index)
    code.jump_through(places.resume)
    return bytes(code.content)


ENTRY_REGISTERS: Final = ("r12", "r13", "r14")
"""Where the entry keeps its results, and gives them back: the code pages, the table pages, the userfaultfd."""


def entry_code(
    address: int,
    calls: EntryCalls,
    registers: Registers,
    mask: int,
    patience_ns: int,
    vectors: bytes = b"",
    lost: bytes = b"",
) -> bytes:
    """The first entry, for a place where nothing of ours is mapped yet: constants only, nothing stored.

    It waits with three results in `ENTRY_REGISTERS`, where a tracer sees them. If none comes it closes the descriptor, gives
    everything back and goes on.

    Args:
        registers: what the program goes on with; ``rip`` is where.
        mask: the program's signal mask.
        patience_ns: how long it waits for the tracer.
        vectors, lost: unused: nothing here changes them.
    """
    code = _Code(address + ENTRY_CODE_OFFSET)
    code.call(SYSCALLS[calls.code_pages.name], calls.code_pages.arguments)
    code.move("r12", "rax")
    code.call(SYSCALLS[calls.table_pages.name], calls.table_pages.arguments)
    code.move("r13", "rax")
    code.call(SYSCALLS[calls.advice.name], calls.advice.arguments)
    code.call(SYSCALLS[calls.faults.name], calls.faults.arguments)
    code.move("r14", "rax")
    code.call(SYSCALLS["rt_sigtimedwait"], (address + 16, 0, address, 8))
    code.move("rdi", "r14")
    code.set("rax", SYSCALLS["close"])
    code.content += SYSCALL
    code.call(SYSCALLS["rt_sigprocmask"], (2, address + 24, 0, 8))
    for register in (*ENTRY_REGISTERS, *CLOBBERED):
        code.set(register, registers[register])
    code.jump_through(address + 32)
    return struct.pack("<QQQQQ", *divmod(patience_ns, 10**9), 0, mask, registers["rip"]) + bytes(code.content)


ENTRY_CODE_OFFSET: Final = 40
"""Where the instructions of `entry_code` begin, after its constants."""
ENTRY_TIMEOUT_NS: Final = 100_000_000
"""How long a program whose tracer died waits before it goes on by itself."""
