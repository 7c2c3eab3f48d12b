"""Stores the state beside the program: in a crash-safe folder that takes every commit with which it can keep up.

It is a store like an agent's, filled from the same segment by the same engine. A thread of the program writes it; the program
itself never waits for the disk. Where commits come faster than the disk, the thread writes the newest and skips those between.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from checkpoint.engine import CaptureOrder
from checkpoint.engines.cooperative.session import CooperativeSession
from checkpoint.errors import CheckpointError, SegmentBusyError, StoreError
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Snapshot
from checkpoint.sentences import in_words
from checkpoint.snapshot import format
from checkpoint.store.disk import Disk
from checkpoint.store.store import open_store
from failover.errors import NotCommittedError, StateTakenError, TaskError

if TYPE_CHECKING:
    from checkpoint.store.contract import SnapshotStore
    from failover.kept_state.state import KeptState

log = logging.getLogger("failover.task")

SUFFIX: Final = ".state"
SMALL_PAGES: Final = 64
"""A state of no more pages is written whole each time: one file is read at a restart, none is folded."""
REST_PART: Final = 9
"""After a write the thread rests this many times as long as it took: it takes a tenth of a processor, and of Python, at most…"""
REST_S_MAX: Final = 0.1
"""…but not longer than this, the most that a crash loses of a program that commits without pause."""
TIDY_S: Final = 5.0
"""Between two looks whether the deltas of a large state have become too many; the chain grows by the writes meanwhile."""
RETRY_S: Final = 0.5
"""After a write that failed."""
LOOK_S: Final = 1.0
"""How often a waiting thread looks whether the writing thread still lives."""

_LEARNING: Final = threading.Lock()
"""Held while the thread loads modules and builds decoders for the first time: a child that is forked in the middle
of that would have them half built, for ever, and end by SIGSEGV at its own first write."""
os.register_at_fork(before=_LEARNING.acquire, after_in_parent=_LEARNING.release, after_in_child=_LEARNING.release)


def folder_of(name: str, directory: Path) -> Path:
    """Where the state of a component lies: ``/lab/r1/mapper`` in ``lab.r1.mapper.state``."""
    return directory / (name.strip("/").replace("/", ".") + SUFFIX)


class StateFile:
    """One component's folder. Used by one thread at a time.

    Raises:
        StateTakenError: another process has it.
        TaskError: it cannot be used, or holds the state of something else.
    """

    def __init__(self, folder: Path, component: str, disk: Disk | None = None) -> None:
        self.component = component
        self.folder = folder
        try:
            self._store: SnapshotStore = open_store(folder, disk)
        except StoreError as error:
            if "another process" in str(error):
                raise StateTakenError(
                    f"cannot keep {component} in {folder}: another process has it; end that one, or use another name"
                ) from None
            raise TaskError(f"cannot keep {component} in {folder}: {error}") from error
        strangers = [name for name in self._store.components() if name != component]
        if strangers:
            self._store.close()
            raise TaskError(
                f"cannot keep {component} in {folder}: it holds the state of {strangers[0]}; use another name or folder"
            )
        newest = self._store.newest(component)
        self.generation = newest.generation + 1 if newest else 1
        self._sequence = 0
        self._has_learnt = False
        self._is_small = True
        self._tidied = time.monotonic()
        self._is_closed = False

    @property
    def notices(self) -> tuple[str, ...]:
        """Files found damaged or left over: one sentence each."""
        return tuple(self._store.notices)

    def load(self) -> Snapshot | None:
        """The newest state that is intact; None where there is none.

        Raises:
            TaskError: there was one, and nothing of it is intact.
        """
        if self._store.newest(self.component) is None and not any(self.folder.glob("@*/*.base")):
            return None
        try:
            return self._store.load(self.component)
        except StoreError as error:
            why = "; ".join(self.notices) or str(error)
            raise TaskError(f"cannot resume {self.component}: {why}; to begin anew, move {self.folder} away") from error

    def write(self, session: CooperativeSession) -> int:
        """Keep the newest commit; when this returns it survives a power cut.

        Returns:
            The number of the commit that is safe now.

        Raises:
            CheckpointError: it was not written; the state kept before is intact.
        """
        is_small = session.reader.layout.page_count <= SMALL_PAGES
        order = CaptureOrder(base=is_small or self._sequence == 0, generation=self.generation, sequence=self._sequence + 1)
        with contextlib.nullcontext() if self._has_learnt else _LEARNING:
            snapshot = session.capture(order)
            descriptor = memfd_holding(format.encode_bytes(snapshot), "state")
            if not self._has_learnt:
                format.read_outline(descriptor)  # as the store will, but without the disk: no thread that forks waits for that
                self._has_learnt = True
        try:
            self._store.put(descriptor, prove=False)
        finally:
            os.close(descriptor)
        self._sequence += 1
        session.acknowledge(snapshot.position)
        self._is_small = is_small
        return session.commit_at(snapshot.position)

    def tidy(self) -> None:
        """Forget commits older than the newest. Of a large state seldom: its deltas become a new base then, which is all of it.

        Raises:
            CheckpointError: the disk does not take that base; nothing was forgotten.
        """
        now = time.monotonic()
        if self._is_small or now >= self._tidied + TIDY_S:
            self._tidied = now
            self._store.keep_newest(self.component, 1)

    def close(self) -> None:
        """Let another process have it; nothing else may be called afterwards."""
        if not self._is_closed:
            self._is_closed = True
            self._store.close()


class Recorder:
    """The thread that writes the newest commit to the file, again and again.

    Attributes:
        durable: number of the newest commit that survives a power cut.
        trouble: why the last write failed; "" while all is well.
    """

    def __init__(self, state: KeptState, file: StateFile) -> None:
        self._state = state
        self._file = file
        self.durable = 0
        self.trouble = ""
        self._session: CooperativeSession | None = None
        self._fresh = threading.Event()
        self._hurry = threading.Event()
        self._written = threading.Condition()
        self._is_closing = False
        self._told = -1
        self._thread = threading.Thread(target=self._record, name="failover-recorder", daemon=True)
        self._pid = os.getpid()

    def notice(self, _: int) -> None:
        """There is a new commit."""
        if not self._fresh.is_set():
            self._fresh.set()
            if self._thread.ident is None:
                self._thread.start()

    def fileno(self) -> int:
        """Can be read after a write, once; `hear` reads it."""
        if self._told < 0:
            self._told = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        return self._told

    def hear(self) -> int:
        """The number of the newest commit that is safe; the thread makes haste until the newest is."""
        if self._told >= 0:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._told)
        if self.durable < self._state.number:
            self._hurry.set()
        return self.durable

    def wait(self, number: int, timeout: float | None) -> None:
        """Return when commit ``number`` is safe.

        Raises:
            NotCommittedError: it is not, in time; says why.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._written:
            while self.durable < number:
                self._hurry.set()
                left = None if deadline is None else deadline - time.monotonic()
                if self._thread.ident is not None and not self._thread.is_alive():
                    raise NotCommittedError(f"commit {number} is not safe: the thread that writes {self._file.folder} has ended")
                if left is not None and left <= 0:
                    why = self.trouble or f"the disk has taken commit {self.durable}"
                    raise NotCommittedError(f"commit {number} is not safe after {timeout} s: {why}")
                self._written.wait(LOOK_S if left is None else min(left, LOOK_S))

    def close(self) -> None:
        """Write the newest commit, end the thread, let the file go."""
        if os.getpid() != self._pid:
            return
        self._is_closing = True
        self._hurry.set()
        self._fresh.set()
        if self._thread.ident is not None:
            self._thread.join()
        if self._session is not None:
            self._session.close()
        self._file.close()
        if self._told >= 0:
            os.close(self._told)
            self._told = -1

    def _record(self) -> None:
        while not (self._is_closing and self.durable >= self._state.number):
            self._fresh.wait()
            self._fresh.clear()
            began = time.monotonic()
            rest = RETRY_S
            if self._write_newest() and self._tidy():
                rest = min(REST_PART * (time.monotonic() - began), REST_S_MAX)
            elif self._is_closing:
                return
            else:
                self._fresh.set()
            self._hurry.wait(rest)
            self._hurry.clear()

    def _write_newest(self) -> bool:
        """Whether the newest commit is safe now."""
        try:
            if self._session is None:
                self._session = CooperativeSession(self._state.open_reader(), os.getpid(), self._file.component)
            elif self._session.reader.is_superseded:
                self._session.go_on_in(self._state.open_reader())
            durable = self._file.write(self._session)
        except SegmentBusyError:
            return False
        except (CheckpointError, OSError) as error:
            return self._failed(error)
        with self._written:
            self.durable, self.trouble = durable, ""
            self._written.notify_all()
        if self._told >= 0:
            os.eventfd_write(self._told, 1)
        return True

    def _tidy(self) -> bool:
        try:
            self._file.tidy()
        except (CheckpointError, OSError) as error:
            return self._failed(error)
        return True

    def _failed(self, error: Exception) -> bool:
        if (trouble := in_words(error)) != self.trouble:
            log.warning("a commit was not written; the program continues: %s", trouble)
        self.trouble = trouble
        return False
