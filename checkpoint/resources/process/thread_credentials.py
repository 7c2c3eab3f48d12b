"""Credentials of threads that differ from the first one's: the kernel keeps user, groups and capabilities for each thread.

The capture reads them before and after the freeze, never during it. So they add nothing to the freeze, and values that are equal
before and after were the same in between. The same holds for the seccomp(2) state, which each thread may have for itself.

Facts: ``descriptors`` (none); ``threads``: a list of [tid, uids, gids, groups, capabilities, no_new_privs] as in the model's
Credentials. Their securebits are those of the first thread.

Source: credentials(7); nptl(7) on why programs seldom do that.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from msgspec import Struct, field

from checkpoint.capability import Area, preserved
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import told_by_spokesman
from checkpoint.linux.procfs.procfs import Status
from checkpoint.linux.procfs.tasks import thread_count, thread_ids
from checkpoint.model import Credentials, Fact, Resource
from checkpoint.snapshot.credentials import KIND, Owner, above, refusal

CAPABILITIES: Final = (
    preserved(
        Area.THREADS,
        "threads with their own user, groups or capabilities",
        "each gets its own again; all get the securebits of the first thread",
    ),
)

Odd = Mapping[int, tuple[int, Credentials]]
"""By thread id, as we see it: its id as it sees it itself, and its rights."""


class Seen(Struct, frozen=True):
    """One look at all threads of a process.

    Attributes:
        odd: the rights of those that may not what the first one may, or more.
        modes: of seccomp(2), of those that have one.
    """

    odd: Odd = field(default_factory=dict)
    modes: Mapping[int, int] = field(default_factory=dict)


class ThreadRights:
    """The rights of the threads of one process that differ from the first one's."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._before = Seen()

    @property
    def modes(self) -> Mapping[int, int]:
        """The modes of seccomp(2) of confined threads before the freeze, by thread id as we see it."""
        return self._before.modes

    def prepare(self) -> None:
        """Look before the freeze."""
        self._before = _seen(self._pid)

    def describe(self, confined: Collection[int]) -> tuple[Resource, ...]:
        """The facts that were the same before and after the freeze.

        Args:
            confined: threads that were known to be confined while they stood still.

        Raises:
            CaptureError: one of them has just changed.
        """
        before, now = self._before, _seen(self._pid)
        if now == before == Seen():
            return ()
        alive = frozenset(thread_ids(self._pid))
        for tid in (now.odd.keys() | before.odd.keys()) & alive:
            if now.odd.get(tid) != before.odd.get(tid):
                raise CaptureError(f"thread {tid} of pid {self._pid} is just changing its rights; capture it again")
        if fresh := (now.modes.keys() - before.modes.keys() - set(confined)) & alive:
            raise CaptureError(f"thread {min(fresh)} of pid {self._pid} has just come under a seccomp filter; capture it again")
        if not before.odd:
            return ()
        return (
            Resource(KIND, "rights of threads", {"descriptors": [], "threads": [_told(*one) for one in before.odd.values()]}),
        )


def refuse(pid: int, owner: Owner | None) -> tuple[str, ...]:
    """Why a process is not its owner's to have captured: one of its threads may something that its owner may not.

    It has executed a set-user-id program, for one, after the agent had looked whose it is. The look that counts is taken while it
    stands still (`checkpoint.snapshot.credentials.beyond`, of the snapshot). This one comes before, so that such a process is
    not touched.

    Args:
        owner: None: it may anything.
    """
    if owner is None:
        return ()
    reason = refusal(told_by_spokesman(pid, lambda tid: _above(tid, owner)), owner)
    return (reason,) if reason else ()


def _above(pid: int, owner: Owner) -> list[str]:
    """Rights that its threads have and their owner has not."""
    everybodys = (_credentials(procfs.status(pid)), *(theirs for _, theirs in _seen(pid).odd.values()))
    return [text for theirs in everybodys for text in above(theirs, owner)]


def _seen(pid: int) -> Seen:
    if thread_count(pid) == 1:
        return Seen()
    first = _credentials(procfs.status(pid))
    odd: dict[int, tuple[int, Credentials]] = {}
    modes: dict[int, int] = {}
    for tid in thread_ids(pid):
        try:
            status = procfs.parse_status(procfs.read_text(pid, f"task/{tid}/status"))
        except (ProcessGoneError, ProbeError):
            continue  # it has ended
        if _credentials(status) != first:
            odd[tid] = status.pids[-1], _credentials(status)
        if status.seccomp:
            modes[tid] = status.seccomp
    return Seen(odd, modes)


def _credentials(status: Status) -> Credentials:
    return Credentials(status.uids, status.gids, status.groups, status.capabilities, status.no_new_privs)


def _told(tid: int, rights: Credentials) -> list[Fact]:
    ids: list[Fact] = [list(rights.uids), list(rights.gids), list(rights.groups), list(rights.capabilities)]
    return [tid, *ids, rights.no_new_privs]
