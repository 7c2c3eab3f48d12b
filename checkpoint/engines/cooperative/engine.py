"""The cooperative engine behind a keeper: a program under a guard. Each capture looks up the program's current segment.

A program that has just started has committed nothing yet, and a program whose state grows continues in another segment. So the
engine asks the program for nothing, and each capture looks where the commits go now.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from checkpoint.engine import (
    COOPERATIVE,
    NOTED,
    CaptureOrder,
    Copy,
    Finding,
    ProtectOrder,
    Report,
    Restored,
    RestoreOptions,
    Session,
)
from checkpoint.engines.cooperative import program_files
from checkpoint.engines.cooperative.session import CooperativeSession, now, open_segment
from checkpoint.engines.stream_output import Outputs
from checkpoint.errors import CaptureError, ProcessGoneError, RestoreError, UnsupportedError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import spokesman_of, told_by_spokesman
from checkpoint.model import Position, Snapshot
from checkpoint.program import epoch_variable
from checkpoint.resources.carried import capture as carried_capture
from checkpoint.resources.carried.capture import CarriedTrees
from checkpoint.resources.process import thread_credentials
from checkpoint.snapshot.required_files import program_of
from checkpoint.store.content_store import DIGEST_SIZE, digest_of_file, path_in
from checkpoint.store.digest_cache import DigestOf

if TYPE_CHECKING:
    from checkpoint.store.base_on_disk import StoredBase

LOOK_S: Final = 10.0
"""Between two looks at the files that a program is started again from."""


class GuardedTask:
    """See `checkpoint.engine.Session`."""

    notes: tuple[str, ...] = ()

    def __init__(self, pid: int, order: ProtectOrder) -> None:
        self.pid = pid
        self.component = order.component
        self._outputs = Outputs(order.streams) if order.streams else None
        self._session: CooperativeSession | None = None
        self._terms = order.terms
        self._trees: CarriedTrees | None = None
        self._look_at_s = 0.0
        self._epoch = 0

    @property
    def totals(self) -> tuple[int, int]:
        """See `checkpoint.engine.Session.totals`."""
        return self._session.totals if self._session else (0, 0)

    def capture(self, order: CaptureOrder) -> Snapshot:
        """See `checkpoint.engine.Session.capture`."""
        if procfs.status(self.pid).has_ended:
            raise ProcessGoneError(f"the process of {self.component} that keeps its state (pid {self.pid}) has ended")
        self._require_rights()
        session = self._following()
        if order.epoch > self._epoch:
            self._tell_epoch(order.epoch)
        if order.base or time.monotonic() >= self._look_at_s:
            self._look_at_s = time.monotonic() + LOOK_S
            arguments, directory = session.process.arguments, session.process.working_directory
            program = program_files.describe(spokesman_of(self.pid), self.component, arguments, directory, self._terms.owner)
            session.program = (program,) if program is not None else ()
        captured = session.capture(order)
        self._require_rights()  # it runs meanwhile
        return captured

    def _require_rights(self) -> None:
        """Raises UnsupportedError: it has rights that are not its owner's."""
        if reasons := thread_credentials.refuse(self.pid, self._terms.owner):
            raise UnsupportedError(f"cannot capture {self.component} (pid {self.pid}): {reasons[0]}", reasons)

    def _tell_epoch(self, epoch: int) -> None:
        """As the other engine does: the program finds in its environment what `Begin` could not tell yet."""
        self._epoch = epoch
        stat = procfs.stat(self.pid)
        with contextlib.suppress(CaptureError):  # its memory is not ours to write: `failover handover` tells it
            epoch_variable.renew(Memory(self.pid), stat.env_start, stat.env_end, epoch)

    def capture_standing(self, order: CaptureOrder) -> Snapshot:
        """See `checkpoint.engine.Session.capture_standing`: its segment holds the committed state, also while it runs."""
        return self.capture(order)

    @property
    def frozen_size(self) -> int:
        """Nothing is copied while it stands still: it never does."""
        return 0

    def unchanged(self, epoch: int) -> Position | None:
        """See `checkpoint.engine.Session.unchanged`."""
        if self._session is None or self._session.reader.is_superseded or procfs.status(self.pid).has_ended:
            return None
        return self._session.unchanged()

    def commit_at(self, position: Position) -> int:
        """The number of the commit that a capture holds; 0 if it is none of the last ones."""
        return self._session.commit_at(position) if self._session else 0

    def age_ns(self, position: Position) -> int:
        """How old the commit is that a capture holds."""
        return max(now().boottime_ns - self._session.committed_ns(position), 0) if self._session else 0

    def acknowledge(self, position: Position) -> None:
        """See `checkpoint.engine.Session.acknowledge`."""
        if self._session:
            self._session.acknowledge(position)

    def open_file(self, path: str, digest: bytes) -> int:
        """See `checkpoint.engine.Session.open_file`."""
        try:
            return program_files.open_file(spokesman_of(self.pid), path, self._terms.owner)
        except OSError as error:
            raise CaptureError(f"cannot open {path} of {self.component}: {error.strerror}") from error

    def close(self) -> None:
        """See `checkpoint.engine.Session.close`."""
        if self._session:
            self._session.close()
        if self._outputs:
            self._outputs.close()
        if self._trees:
            self._trees.close()
        self._session = self._outputs = self._trees = None

    def _following(self) -> CooperativeSession:
        """The session, on the segment that commits go to now.

        Raises:
            CaptureError: there is none.
        """
        if self._session is None:
            reader, trees = told_by_spokesman(self.pid, open_segment), self._follow_files()
            self._session = CooperativeSession(reader, self.pid, self.component, self._outputs, trees)
        elif self._session.reader.is_superseded:
            self._session.go_on_in(told_by_spokesman(self.pid, open_segment))
        return self._session

    def _follow_files(self) -> CarriedTrees | None:
        """Follow the carried files, if there are any.

        Raises:
            UnsupportedError: they cannot be carried.
        """
        if self._trees is None and self._terms.carry.paths:
            trees = told_by_spokesman(self.pid, lambda tid: carried_capture.followed(tid, self._terms))
            assert trees is not None, "it has paths"
            if reasons := trees.refuse():
                trees.close()
                raise UnsupportedError(f"cannot capture {self.component}: {'; '.join(reasons)}", reasons)
            self._trees = trees
        return self._trees


def _is_brought(options: RestoreOptions, digest: bytes) -> bool:
    return bool(options.contents) and len(digest) == DIGEST_SIZE and path_in(options.contents, digest).exists()


class CooperativeEngine:
    """See `checkpoint.engine.Engine`. To restore is to start a program again with what `fill_segment` makes."""

    name = COOPERATIVE

    def probe(self, pid: int) -> Report:
        """See `checkpoint.engine.Engine.probe`: nothing stands in the way of a program that keeps its state itself."""
        arguments = told_by_spokesman(pid, lambda tid: procfs.read_bytes(tid, "cmdline")).rstrip(b"\0").split(b"\0")
        command = " ".join(word.decode(errors="replace") for word in arguments)
        text = "a restore starts the program again from its newest commit; nothing else comes back"
        return Report(pid, command, 0, "versions", (Finding("process", f"pid {pid}", NOTED, text),))

    def protect(self, pid: int, order: ProtectOrder) -> Session:
        """See `checkpoint.engine.Engine.protect`."""
        return GuardedTask(pid, order)

    def lacks(self, outline: Snapshot, options: RestoreOptions, digest_of: DigestOf = digest_of_file) -> tuple[str, ...]:
        """See `checkpoint.engine.Engine.lacks`: the files that it is started again from, here or as they were brought."""
        files = program_of(outline)
        gone = [file.path for file in files if not os.path.lexists(file.path) and not _is_brought(options, file.digest)]
        return tuple(f"{path} is missing, from which it is started again: install it here" for path in gone)

    def contested(self, outline: Snapshot, options: RestoreOptions, pid: int, components: Mapping[str, int]) -> tuple[str, ...]:
        """See `checkpoint.engine.Engine.contested`: it opens its files itself, and no restore looks at them."""
        return ()

    def restore(self, vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Restored:
        """Refused: see the class."""
        raise RestoreError(
            f"cannot restore {_component_of(base)} into pid {vessel_pid}: a {COOPERATIVE} program is started again"
        )

    def lay(self, vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Copy:
        """Refused: what waits for such a program is the program itself, started in advance."""
        reason = "it keeps its state itself, and waits started"
        raise UnsupportedError(f"{_component_of(base)} can have no ready copy: {reason}", (reason,))


def _component_of(base: Snapshot | StoredBase) -> str:
    return base.component if isinstance(base, Snapshot) else base.outline.component
