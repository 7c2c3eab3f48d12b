"""Client of one component's keeper: gets one, has it follow a process, asks it about the process, notices its loss."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import Any

from agent.errors import KeeperLostError
from agent.system.threads import to_its_end
from agent.worker.components.paths import Places
from agent.worker.components.process_pool import KeeperLink
from checkpoint import errors
from checkpoint.engine import NO_TERMS
from checkpoint.errors import CheckpointError, RestoreError, StoreError, UnsupportedError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Failed, close_all


class Following:
    """A keeper may be there or not, and follow a process or not yet.

    Attributes:
        followed: engine and pid; None while nothing is followed.
        terms: under which.
        names: by which the program knows those of its files that were brought here, by their paths here.
        spare: descriptor of an empty file, for its next large snapshot; or none.
    """

    def __init__(self, name: str, places: Places) -> None:
        self.followed: tuple[str, int] | None = None
        self.terms = NO_TERMS
        self.names: dict[str, str] = {}
        self._name = name
        self._places = places
        self._link: KeeperLink | None = None
        self._wanted = self._remembered = 0
        self._is_large = True  # as long as nothing is known
        self.spare: tuple[int, ...] = ()

    @property
    def is_there(self) -> bool:
        """Whether there is a keeper that listens."""
        return self._link is not None and self._link.dialogue.open

    @property
    def pid(self) -> int:
        """Of the keeper that listens; 0: there is none."""
        return self._link.pid if self._link is not None and self._link.dialogue.open else 0

    async def give(self) -> KeeperLink:
        """Have a keeper that follows nothing yet.

        Raises:
            KeeperLostError: none can be had.
        """
        self._link, self.followed = await self._places.process_pool.keeper(), None
        self._remembers_nothing()
        return self._link

    async def follow(self, engine: str, pid: int, streams: tuple[int, ...]) -> tuple[str, ...]:
        """Have the keeper, which follows nothing, follow a process; its notes.

        If it refuses it has touched nothing; if it fails it ends.

        Raises:
            UnsupportedError, CheckpointError; KeeperLostError.
        """
        order = messages.Protect(pid, self._name, bool(streams), self._places.robot, engine, self.terms, self.names)
        try:
            protected, _ = await self.ask(order, streams)
        except UnsupportedError:
            raise
        except (CheckpointError, KeeperLostError):
            self.drop()
            raise
        self.followed = engine, pid
        return tuple(protected.notes)

    async def ask(self, request: Any, descriptors: tuple[int, ...] = ()) -> Any:
        """The keeper's reply, and descriptors that are ours now.

        Raises:
            CheckpointError: it failed, by its own error; KeeperLostError.
        """
        if self._link is None:
            raise KeeperLostError(f"{self._name} has no keeper; protect it first")
        reply, received = await self._link.dialogue.ask(request, descriptors)
        if isinstance(reply, Failed):
            raise _failure(reply)
        return reply, received

    def tell(self, message: messages.Acknowledge) -> None:
        """Say something that has no answer, if it listens."""
        if self._link is not None and self._link.dialogue.open:
            self._link.dialogue.tell(message)

    async def let_loose(self) -> None:
        """Have the keeper let go of the component that it follows, if it is there; it may follow another one then."""
        self._remembers_nothing()
        if self.is_there:
            self.followed = None
            await self.ask(messages.Release())

    def drop(self) -> None:
        """The keeper ends, and lets go of the component that it follows."""
        self._remembers_nothing()
        close_all(self.take_spare())
        link, self._link, self.followed = self._link, None, None
        if link is not None:
            link.end()

    async def lend(self, unnamed: Callable[[], int]) -> None:
        """Have a spare file, unless its last base was small. A keeper with the rights of a user gets none: it could write to what
        is stored.

        Args:
            unnamed: makes one, in a thread; raises StoreError.
        """

        def make() -> None:
            self.spare = (unnamed(),)

        if not self.spare and self._is_large and self.terms.owner is None:
            with contextlib.suppress(StoreError):  # memory will do
                await to_its_end(make)

    @contextlib.contextmanager
    def lending(self) -> Iterator[tuple[int, ...]]:
        """The spare file, if there is one, for a capture in the body, also if the keeper is let go meanwhile.

        Afterwards it is the caller's to close where the snapshot was written to it. One that is still empty is the spare again.
        After a capture that failed it may hold a part, and so it goes.
        """
        spare = self.take_spare()
        try:
            yield spare
        except BaseException:
            close_all(spare)
            raise
        if spare and not os.fstat(spare[0]).st_size:
            if self.is_there and not self.spare:
                self.spare = spare
            else:
                close_all(spare)

    def take_spare(self) -> tuple[int, ...]:
        """The spare file, if there is one; the caller's to close."""
        spare, self.spare = self.spare, ()
        return spare

    def share(self) -> int:
        """Bytes in which the keeper may remember pages, from its next capture on."""
        return self._places.budget.share(self._name, self._wanted, self._remembered)

    def note(self, captured: messages.Captured) -> None:
        """Note how much it remembers after a capture, and whether the next base may be large."""
        if captured.parent is None or captured.dirty_bytes >= messages.LARGE_SIZE:
            self._is_large = captured.dirty_bytes >= messages.LARGE_SIZE
        if not self._is_large:
            close_all(self.take_spare())
        self._wanted, self._remembered = captured.wanted_bytes, captured.remembered_bytes

    def _remembers_nothing(self) -> None:
        self._wanted = self._remembered = 0
        self._places.budget.leave(self._name)


def _failure(failed: Failed) -> CheckpointError:
    """The keeper's error as its own class."""
    kind = getattr(errors, failed.error, RestoreError)
    if issubclass(kind, errors.UnsupportedError | errors.MismatchError):
        return kind(failed.message, failed.reasons)
    return kind(failed.message) if issubclass(kind, CheckpointError) else RestoreError(failed.message)
