"""Read the owner and signal of open files (fcntl(2)) at the same instant as the memory.

The query costs a few calls for each open file, and hardly any has an owner. So the freeze asks only about files that may well
have one: they send signals (O_ASYNC), have a lease, are in transit in a socket, or had an owner at the last capture. After the
process has resumed, all others are asked. If one of them has an owner, the file got it unnoticed, perhaps before the freeze,
perhaps after it: the capture is made again, and asks about that file in time.

Source: F_GETOWN_EX and F_GETSIG in fcntl(2).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
from collections.abc import Iterable, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.linux.procfs.descriptors import copy_of, lending
from checkpoint.resources.open_file import OpenFile, Owners, Signals

F_GETOWN_EX: Final = 16
OWNER: Final = struct.Struct("<ii")
"""struct f_owner_ex."""
O_PATH: Final = 0o10000000
_O_ASYNC: Final = os.O_ASYNC
_LEASE: Final = b" LEASE "


NOTHING_SENT: Final = Signals()


def asked(opened: Iterable[OpenFile]) -> tuple[OpenFile, ...]:
    """The same, with what those send that may well send something; the process stands still."""
    return tuple([replace(held, signals=ask(held)) if _may_have_one(held) else held for held in opened])


def _may_have_one(held: OpenFile) -> bool:
    """Asked of each of thousands while the process stands still."""
    one = held.descriptors[0]
    if one.flags & _O_ASYNC or held.lent or _LEASE in one.told:
        return True
    known = held.owners
    return False if not known else (one.number, one.inode) in known


def overlooked(opened: Sequence[OpenFile], known: Owners) -> OpenFile | None:
    """One that has an owner now and was not asked in the freeze; None if there is none. The process may run.

    Args:
        known: told which have one.
    """
    if not opened:
        return None
    with lending(opened[0].pid):
        found = [held for held in opened if held.signals is None and ask(held)]
    known.clear()
    known |= {(held.first.number, held.first.inode) for held in (*found, *(held for held in opened if held.signals))}
    return found[0] if found else None


def of(held: OpenFile) -> Signals:
    """The signals that it sends: as told in the freeze, or, of a process that is looked at but once, now."""
    if held.signals is not None:
        return held.signals
    return ask(held) if held.owners is None else NOTHING_SENT


def ask(held: OpenFile) -> Signals:
    """The signals that it sends now, asked through a copy of the descriptor; nothing where there is none any more."""
    if held.first.flags & O_PATH:
        return NOTHING_SENT
    with contextlib.suppress(OSError), copy_of(held.pid, held.first.number) as descriptor:
        signal = fcntl.fcntl(descriptor, fcntl.F_GETSIG)
        return Signals(signal, *OWNER.unpack(fcntl.fcntl(descriptor, F_GETOWN_EX, bytes(OWNER.size))))
    return NOTHING_SENT
