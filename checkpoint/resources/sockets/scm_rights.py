"""Open files in transit in a unix socket (SCM_RIGHTS) that the program itself has closed since.

The capture reads them through descriptors of our own, with numbers above all of the program's. The restore opens them under these
numbers until they have been sent again. Fact of such a resource: ``travelling``, true.

Source: unix(7), SCM_RIGHTS.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Final

from checkpoint.capability import Area, refused
from checkpoint.linux import abi
from checkpoint.linux.procfs.descriptors import descriptor
from checkpoint.model import Fact
from checkpoint.resources.open_file import Kin, Lent, Opened, OpenFile
from checkpoint.sentences import AS_SOON_AS

if TYPE_CHECKING:
    from checkpoint.resources.sockets.sockets import Noted

CAPABILITIES: Final = (
    refused(
        Area.SOCKETS,
        "a descriptor on its way in a unix socket that the program itself has closed, if it is of a terminal, watch or "
        "device, or has a lock",
        f"wait: {AS_SOON_AS} the program has received it",
        "is on its way in a unix socket",
    ),
)

KINDS: Final = (
    *("files", "pipes", "fifos", "eventfds", "timerfds", "epolls", "memory_files", "devices", "kernel_files"),
    *("unix_sockets", "tcp_connections", "internet_sockets", "netlink_sockets", "packet_sockets"),
)
"""Kinds that can be on their way and come back."""
UNKNOWN: Final = -1
OWNED: Final = ("locks", "owner", "signal")
"""Facts of open files that are about their holder."""


def number_of(opened: Opened, ours: int) -> int:
    """The number of what a descriptor of ours, which came in a message, leads to: the program's own, else one of ours.

    `UNKNOWN` where it cannot be looked at.
    """
    about = os.fstat(ours)
    for one in (*opened, *opened.travelling):
        is_alike = (one.first.device, one.first.inode) == (about.st_dev, about.st_ino)
        if is_alike and abi.kcmp(one.pid, os.getpid(), abi.KCMP_FILE, one.first.number, ours) == 0:
            return int(one.first.number)
    return _taken_along(opened, ours)


def _taken_along(opened: Opened, ours: int) -> int:
    """Look at one more; not between several processes, which cannot be told apart there."""
    if not opened or opened[0].kin.pids:
        return UNKNOWN
    above = max(one.number for held in opened for one in held.descriptors) + 1
    try:
        lent = Lent(fcntl.fcntl(ours, fcntl.F_DUPFD_CLOEXEC, above))
    except OSError:  # the program has greater numbers than we may have
        return UNKNOWN
    if (seen := descriptor(os.getpid(), lent.number)) is None:
        return UNKNOWN
    opened.travelling.append(OpenFile(os.getpid(), (seen,), kin=Kin(frozenset({opened[0].pid})), lent=lent))
    return lent.number


def unnoted(number: int, before: int) -> AbstractContextManager[None]:
    """Like `checkpoint.resources.sockets.sockets.Noted`, of what the program has no descriptor of: it could not be put back."""
    return contextlib.nullcontext()


def may_hide(opened: Sequence[OpenFile], noted: Noted | None) -> bool:
    """Whether more may be on its way than was seen: of a program that runs, the first message alone is looked at."""
    return noted is None and any(held.observed.get("passed") for held in opened)


def together(opened: Sequence[OpenFile]) -> frozenset[str]:
    """Pipes of which both ends are among these, as /proc names them."""
    ends = {(one.first.target, one.first.flags & os.O_ACCMODE) for one in opened}
    return frozenset(target for target, mode in ends if mode == os.O_RDONLY and (target, os.O_WRONLY) in ends)


def refuse(held: OpenFile, kind: str, owned: Collection[str]) -> str | None:
    """Why something that is on its way cannot be kept.

    Args:
        owned: facts about its holder.
    """
    if held.lent is None or (kind in KINDS and not set(owned) & set(OWNED)):
        return None
    return (
        f"{held.first.target} is on its way in a unix socket, which the program has closed: "
        f"{AS_SOON_AS} the program has received it"
    )


def describe(held: OpenFile) -> dict[str, Fact]:
    """The fact that it is on its way."""
    return {} if held.lent is None else {"travelling": True}
