"""Rights of threads that are not the first one's: the kernel has user, groups and capabilities for each thread.

They are read before and after a program stands still, never meanwhile: they cost its freeze nothing, and what has not changed in
between was the same then.

Facts: ``descriptors`` (none); ``threads``: a list of [tid, uids, gids, groups, capabilities, no_new_privs] as Credentials of the
model have them; what the first one's securebits are, theirs are.

Source: credentials(7); nptl(7) on why programs seldom do that.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError
from checkpoint.linux import procfs
from checkpoint.linux.procfs import Status
from checkpoint.linux.threads import thread_count, thread_ids
from checkpoint.model import Credentials, Fact, Resource
from checkpoint.rights import KIND

CAPABILITIES: Final = (
    preserved(
        Area.THREADS,
        "threads with a user, groups or capabilities of their own",
        "each gets its own again; securebits are those of the first",
    ),
)

Odd = Mapping[int, tuple[int, Credentials]]
"""By thread id, as we see it: its id as it sees it itself, and its rights."""


class ThreadRights:
    """What the threads of one process may, as far as it is not what the first one may."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._seen: Odd = {}

    def prepare(self) -> None:
        """Look before the freeze."""
        self._seen = _odd(self._pid)

    def describe(self) -> tuple[Resource, ...]:
        """What was so before and after it.

        Raises:
            CaptureError: one of them has just changed.
        """
        now = _odd(self._pid) if self._seen or thread_count(self._pid) > 1 else {}
        alive = frozenset(thread_ids(self._pid)) if self._seen or now else frozenset()
        for tid in (now.keys() | self._seen.keys()) & alive:
            if now.get(tid) != self._seen.get(tid):
                raise CaptureError(f"thread {tid} of pid {self._pid} is just changing its rights; capture it again")
        if not self._seen:
            return ()
        return (
            Resource(KIND, "rights of threads", {"descriptors": [], "threads": [_told(*one) for one in self._seen.values()]}),
        )


def _odd(pid: int) -> Odd:
    if thread_count(pid) == 1:
        return {}
    first, found = _credentials(procfs.status(pid)), {}
    for tid in thread_ids(pid):
        try:
            status = procfs.parse_status(procfs.read_text(pid, f"task/{tid}/status"))
        except (ProcessGoneError, ProbeError):
            continue  # it has ended
        if _credentials(status) != first:
            found[tid] = status.pids[-1], _credentials(status)
    return found


def _credentials(status: Status) -> Credentials:
    return Credentials(status.uids, status.gids, status.groups, status.capabilities, status.no_new_privs)


def _told(tid: int, rights: Credentials) -> list[Fact]:
    ids: list[Fact] = [list(rights.uids), list(rights.gids), list(rights.groups), list(rights.capabilities)]
    return [tid, *ids, rights.no_new_privs]
