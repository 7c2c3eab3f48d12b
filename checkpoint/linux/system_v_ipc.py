"""System V shared memory of this machine's IPC namespace, which we share with every program that we restore.

Source: shmget(2), shmctl(2), proc_sysvipc_shm(5); /proc/sys/kernel/shm_next_id of Documentation/admin-guide/sysctl/kernel.rst.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path
from typing import Final

from msgspec import Struct

IPC_CREAT: Final = 0o1000
IPC_EXCL: Final = 0o2000
IPC_RMID: Final = 0
IPC_SET: Final = 1
IPC_STAT: Final = 2
MADV_REMOVE: Final = 9
SHM_DEST: Final = 0o1000
"""Bit of the permissions: it goes with the last that has it attached."""
PERMISSIONS: Final = 0o777

_TABLE: Final = Path("/proc/sysvipc/shm")
_NEXT_ID: Final = Path("/proc/sys/kernel/shm_next_id")
_libc: Final = ctypes.CDLL(None, use_errno=True)


class Segment(Struct, frozen=True):
    """One segment.

    Attributes:
        key: signed; 0 where no process can ask for it by a key.
        permissions: of a file, and `SHM_DEST`.
        attached: mappings of it, in all processes.
        creator: uid of the user that made it, and may use it under any owner; -1 where that is not known.
        changed: when it was made, or its owner set, in seconds of the wall clock; 0 where that is not known.
    """

    key: int
    identifier: int
    permissions: int
    size: int
    attached: int
    uid: int
    gid: int
    creator: int = -1
    changed: int = 0


class _Permissions(ctypes.Structure):
    """struct ipc_perm of x86-64 and arm64 (asm-generic/ipcbuf.h)."""

    _fields_ = (
        ("key", ctypes.c_int),
        ("uid", ctypes.c_uint),
        ("gid", ctypes.c_uint),
        ("creator", ctypes.c_uint * 2),
        ("mode", ctypes.c_uint),
        ("rest", ctypes.c_ubyte * 256),
    )


def segments() -> dict[int, Segment]:
    """Every segment, by its id."""
    found = {}
    with contextlib.suppress(OSError):  # a kernel without
        for line in _TABLE.read_text().splitlines()[1:]:
            words = line.split()
            key, identifier, permissions, size = int(words[0]), int(words[1]), int(words[2], 8), int(words[3])
            found[identifier] = Segment(key, identifier, permissions, size, *map(int, (*words[6:10], words[13])))
    return found


def make(wanted: Segment) -> int:
    """Make a segment, with the wanted id where that is free and we may choose: the id that it has.

    Raises:
        OSError: it cannot be made, or its owner cannot be set.
    """
    with contextlib.suppress(OSError):
        _NEXT_ID.write_text(f"{wanted.identifier}\n")
    flags = IPC_CREAT | IPC_EXCL | (wanted.permissions & PERMISSIONS)
    identifier = int(_libc.shmget(ctypes.c_int(wanted.key), ctypes.c_size_t(wanted.size), ctypes.c_int(flags)))
    if identifier < 0:
        raise _failure()
    try:
        _own(identifier, wanted)
    except OSError:
        remove(identifier)
        raise
    return identifier


def _own(identifier: int, wanted: Segment) -> None:
    about = _Permissions()
    if _libc.shmctl(identifier, IPC_STAT, ctypes.byref(about)) < 0:
        raise _failure()
    if (about.uid, about.gid) == (wanted.uid, wanted.gid):
        return
    about.uid, about.gid = wanted.uid, wanted.gid
    if _libc.shmctl(identifier, IPC_SET, ctypes.byref(about)) < 0:
        raise _failure()


def wipe(segment: Segment) -> None:
    """Have a segment hold nothing but zeros, and no memory.

    Raises:
        OSError: it cannot be attached for writing.

    Source: madvise(2), MADV_REMOVE.
    """
    _libc.shmat.restype = ctypes.c_void_p
    place = _libc.shmat(segment.identifier, None, 0)
    if place == ctypes.c_void_p(-1).value:
        raise _failure()
    try:
        if _libc.madvise(ctypes.c_void_p(place), ctypes.c_size_t(segment.size), MADV_REMOVE) < 0:
            ctypes.memset(place, 0, segment.size)
    finally:
        _libc.shmdt(ctypes.c_void_p(place))


def remove(identifier: int) -> None:
    """Remove a segment, as soon as no process has it attached any more; one that is gone is no error."""
    _libc.shmctl(identifier, IPC_RMID, None)


def _failure() -> OSError:
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))
