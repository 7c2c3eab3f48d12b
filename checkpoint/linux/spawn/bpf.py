"""Analyse classic BPF filters of seccomp(2): the verdicts that a filter may give, and whether it allows a call.

Source: linux/filter.h, linux/bpf_common.h; seccomp_check_filter() in kernel/seccomp.c, which defines the allowed instructions.
"""

from __future__ import annotations

import enum
import operator
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

_INSTRUCTION: Final = struct.Struct("<HBBI")
"""struct sock_filter: code, how far to jump if true, if false, constant."""
_CALL: Final = struct.Struct("<iIQ6Q")
"""struct seccomp_data: number, architecture, instruction pointer, arguments."""
ALLOW: Final = 0x7FFF0000
LOG: Final = 0x7FFC0000
ACTION: Final = 0xFFFF0000


class _Class(enum.IntEnum):
    """The lowest three bits of a code."""

    LOAD = 0
    LOAD_INDEX = 1
    STORE = 2
    STORE_INDEX = 3
    ARITHMETIC = 4
    JUMP = 5
    RETURN = 6
    MOVE = 7


_WORD: Final = 0xFFFFFFFF
_BY_INDEX: Final = 0x08
_RETURNS_RESULT: Final = 0x10
_TO_RESULT: Final = 0x80
_MEMORY_WORDS: Final = 16
_ALWAYS: Final = 0x00
_OPERATIONS: Final[Mapping[int, Callable[[int, int], int]]] = {
    0x00: operator.add,
    0x10: operator.sub,
    0x20: operator.mul,
    0x30: lambda left, right: left // right if right else 0,
    0x40: operator.or_,
    0x50: operator.and_,
    0x60: lambda left, right: left << (right & 31),
    0x70: lambda left, right: left >> (right & 31),
    0x80: lambda left, _: -left,
    0xA0: operator.xor,
}
_COMPARISONS: Final[Mapping[int, Callable[[int, int], bool]]] = {
    0x10: operator.eq,
    0x20: operator.gt,
    0x30: operator.ge,
    0x40: lambda left, right: bool(left & right),
}


def returned_constants(program: bytes) -> Iterator[int]:
    """Every constant that a filter may return."""
    for code, _, _, constant in _INSTRUCTION.iter_unpack(program):
        if code & 7 == _Class.RETURN and not code & _RETURNS_RESULT:
            yield constant


def allows(programs: Iterable[bytes], number: int, architecture: int, arguments: Sequence[int]) -> bool:
    """Whether all filters let a call through.

    Args:
        architecture: AUDIT_ARCH_* of linux/audit.h.
        arguments: six words.
    """
    call = struct.unpack(f"<{_CALL.size // 4}I", _CALL.pack(number, architecture, 0, *arguments))
    return all(_verdict(program, call) & ACTION in (ALLOW, LOG) for program in programs)


def _verdict(program: bytes, call: Sequence[int]) -> int:
    """The value that a filter returns; every program ends, for the kernel knows no backward jumps.

    Args:
        call: struct seccomp_data in words of 32 bits.
    """
    code = list(_INSTRUCTION.iter_unpack(program))
    result = index = place = 0
    memory = [0] * _MEMORY_WORDS
    while place < len(code):
        kind, on_true, on_false, constant = code[place]
        place += 1
        operand = index if kind & _BY_INDEX else constant
        match _Class(kind & 7):
            case _Class.LOAD:
                result = _loaded(kind, constant, call, memory)
            case _Class.LOAD_INDEX:
                index = _loaded(kind, constant, call, memory)
            case _Class.STORE:
                memory[constant] = result
            case _Class.STORE_INDEX:
                memory[constant] = index
            case _Class.ARITHMETIC:
                result = _OPERATIONS[kind & 0xF0](result, operand) & _WORD
            case _Class.JUMP if kind & 0xF0 == _ALWAYS:
                place += constant
            case _Class.JUMP:
                place += on_true if _COMPARISONS[kind & 0xF0](result, operand) else on_false
            case _Class.RETURN:
                return result if kind & _RETURNS_RESULT else constant
            case _Class.MOVE if kind & _TO_RESULT:
                result = index
            case _Class.MOVE:
                index = result
    return 0


def _loaded(kind: int, constant: int, call: Sequence[int], memory: Sequence[int]) -> int:
    match kind & 0xE0:
        case 0x20:  # BPF_ABS
            return call[constant // 4]
        case 0x60:  # BPF_MEM
            return memory[constant]
        case 0x80:  # BPF_LEN
            return 4 * len(call)
    return constant
