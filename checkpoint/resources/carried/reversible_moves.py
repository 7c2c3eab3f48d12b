"""Move files and folders reversibly: no move replaces anything, so a later failure loses nothing."""

from __future__ import annotations

import ctypes
import errno
import os
from typing import Final, NamedTuple

from msgspec import Struct, field

AT_FDCWD: Final = -100
RENAME_NOREPLACE: Final = 1
RENAME_EXCHANGE: Final = 2
_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_CANNOT: Final = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
"""The errors of a file system or kernel that does not know the flag."""


class _Move(NamedTuple):
    old: str
    new: str
    flag: int


class Moves(Struct):
    """The moves that were made, in order."""

    _made: list[_Move] = field(default_factory=list)

    def rename(self, old: str, new: str) -> None:
        """Let something have another name, which nothing has. Raises OSError."""
        _rename(old, new)
        self._made.append(_Move(old, new, RENAME_NOREPLACE))

    def exchange(self, one: str, other: str) -> bool:
        """Let two names change places in one instant; False where this file system or kernel cannot.

        Raises:
            OSError: it fails for another reason.
        """
        try:
            _renameat2(one, other, RENAME_EXCHANGE)
        except OSError as error:
            if error.errno in _CANNOT:
                return False
            raise
        self._made.append(_Move(one, other, RENAME_EXCHANGE))
        return True

    def take_back(self) -> tuple[str, ...]:
        """Let everything be where it was; what could not be moved back, by where it lies and where it belongs."""
        while self._made:
            move = self._made[-1]
            try:
                if move.flag == RENAME_EXCHANGE:
                    _renameat2(move.old, move.new, RENAME_EXCHANGE)
                else:
                    _rename(move.new, move.old)
            except OSError as error:
                return tuple(f"{_held_by(one)} ({error.strerror})" for one in reversed(self._made))
            self._made.pop()
        return ()


def _held_by(move: _Move) -> str:
    if move.flag == RENAME_EXCHANGE:
        return f"the former {move.new} is at {move.old}"
    return f"the former {move.old} is at {move.new}"


def _rename(old: str, new: str) -> None:
    try:
        _renameat2(old, new, RENAME_NOREPLACE)
    except OSError as error:
        if error.errno not in _CANNOT:
            raise
        os.rename(old, new)


def _renameat2(old: str, new: str, flag: int) -> None:
    """Source: renameat2(2), which the C library has since 2.28."""
    if _LIBC.renameat2(AT_FDCWD, os.fsencode(old), AT_FDCWD, os.fsencode(new), flag) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), new)
