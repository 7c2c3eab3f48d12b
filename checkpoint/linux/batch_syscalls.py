"""Make many system calls of our own process at once, without the interpreter between them, for queries during a freeze.

The interpreter takes longer to make a short system call than the kernel takes to answer it. So the calls are in a table, which a
few instructions of machine code execute. Where the system does not allow instructions in memory, the calls are made one by one,
with the same results.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import os
from collections.abc import Callable, Sequence
from typing import Final

from checkpoint.arch import stubs
from checkpoint.linux import abi
from checkpoint.runtime.lazy_numpy import NDArray, np

NUMBER, FIRST_ARGUMENT, RESULT_TO = 0, 1, 7
"""Places in a row: the call's number, the first of six arguments, the address where the result goes; 0: nowhere."""
ROW: Final = 8
ROW_SIZE: Final = 8 * ROW
_MASK: Final = (1 << 64) - 1

Loop = Callable[[int, int], None]
"""Given the addresses of the first row and of the end of the last."""

_mmap = ctypes.CDLL(None, use_errno=True).mmap
_mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long)
_mmap.restype = ctypes.c_void_p


def _syscall_of(library: ctypes.CDLL) -> Callable[..., int]:
    syscall = library.syscall
    syscall.argtypes = (ctypes.c_long,) * 7
    syscall.restype = ctypes.c_long
    return syscall


_syscall = _syscall_of(ctypes.PyDLL(None, use_errno=True))
_syscall_that_may_wait = _syscall_of(ctypes.CDLL(None, use_errno=True))


def row(name: str, *arguments: int, to: int = 0) -> tuple[int, ...]:
    """One call, as a row of a table.

    Args:
        name: the system call's.
        to: the address where its result goes, 64 bits, as the kernel gives it: an error is a negative number. It may be an
            argument of a later row.
    """
    filled = (*arguments, *(0,) * (RESULT_TO - FIRST_ARGUMENT - len(arguments)))
    return (stubs.SYSTEM_CALLS[name], *(argument & _MASK for argument in filled), to)


class OwnCalls:
    """A table of calls, made again and again. The maker of its rows keeps alive everything that they point to.

    Attributes:
        entries: the rows, (count, 8) words.
        cells: the same memory, word by word.
        address: of the first row.
    """

    def __init__(self, rows: int | Sequence[tuple[int, ...]]) -> None:
        """A table of so many empty rows, or of these."""
        count = rows if isinstance(rows, int) else len(rows)
        self.entries: NDArray[np.uint64] = np.zeros((count, ROW), dtype=np.uint64)
        if not isinstance(rows, int) and rows:
            self.entries[:] = np.array(rows, dtype=np.uint64)
        self.cells = self.entries.reshape(-1).data
        self.address = int(self.entries.ctypes.data)

    def run(self, first: int = 0, last: int | None = None, *, may_wait: bool = False) -> None:
        """Make the calls of the rows [first, last), one after the other, also when some fail.

        Args:
            may_wait: one of them may, for another thread of ours even: those go on meanwhile. Otherwise they wait for us.
        """
        end = len(self.entries) if last is None else last
        if first < end:
            loop = _patient_loop() if may_wait else _loop()
            loop(self.address + first * ROW_SIZE, self.address + end * ROW_SIZE)

    def address_of(self, index: int, place: int) -> int:
        """Where a word of a row lies: a result that goes there is an argument of that row.

        Args:
            place: `FIRST_ARGUMENT` for the first argument.
        """
        return self.address + index * ROW_SIZE + 8 * place


@functools.cache
def _loop() -> Loop:
    try:
        return _in_machine_code()
    except OSError:
        return one_by_one


@functools.cache
def _patient_loop() -> Loop:
    try:
        return _in_machine_code_that_may_wait()
    except OSError:
        return one_by_one_that_may_wait


def _in_machine_code() -> Loop:
    """Raises as `instructions`."""
    return ctypes.PYFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(instructions(stubs.OWN_LOOP))


def _in_machine_code_that_may_wait() -> Loop:
    """Raises as `instructions`."""
    return ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(instructions(stubs.OWN_LOOP))


@functools.cache
def instructions(code: bytes) -> int:
    """The address of machine code, in memory that is not writable: some systems forbid memory that is writable and executable.

    Raises:
        OSError: the system does not allow it (a noexec policy, for one).
    """
    file = os.memfd_create("calls", os.MFD_CLOEXEC)
    try:
        os.write(file, code)
        place = _mmap(None, len(code), mmap.PROT_READ | mmap.PROT_EXEC, mmap.MAP_PRIVATE, file, 0)
    finally:
        os.close(file)  # Python's own mmap would keep a copy of it
    if place is None or place == ctypes.c_void_p(-1).value:
        abi.raise_errno("mmap of instructions")
    return int(place)


def one_by_one(first: int, end: int) -> None:
    """The same, slowly, by the C library."""
    _one_by_one(first, end, _syscall)


def one_by_one_that_may_wait(first: int, end: int) -> None:
    """As `one_by_one`, of calls that may wait."""
    _one_by_one(first, end, _syscall_that_may_wait)


def _one_by_one(first: int, end: int, syscall: Callable[..., int]) -> None:
    for place in range(first, end, ROW_SIZE):
        number, *arguments, to = (ctypes.c_uint64 * ROW).from_address(place)
        result = int(syscall(number, *(ctypes.c_long(argument) for argument in arguments)))
        if to:
            ctypes.c_int64.from_address(to).value = -ctypes.get_errno() if result == -1 else result
