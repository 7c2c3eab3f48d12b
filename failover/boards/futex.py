"""Sleep until a word of a mapped file changes, and wake those that do, also from another process.

Source: futex(2), FUTEX_WAIT, FUTEX_WAIT_BITSET and FUTEX_WAKE without FUTEX_PRIVATE_FLAG; Python's C API, buffer protocol.
"""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Final

from failover.errors import BoardError

NUMBERS: Final = {"x86_64": 202, "aarch64": 98, "riscv64": 98}
"""Machine → number of the call futex. Source: asm/unistd.h."""

WAITV: Final = 449
"""Of futex_waitv, on every machine. Source: asm-generic/unistd.h, since Linux 5.16."""
POLL_S: Final = 0.01

_WAIT: Final = 0
_WAKE: Final = 1
_WAIT_BITSET: Final = 9
_ANY: Final = 0xFFFFFFFF
_ALL: Final = 2**31 - 1
_SIZE_32: Final = 2
_NS_PER_S: Final = 1_000_000_000


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Waiter(ctypes.Structure):
    """struct futex_waitv."""

    _fields_ = (
        ("value", ctypes.c_uint64),
        ("address", ctypes.c_uint64),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    )


class _Buffer(ctypes.Structure):
    """Py_buffer, as far as it is read here; the rest is room."""

    _fields_ = (("address", ctypes.c_void_p), ("object", ctypes.py_object), ("rest", ctypes.c_byte * 128))


def address_of(mapping: Any) -> int:
    """Where a mapping begins in this process, also one that may only be read. The mapping must outlive the use of it."""
    found = _Buffer()
    ctypes.pythonapi.PyObject_GetBuffer(ctypes.py_object(mapping), ctypes.byref(found), 0)
    address = found.address
    ctypes.pythonapi.PyBuffer_Release(ctypes.byref(found))
    assert address is not None
    return int(address)


def wait(address: int, value: int, timeout_s: float) -> bool:
    """Sleep until woken, as long as the 32 bits at ``address`` are ``value``; not longer than ``timeout_s``. May wake early.

    Returns:
        Whether they were another value, or this thread was woken. False: the time is over, or a signal came.
    """
    nanoseconds = max(int(timeout_s * _NS_PER_S), 0)
    limit = _Timespec(*divmod(nanoseconds, _NS_PER_S))
    if _call()(_number(), ctypes.c_void_p(address), _WAIT, ctypes.c_uint32(value), ctypes.byref(limit), None, 0) == 0:
        return True
    wrong = ctypes.get_errno()
    if wrong not in (errno.EAGAIN, errno.EINTR, errno.ETIMEDOUT):
        raise BoardError(f"cannot wait for the board: {os.strerror(wrong)}")
    return wrong == errno.EAGAIN


def wait_until(address: int, value: int, instant_ns: int) -> None:
    """Sleep until woken, or until an instant of CLOCK_MONOTONIC as this process reads it. May wake early.

    Only as long as the 32 bits at ``address`` are ``value``.
    """
    limit = _Timespec(*divmod(max(instant_ns, 0), _NS_PER_S))
    if _call()(_number(), ctypes.c_void_p(address), _WAIT_BITSET, ctypes.c_uint32(value), ctypes.byref(limit), None, _ANY) == -1:
        wrong = ctypes.get_errno()
        if wrong not in (errno.EAGAIN, errno.EINTR, errno.ETIMEDOUT):
            raise BoardError(f"cannot wait in the schedule: {os.strerror(wrong)}")


def wait_any(places: Sequence[tuple[int, int]], timeout_s: float) -> None:
    """As `wait`, on several words at once: (address, value) of each, at most 128. May wake early.

    A kernel before 5.16 cannot: then it sleeps on the first word for a hundredth of a second.

    Source: futex_waitv, Documentation/userspace-api/futex2.rst.
    """
    if len(places) == 1:
        wait(*places[0], timeout_s)
        return
    waiters = (_Waiter * len(places))(*(_Waiter(value, address, _SIZE_32, 0) for address, value in places))
    limit = _Timespec(*divmod(time.monotonic_ns() + max(int(timeout_s * _NS_PER_S), 0), _NS_PER_S))
    if _call()(WAITV, ctypes.byref(waiters), len(places), 0, ctypes.byref(limit), time.CLOCK_MONOTONIC) == -1:
        wrong = ctypes.get_errno()
        if wrong in (errno.ENOSYS, errno.EPERM):
            wait(*places[0], min(timeout_s, POLL_S))
        elif wrong not in (errno.EAGAIN, errno.EINTR, errno.ETIMEDOUT):
            raise BoardError(f"cannot wait for the board: {os.strerror(wrong)}")


def wake(address: int) -> None:
    """Wake all that sleep on the 32 bits at ``address``."""
    _call()(_number(), ctypes.c_void_p(address), _WAKE, _ALL, None, None, 0)


def waker(address: int) -> Callable[[], None]:
    """The same for a place that is woken often; the mapping must outlive it. It never blocks, so it keeps the interpreter."""
    call = ctypes.PyDLL(None).syscall
    number, where, what, how_many = ctypes.c_long(_number()), ctypes.c_void_p(address), ctypes.c_int(_WAKE), ctypes.c_int(_ALL)

    def wake() -> None:
        call(number, where, what, how_many)

    return wake


@lru_cache(maxsize=1)
def _call() -> Any:
    return ctypes.CDLL(None, use_errno=True).syscall


@lru_cache(maxsize=1)
def _number() -> int:
    machine = os.uname().machine
    if machine not in NUMBERS:
        raise BoardError(f"cannot wait for the board on a {machine}: the number of futex(2) is not known there; poll with get()")
    return NUMBERS[machine]
