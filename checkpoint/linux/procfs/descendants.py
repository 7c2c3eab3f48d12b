"""Find the processes of a component: the first one, its children, their children, and processes whose parent has ended.

A process that has lost its parent is given to the nearest ancestor that asks for orphans (a *reaper*). The reaper of a component
with a PID namespace of its own, or under a guard, has no other children. Elsewhere a *stray* process is told from the children of
other programs by its session or process group, where a process of the component leads it, and no ancestor is in it: programs that
another process has started together stay apart. Where the leader of its session has ended, too, the stray is recognised by a
standard stream that it has from the first process, and that no ancestor has.

Source: proc_pid_task(5) (children), credentials(7), pid_namespaces(7), kcmp(2); PR_SET_CHILD_SUBREAPER of prctl(2).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Final

from checkpoint.errors import CheckpointError
from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import OwnCalls, row
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import spokesman_of
from checkpoint.runtime.lazy_numpy import np

STREAMS: Final = (0, 1, 2)
LEFT_BEHIND_MAX: Final = 4096
"""Strangers of which it is remembered whether they belong to the component: there are new ones as long as a machine runs."""
CHILDREN_SIZE: Final = 1 << 12
GLANCE_SIZE: Final = 16
"""Bytes of a list that tell whether there is anything in it."""
NEARLY_A_PAGE: Final = 4000
"""Bytes: the kernel gives a list in pieces of a page at most, so a shorter piece is the end.

Source: seq_read_iter() in fs/seq_file.c."""


class Children:
    """Reads the children of one process again and again, its threads' included."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._files: dict[int, int] = {}
        self._glance: _Glance | None = None

    def read(self, tids: list[int]) -> list[int]:
        """The children of these threads, oldest first; zombies among them."""
        found: list[int] = []
        for tid in tids:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended; its children are another one's now
                found += map(int, _whole(self._file(tid)).split())
        self._keep_only(tids)
        return found

    def are_there(self, tids: list[int]) -> bool:
        """Whether there are any; these threads stand still. All are asked in one go, for there may be many."""
        if self._glance is not None and self._glance.tids == tids and self._glance.finds_nobody():
            return False
        found = self.read(tids)
        if len(self._files) == len(tids):
            self._glance = _Glance(tids, [self._files[tid] for tid in tids])
        return bool(found)

    def _keep_only(self, tids: list[int]) -> None:
        if len(self._files) > len(tids):
            self._glance = None
            for tid in set(self._files) - set(tids):
                os.close(self._files.pop(tid))

    def _file(self, tid: int) -> int:
        if tid not in self._files:
            self._files[tid] = os.open(f"/proc/{self.pid}/task/{tid}/children", os.O_RDONLY | os.O_CLOEXEC)
        return self._files[tid]

    def close(self) -> None:
        """Give descriptors back."""
        self._glance = None
        for file in self._files.values():
            os.close(file)
        self._files.clear()


class _Glance:
    """Reads whether there is anything in the lists of some threads.

    Args:
        files: of each, which stay open as long as this is used.
    """

    def __init__(self, tids: list[int], files: list[int]) -> None:
        self.tids = tids
        self._results = np.zeros(len(files), dtype=np.int64)
        self._content = np.zeros(GLANCE_SIZE, dtype=np.uint8)
        into, first, step = int(self._content.ctypes.data), int(self._results.ctypes.data), self._results.itemsize
        self._calls = OwnCalls(
            [row("pread64", file, into, GLANCE_SIZE, 0, to=first + step * index) for index, file in enumerate(files)]
        )

    def finds_nobody(self) -> bool:
        """Whether all lists are empty; one that cannot be read is not."""
        self._calls.run()
        return not any(self._results.tolist())


def _whole(file: int) -> bytes:
    """A list from its beginning; a process with few children is read once."""
    found = piece = os.pread(file, CHILDREN_SIZE, 0)
    while len(piece) >= NEARLY_A_PAGE:
        piece = os.pread(file, CHILDREN_SIZE, len(found))
        found += piece
    return found


class Kinship:
    """The processes that belong to the component of a process.

    Args:
        pid: of its first process.
        reaper: the process that gets the orphans: the first one of their PID namespace, or their guard; 0: none that we know.
    """

    def __init__(self, pid: int, reaper: int) -> None:
        self._pid = pid
        self._reaper = reaper
        self._of_first = Children(pid)
        self._of_reaper = Children(reaper)
        self._of_ancestors = () if reaper else tuple(map(Children, ancestors(pid)))
        self._left_behind: dict[tuple[int, int], bool] = {}
        self._has_strays = False

    def has_others(self, tids: list[int]) -> bool:
        """Whether there are processes besides the first one.

        Args:
            tids: its threads.
        """
        return self._has_strays or self._of_first.are_there(tids) or bool(self._reaper and self._orphans())

    def _orphans(self) -> list[int]:
        return [pid for pid in self._of_reaper.read([self._reaper]) if pid != self._pid]

    def others(self) -> list[int]:
        """All processes besides the first one, parents before children, zombies included."""
        found = list(self._walk([*children(self._pid), *(self._orphans() if self._reaper else ())], ()))
        self._has_strays = False
        while strays := self._strays(found):
            self._has_strays = True
            found += self._walk(strays, found)
        return found

    def _strays(self, found: list[int]) -> list[int]:
        """Processes that have lost their parent, and are not among those that were found."""
        if not self._of_ancestors:
            return []
        elders = {self._pid, *(one.pid for one in self._of_ancestors)}
        ours = {self._pid, *found} - _circles(one.pid for one in self._of_ancestors)
        known = elders | set(found)
        theirs = ((one.pid, pid) for one in self._of_ancestors for pid in one.read([one.pid]) if pid not in known)
        return [pid for ancestor, pid in theirs if _given_to(ancestor, pid) & ours or self._is_left_behind(pid)]

    def _is_left_behind(self, pid: int) -> bool:
        """Whether a child of an ancestor is of a session whose leader has ended, and was born below the first process."""
        with contextlib.suppress(ProcessLookupError, PermissionError, CheckpointError):
            session = os.getsid(pid)
            if session in _circles((self._pid, *(one.pid for one in self._of_ancestors))) or _exists(session):
                return False
            born, first = procfs.stat(pid).start_time, spokesman_of(self._pid)
            if (pid, born) not in self._left_behind:
                if len(self._left_behind) >= LEFT_BEHIND_MAX:
                    self._left_behind.clear()
                streams = procfs.stat(self._pid).start_time <= born and self._streams_of_first()
                self._left_behind[pid, born] = any(abi.kcmp(first, pid, abi.KCMP_FILE, n, n) == 0 for n in streams or ())
            return self._left_behind[pid, born]
        return False

    def _streams_of_first(self) -> list[int]:
        """The standard streams of the first process that it has not from its ancestors."""
        first = spokesman_of(self._pid)
        theirs = [(one.pid, number) for one in self._of_ancestors for number in _descriptors_of(one.pid)]
        return [n for n in STREAMS if not any(abi.kcmp(first, pid, abi.KCMP_FILE, n, number) == 0 for pid, number in theirs)]

    @staticmethod
    def _walk(waiting: list[int], known: Iterable[int]) -> Iterator[int]:
        seen = set(known)
        while waiting:
            pid = waiting.pop(0)
            if pid not in seen:
                seen.add(pid)
                yield pid
                waiting += children(pid)

    def close(self) -> None:
        """Give descriptors back."""
        for one in (self._of_first, self._of_reaper, *self._of_ancestors):
            one.close()


def children(pid: int) -> list[int]:
    """The child processes of all its threads, zombies included; none of one that has ended."""
    found: list[int] = []
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for tid in os.listdir(f"/proc/{pid}/task"):
            with contextlib.suppress(CheckpointError):  # it has ended; its children are those of another one now
                found += map(int, procfs.read_bytes(pid, f"task/{tid}/children").split())
    return found


def ancestors(pid: int) -> list[int]:
    """Its parent, whose parent, and so on, as far as we see them."""
    found: list[int] = []
    with contextlib.suppress(CheckpointError):
        while pid := procfs.stat(pid).ppid:
            found.append(pid)
    return found


def _descriptors_of(pid: int) -> list[int]:
    """The numbers of its descriptors; of one that has ended nothing."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return list(map(int, os.listdir(f"/proc/{pid}/fd")))
    return []


def _circles(pids: Iterable[int]) -> set[int]:
    """The sessions and process groups of processes; of one that has ended nothing."""
    found: set[int] = set()
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            found |= {os.getsid(pid), os.getpgid(pid)}
    return found - {0}


def _given_to(ancestor: int, pid: int) -> set[int]:
    """By which circles a child of an ancestor may be known as a stray: in its own session a shell makes groups of its jobs."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        session = os.getsid(pid)
        return {session} if session == os.getsid(ancestor) else _circles([pid])
    return set()


def _exists(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


def reaper_of(pid: int, *, is_guarded: bool) -> int:
    """The process that gets the orphans of a component; 0: none that we know.

    Args:
        is_guarded: its parent is its guard, which has no other children.
    """
    status = procfs.status(pid)
    if len(status.pids) > 1:
        return next((other for other in children(status.ppid) if _is_first_of_namespace(other, pid)), 0)
    return status.ppid if is_guarded else 0


def _is_first_of_namespace(other: int, pid: int) -> bool:
    try:
        return procfs.status(other).pids[-1] == 1 and _namespace(other) == _namespace(pid)
    except (CheckpointError, OSError):
        return False


def _namespace(pid: int) -> str:
    return os.readlink(f"/proc/{pid}/ns/pid")


def taken_pids(pid: int) -> Callable[[int], bool]:
    """Whether a pid is in use where a process lives; a process in a PID namespace of its own shares it with no stranger."""
    is_apart = len(procfs.status(pid).pids) > 1
    return lambda number: not is_apart and os.path.exists(f"/proc/{number}")


def others(pid: int, reaper: int) -> list[int]:
    """As `Kinship.others`, asked once."""
    kin = Kinship(pid, reaper)
    try:
        return kin.others()
    finally:
        kin.close()


def component(pid: int) -> list[int]:
    """All processes of the component of an unguarded process, without itself, parents before children."""
    return others(pid, reaper_of(pid, is_guarded=False))
