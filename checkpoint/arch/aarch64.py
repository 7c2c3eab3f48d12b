"""aarch64 as data: registers, system call numbers, and the machine code for the borrowed pages.

The sections are those of `checkpoint.arch.x86_64`; see `checkpoint.arch`. Two things differ in kind:

* A stop inside a system call does not show the call. Before a tracer sees the registers, the kernel has set the program counter
  back to the ``svc``, restored the first argument in x0 (do_signal() in arch/arm64/kernel/signal.c), and forgotten the number of
  the call. So a thread is never reported as inside a call: a thread that resumes from its registers makes the call again.
* No instruction jumps through memory without a register. Code that must restore all registers by itself uses rt_sigreturn(2) with
  a frame of its own.

Sources: struct user_pt_regs of asm/ptrace.h; asm-generic/unistd.h; asm/sigcontext.h; Arm Architecture Reference Manual, C6.
"""

from __future__ import annotations

import errno
import operator
import struct
from collections.abc import Mapping, Sequence
from typing import Final

from checkpoint.arch.aarch64_xstate import scalable_registers
from checkpoint.arch.calls import SOCKET, TIMESPEC, Call, EntryCalls, Registers, TablePlaces, Timeout, Unkept

NAME: Final = "aarch64"
AUDIT_ARCHITECTURE: Final = 0xC00000B7
"""AUDIT_ARCH_AARCH64 of linux/audit.h, which filters of seccomp(2) look at."""
FEATURES_LINE: Final = "Features"
"""How the line of /proc/cpuinfo begins that names what the processor has."""
WRITE_PROTECTION_SINCE: Final = "6.10"
"""The first Linux that tells of it what was written (PAGEMAP_SCAN, userfaultfd's write protection)."""

# Registers

_GENERAL: Final = tuple(f"x{number}" for number in range(31))
REGISTER_NAMES: Final = (*_GENERAL, "sp", "pc", "pstate")
"""Order of NT_PRSTATUS: 64-bit words, little-endian."""
_in_order: Final = operator.itemgetter(*REGISTER_NAMES)
_REGISTERS: Final = struct.Struct(f"<{len(REGISTER_NAMES)}Q")
REGISTERS_SIZE: Final = _REGISTERS.size


def words_of(content: bytes) -> tuple[int, ...]:
    """Read NT_PRSTATUS: its words, unsigned, in the order of `REGISTER_NAMES`."""
    return _REGISTERS.unpack(content)


def decode_registers(content: bytes) -> Registers:
    """Read NT_PRSTATUS."""
    return {**dict(zip(REGISTER_NAMES, _REGISTERS.unpack(content), strict=True)), CALL_NUMBER: NO_CALL}


def encode_registers(registers: Mapping[str, int]) -> bytes:
    """Write NT_PRSTATUS."""
    try:
        return _REGISTERS.pack(*_in_order(registers))
    except struct.error:  # a negative one
        return _REGISTERS.pack(*(registers[name] & _WORD for name in REGISTER_NAMES))


_STAND: Final = struct.Struct("<q248xQ")


def stand_of(content: bytes) -> tuple[int, int, int]:
    """Read NT_PRSTATUS, for many threads in little time: (instruction pointer, result, call number); the last is -1 always."""
    result, pointer = _STAND.unpack_from(content)
    return pointer, result, -1


_WORD: Final = (1 << 64) - 1
INSTRUCTION_POINTER: Final = "pc"
STACK_POINTER: Final = "sp"
RESULT: Final = "x0"
CALL_NUMBER: Final = "call"
"""Not a register: a thread is never told as standing in a call."""
NO_CALL: Final = _WORD
"""As `CALL_NUMBER`, unsigned."""
OUTSIDE_OF_CALLS: Final[tuple[tuple[int, int], ...]] = ()
"""Words of NT_PRSTATUS, by place, that say that the thread is in no call: there is none."""
STEPPING: Final[tuple[tuple[int, int], ...]] = ()
"""No program steps through itself: only the kernel can set that bit."""
LOST_IN_A_CALL: Final = ("mark",)
"""Registers that every system call changes, besides its result: none; the mark is no register, see `recalled`."""
ARGUMENTS: Final = ("x0", "x1", "x2", "x3", "x4", "x5")
ENDED_ARGUMENTS: Final = ("first", *ARGUMENTS[1:])
"""Where the arguments of a call are that has ended: a result has taken the place of the first one, see `recalled`."""

# System calls

SYSCALL: Final = b"\x01\x00\x00\xd4"
"""``svc #0``."""


def call_in(code: bytes) -> int:
    """Offset of the first instruction in a piece of code that makes a system call; -1: there is none.

    Args:
        code: begins with a whole instruction.
    """
    place = code.find(SYSCALL)
    while place % len(SYSCALL) and place > 0:
        place = code.find(SYSCALL, place + 1)
    return place


SYSCALLS: Final[Mapping[str, int]] = {
    "read": 63, "write": 64, "close": 57, "mmap": 222, "mprotect": 226, "munmap": 215, "brk": 214, "rt_sigaction": 134,
    "rt_sigprocmask": 135, "readv": 65, "writev": 66, "madvise": 233, "nanosleep": 101, "getitimer": 102, "getpid": 172,
    "accept": 202, "sendto": 206, "recvfrom": 207, "sendmsg": 211, "recvmsg": 212, "semop": 193, "sigaltstack": 132,
    "rt_sigtimedwait": 137, "rt_sigsuspend": 133, "rt_sigreturn": 139, "prctl": 167, "futex": 98, "io_getevents": 4,
    "restart_syscall": 128, "semtimedop": 192, "timer_gettime": 108, "timer_getoverrun": 109, "clock_gettime": 113,
    "clock_nanosleep": 115, "waitid": 95, "pselect6": 72, "ppoll": 73, "get_robust_list": 100, "epoll_pwait": 22,
    "accept4": 242, "userfaultfd": 282, "membarrier": 283, "io_uring_enter": 426, "epoll_pwait2": 441, "futex_waitv": 449,
}  # fmt: skip
"""Numbers by name: those that we make or tell of."""
SYSCALL_NAMES: Final[Mapping[int, str]] = {number: name for name, number in SYSCALLS.items()}
UNKEPT_OUTPUT_SIZE: Final = 16


def unkept(output: int) -> tuple[Unkept, ...]:
    """The switches of this processor that a process may have set for itself, and no restore gives back.

    Args:
        output: address of `UNKEPT_OUTPUT_SIZE` bytes that the calls may write to.

    Source: PR_GET_TAGGED_ADDR_CTRL(2const).
    """
    return (Unkept(Call("prctl", (_PR_GET_TAGGED_ADDR_CTRL, 0, 0, 0, 0)), 0, "tagged addresses (PR_SET_TAGGED_ADDR_CTRL)"),)


_PR_GET_TAGGED_ADDR_CTRL: Final = 56
PORT_RIGHTS: Final[int | None] = None
"""There are no I/O ports."""


def user_end(highest: int) -> int:
    """The first address that a program cannot have: the stack lies below it, so it follows from where mappings end.

    Args:
        highest: the end of a program's highest mapping.

    Source: Documentation/arch/arm64/memory.rst: 39, 42, 47, 48 or 52 bits, as the kernel was built.
    """
    return 1 << max(highest - 1, 0).bit_length()


# Interrupted system calls

RESTARTABLE: Final = frozenset((-512, -513, -514))
"""ERESTARTSYS, ERESTARTNOINTR, ERESTARTNOHAND: never seen here, see above."""
RESTART_BLOCK: Final = -516
"""ERESTART_RESTARTBLOCK: never seen here."""
REMAINING_TIME: Final[Mapping[str, tuple[int, int]]] = {"nanosleep": (0, 1), "clock_nanosleep": (2, 3)}
"""Which argument points to the time asked for, and which to where the kernel has written what remains of it."""
ERESTARTNOHAND: Final = -514
"""A stopped call returns this when it shall be made again, unless a signal handler comes first: that makes it EINTR."""
FORGETS_CALLS: Final = True
"""Whether the registers of a stop inside a call do not say that it is one: see `checkpoint.linux.trace.syscall_reentry`."""

_RECEIVING: Final = Timeout(0, SOCKET, -errno.EAGAIN, 20)
_SENDING: Final = Timeout(0, SOCKET, -errno.EAGAIN, 21)
ENDED_BY_A_STOP: Final[Mapping[str, Timeout | None]] = {
    "semop": None,
    "rt_sigtimedwait": Timeout(2, TIMESPEC, -errno.EAGAIN),
    "semtimedop": Timeout(3, TIMESPEC, -errno.EAGAIN),
    "io_getevents": Timeout(4, TIMESPEC, 0),
    "epoll_pwait": Timeout(3, "ms", 0),
    "epoll_pwait2": Timeout(3, TIMESPEC, 0),
}
"""Calls that return EINTR merely because of a stop, and their timeouts. Source: signal(7); io_getevents() in fs/aio.c."""
SOCKET_TIMEOUT: Final[Mapping[str, Timeout]] = {
    **dict.fromkeys(("read", "readv", "recvfrom", "recvmsg", "accept", "accept4"), _RECEIVING),
    **dict.fromkeys(("write", "writev", "sendto", "sendmsg"), _SENDING),
}
"""Calls that do so only at a socket that has a timeout. connect(2) is not made again: it would answer EALREADY."""
CALL_NUMBER_BITS: Final = 0
"""Marks by which a call is known again lie in the upper half of its first argument, where that is a number of 32 bits: the kernel
takes the lower half, and the call's result takes the place of both (`has_room_for_mark`)."""
MARK_LIMIT: Final = 1 << 31
"""Marks are smaller."""
_BEGIN_WITH_A_POINTER: Final = ("rt_sigtimedwait", "io_getevents")
NUMBER: Final = "x8"
"""Where a program puts the number of a call, which stays there."""
CALL_SET: Final[int | None] = 0x404
"""NT_ARM_SYSTEM_CALL of linux/elf.h, 32 bits: the number that the kernel knows of the call that a thread stands in."""


def call_number(registers: Mapping[str, int]) -> int:
    """The number of the system call that a thread stands in, if that was `recalled`; else -1."""
    word = registers[CALL_NUMBER]
    return -1 if word >> 63 else word


def mark_of(registers: Mapping[str, int]) -> int:
    """The mark of the call that a thread stands in, if that was `recalled`; 0: it has none."""
    return registers.get("mark", 0)


def marked(number: int, mark: int) -> int:
    """A call's number with a mark: as it is, marks lie elsewhere."""
    return number


def has_room_for_mark(registers: Mapping[str, int]) -> bool:
    """Whether the call that a thread stands in has room for a mark."""
    return SYSCALL_NAMES.get(call_number(registers)) not in _BEGIN_WITH_A_POINTER


def recalled(registers: Registers, number: int, first_argument: int) -> Registers:
    """The registers of a thread in which a call has just ended, with what they do not say: which, of what, with which mark.

    Args:
        registers: the ``svc`` is the instruction before where they stand.
    """
    told = {**registers, CALL_NUMBER: number, "first": first_argument, "mark": 0}
    if has_room_for_mark(told):
        told["mark"], told["first"] = divmod(first_argument, 1 << 32)
    return told


def made_again(registers: Registers, mark: int) -> Registers:
    """Have a call made again that has ended with EINTR: see `checkpoint.linux.trace.syscall_reentry` for signals that come first.

    Args:
        registers: as `recalled`.
    """
    place = registers[INSTRUCTION_POINTER] - len(SYSCALL)
    first = mark << 32 | registers["first"]
    return {**registers, RESULT: first, INSTRUCTION_POINTER: place, CALL_NUMBER: NO_CALL}


RESTART_BLOCK_USERS: Final = ("clock_nanosleep", "nanosleep", "futex")


def may_go_on(registers: Mapping[str, int]) -> bool:
    """Whether the call that a thread is about to make may be one that the kernel has interrupted, and remembers the end of.

    Not so where its time is told by the clock: made again it ends as it would have.

    Source: clock_nanosleep(2), futex(2): FUTEX_WAIT is operation 0.
    """
    name = SYSCALL_NAMES.get(registers[NUMBER])
    if name == "clock_nanosleep":
        return not registers["x1"] & 1
    if name == "futex":
        return not registers["x1"] & 0x7F and bool(registers["x3"])
    return name == "nanosleep"


def call_number_before(code: bytes) -> int | None:
    """Find the system call number that the instructions before an ``svc`` have loaded.

    Args:
        code: the bytes that end with the ``svc`` instruction.

    Returns:
        The immediate of the last ``mov x8, imm16``, if there is one.
    """
    for place in range(len(code) - 2 * len(SYSCALL), -1, -len(SYSCALL)):
        word = int.from_bytes(code[place : place + 4], "little")
        if word & 0x7FE0001F == 0x52800008:
            return word >> 5 & 0xFFFF
    return None


# Code of a borrowed page (see `checkpoint.linux.trace.remote_syscalls`)

CLOBBERED: Final = ("x0", "x1", "x2", "x3", "x4", "x5", "x8", "x9", "sp", "pstate")
"""Registers that the calls change, or the code between them: we give them back, in this order in the table."""
LARGE_DESK_SIZE: Final = 32768
SMALL_DESK_SIZE: Final = 1024
"""Bytes of a desk's code, and of its table without the frame: for 200 of the longest calls, and for four."""


def frame_size(lost: int) -> int:
    """Bytes at the end of a desk's table that its code needs: for a frame of rt_sigreturn(2), from struct ucontext on.

    Args:
        lost: bytes of the register set of `extended.LOST_IN_CALLS`; 0: there is none.
    """
    further = _FURTHER.size + 2 * len(_TERMINATOR) + -(-lost // 16) * 16 if lost else 0
    return _END_OF_FRAME + further + len(_TERMINATOR)


def frame_of_lost(frame: int, lost: bytes) -> tuple[int, bytes]:
    """Where in a frame it stands what a thread has lost in our calls, and that as it stands there.

    Args:
        frame: address of its struct ucontext.
        lost: the register set of `extended.LOST_IN_CALLS` as the thread stood; empty: nothing is lost.
    """
    place = frame + _END_OF_FRAME
    return place, _lost(place, lost) if lost else _TERMINATOR


_STACK_FLAGS, _MASK_OF_FRAME, _GENERAL_OF_FRAME = 24, 40, 184
_PC_OF_FRAME, _VECTORS = 440, 464
_END_OF_FRAME: Final = _VECTORS + 528
"""Offsets in struct ucontext (asm/ucontext.h, asm/sigcontext.h): `_VECTORS` begins struct fpsimd_context, the last that every
thread has."""
_TERMINATOR: Final = bytes(16)
_FURTHER: Final = struct.Struct("<IIQI12x")
"""struct extra_context: what it leads to comes right after it and a terminator."""
_SCALABLE: Final = struct.Struct("<IIHH4x")
"""struct sve_context, before the registers: Z, P, FFR."""
_FURTHER_MAGIC, _SCALABLE_MAGIC = 0x45585401, 0x53564501
_BEFORE_UCONTEXT: Final = 128
"""Bytes of siginfo, which lie before struct ucontext in a frame; rt_sigreturn(2) does not read them."""
_VECTORS_HEAD: Final = 0x46508001 | 528 << 32
_NO_STACK: Final = 7
"""Flags of an alternate stack that are none: rt_sigreturn(2) leaves the one that there is."""
_PLACES: Final = {name: _GENERAL_OF_FRAME + 8 * index for index, name in enumerate((*_GENERAL, "sp", "pc", "pstate"))}
_SCRATCH: Final = 9
_STORES_BEFORE: Final = 0xD5033ABF
"""``dmb ishst``: a processor that sees a later store sees every earlier one."""


def _lost(place: int, content: bytes) -> bytes:
    """The end of a frame with scalable vectors in it: these lie where the frame's own room would not do for the longest.

    Args:
        place: its address.
        content: NT_ARM_SVE.

    Source: parse_user_sigframe() in arch/arm64/kernel/signal.c; asm/sigcontext.h.
    """
    vector_size, registers = scalable_registers(content)
    size = -(-(_SCALABLE.size + len(registers)) // 16) * 16
    told = (_SCALABLE.pack(_SCALABLE_MAGIC, size, vector_size, 0) + registers).ljust(size, b"\0") + _TERMINATOR
    begin = place + _FURTHER.size + len(_TERMINATOR)
    return _FURTHER.pack(_FURTHER_MAGIC, _FURTHER.size, begin, len(told)) + _TERMINATOR + told


class _Code:
    """Straight-line machine code that is put together for one address; no instruction in it changes a flag or the stack."""

    def __init__(self, address: int) -> None:
        self._address = address
        self.content = bytearray()

    def emit(self, word: int) -> None:
        """One instruction."""
        self.content += struct.pack("<I", word)

    def set(self, register: int, value: int) -> None:
        """``movz`` or ``movn``, and as many ``movk`` as it takes."""
        value &= _WORD
        halves = [value >> 16 * place & 0xFFFF for place in range(4)]
        filler, first = (0xFFFF, 0x92800000) if halves.count(0xFFFF) > halves.count(0) else (0, 0xD2800000)
        different = [place for place in range(4) if halves[place] != filler] or [0]
        for place in different:
            is_first = place == different[0]
            half = halves[place] ^ filler if is_first else halves[place]
            self.emit((first if is_first else 0xF2800000) | place << 21 | half << 5 | register)

    def load(self, register: int, address: int) -> None:
        """``ldr register, …``: from at most 1 MiB away."""
        self.emit(0x58000000 | (self._displacement(address) >> 2 & 0x7FFFF) << 5 | register)

    def place(self, register: int, address: int) -> None:
        """``adr register, …``: at most 1 MiB away."""
        displacement = self._displacement(address)
        self.emit(0x10000000 | (displacement & 3) << 29 | (displacement >> 2 & 0x7FFFF) << 5 | register)

    def store(self, register: int, offset: int = 0) -> None:
        """``str register, [x9, offset]``."""
        self.emit(0xF9000000 | offset // 8 << 10 | _SCRATCH << 5 | register)

    def store_half(self, register: int, offset: int) -> None:
        """``str``, of the lower 32 bits."""
        self.emit(0xB9000000 | offset // 4 << 10 | _SCRATCH << 5 | register)

    def store_vector(self, register: int, offset: int) -> None:
        """``str q…``."""
        self.emit(0x3D800000 | offset // 16 << 10 | _SCRATCH << 5 | register)

    def move(self, target: int, source: int) -> None:
        """``mov target, source``."""
        self.emit(0xAA0003E0 | source << 16 | target)

    def call(self, number: int, arguments: Sequence[int]) -> None:
        """Make a system call."""
        for register, value in enumerate(arguments):
            self.set(register, value)
        self.set(8, number)
        self.content += SYSCALL

    def give_back(self, frame: int) -> None:
        """Have the kernel set everything as a frame says.

        Args:
            frame: address of its struct ucontext.
        """
        self.place(_SCRATCH, frame - _BEFORE_UCONTEXT)
        self.emit(0x9100001F | _SCRATCH << 5)  # mov sp, x9
        self.call(SYSCALLS["rt_sigreturn"], ())

    def _displacement(self, address: int) -> int:
        return address - (self._address + len(self.content))


SHOWS_STORES_IN_ORDER: Final = False
"""Whether a reader that sees a thread's last store also sees its earlier ones, without a second look."""


def batch_code(address: int, calls: Sequence[Call], places: TablePlaces) -> bytes:
    """The batch: make every call once, then wait for the tracer; if it does not come, give everything back and go on.

    Args:
        address: where it will lie.
    """
    code = _Code(address)
    for index, call in enumerate(calls):
        code.call(SYSCALLS[call.name], call.arguments)
        code.place(_SCRATCH, places.results + 8 * index)
        code.store(0)
    code.load(0, places.serial)
    code.place(_SCRATCH, places.done)
    code.emit(_STORES_BEFORE)
    code.store(0)
    code.call(SYSCALLS["rt_sigtimedwait"], (places.empty_set, 0, places.timeout, 8))
    _fill_frame(code, places)
    code.set(0, places.ended)
    code.place(_SCRATCH, places.state)
    code.store(0)
    code.give_back(places.frame)
    return bytes(code.content)


def _fill_frame(code: _Code, places: TablePlaces) -> None:
    code.place(_SCRATCH, places.frame)
    for number, name in enumerate(_GENERAL):
        if name not in CLOBBERED:
            code.store(number, _PLACES[name])
    told = [(_PLACES[name], places.registers + 8 * index) for index, name in enumerate(CLOBBERED)]
    for offset, address in (*told, (_PC_OF_FRAME, places.resume), (_MASK_OF_FRAME, places.mask)):
        code.load(0, address)
        code.store(0, offset)
    for offset, value in ((_STACK_FLAGS, _NO_STACK), (_VECTORS, _VECTORS_HEAD)):
        code.set(0, value)
        code.store(0, offset)
    for offset, instruction in ((_VECTORS + 8, 0xD53B4420), (_VECTORS + 12, 0xD53B4400)):  # mrs x0, fpsr; mrs x0, fpcr
        code.emit(instruction)
        code.store_half(0, offset)
    for number in range(32):
        code.store_vector(number, _VECTORS + 16 + 16 * number)


ENTRY_REGISTERS: Final = ("x19", "x20", "x21")
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
        address: a multiple of 16.
        registers: what the program goes on with; ``pc`` is where.
        mask: the program's signal mask.
        patience_ns: how long it waits for the tracer.
        vectors: the extended state, of which NT_PRFPREG comes first, as the thread stands.
        lost: the register set of `extended.LOST_IN_CALLS`, likewise.
    """
    size = len(_entry_instructions(address, calls, address))
    frame = -(-(address + ENTRY_CODE_OFFSET + size) // 16) * 16
    instructions = _entry_instructions(address, calls, frame).ljust(frame - address - ENTRY_CODE_OFFSET, b"\0")
    return struct.pack("<QQQQ", *divmod(patience_ns, 10**9), 0, 0) + instructions + _frame(frame, registers, mask, vectors, lost)


def _entry_instructions(address: int, calls: EntryCalls, frame: int) -> bytes:
    """The instructions of `entry_code`; their number does not depend on the address of the frame."""
    code = _Code(address + ENTRY_CODE_OFFSET)
    code.call(SYSCALLS[calls.code_pages.name], calls.code_pages.arguments)
    code.move(19, 0)
    code.call(SYSCALLS[calls.table_pages.name], calls.table_pages.arguments)
    code.move(20, 0)
    code.call(SYSCALLS[calls.advice.name], calls.advice.arguments)
    code.call(SYSCALLS[calls.faults.name], calls.faults.arguments)
    code.move(21, 0)
    code.call(SYSCALLS["rt_sigtimedwait"], (address + 16, 0, address, 8))
    code.move(0, 21)
    code.call(SYSCALLS["close"], ())
    code.give_back(frame)
    return bytes(code.content)


def _frame(address: int, registers: Registers, mask: int, vectors: bytes, lost: bytes) -> bytes:
    """A struct ucontext of constants. ``vectors``: 32 registers, then fpsr and fpcr, 32 bits each."""
    frame = bytearray(_END_OF_FRAME)
    struct.pack_into("<Q", frame, _STACK_FLAGS, _NO_STACK)
    struct.pack_into("<Q", frame, _MASK_OF_FRAME, mask)
    frame[_GENERAL_OF_FRAME : _GENERAL_OF_FRAME + REGISTERS_SIZE] = encode_registers(registers)
    struct.pack_into("<Q8s512s", frame, _VECTORS, _VECTORS_HEAD, vectors[512:520], vectors[:512])
    return bytes(frame) + frame_of_lost(address, lost)[1]


ENTRY_CODE_OFFSET: Final = 32
"""Where the instructions of `entry_code` begin, after its constants."""
ENTRY_TIMEOUT_NS: Final = 100_000_000
"""How long a program whose tracer died waits before it goes on by itself."""
