"""Starts versions of one program in threads, so that their host answers meanwhile: an import may take a minute.

One thread warms the version that a person ordered; another one starts the version anew that ended by itself. The host takes what
came of it between two messages.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from msgspec import Struct

from failover.core.messaging.envelope import Envelope
from failover.core.programs.trial import Command
from failover.errors import FailoverError
from failover.kept_state.api import RESTARTED, Resumed
from failover.programs.running import Running, Source
from failover.programs.sources import Place

log = logging.getLogger("failover.programs")


class Revival(Struct, frozen=True):
    """What came of a start anew: the version with its state, or ``why`` it cannot run, "" where that is a mistake of ours."""

    running: Running | None
    why: str = ""


class Starter:
    """The two threads, and the versions that they have started and the host has not taken yet."""

    def __init__(
        self, place: Place, resumed: Callable[[str], Resumed], say: Callable[[str], None], wake: Callable[[], None]
    ) -> None:
        """
        Args:
            resumed: where a state comes from that a version gets, for the reason why. say: tells users, from a thread, too.
            wake: called when there is something to be taken.
        """
        self._place, self._resumed, self._say, self._wake = place, resumed, say, wake
        self._warmer = ThreadPoolExecutor(1, "starts versions")
        self._reviver = ThreadPoolExecutor(1, "starts versions anew")
        self._loading: set[Running] = set()
        self._coming: Running | None = None
        self._revival: Revival | None = None
        self.is_warming = False
        self.is_reviving = False
        """Until `revived` has told what came of it."""
        self._is_closing = False

    @property
    def has_news(self) -> bool:
        """Whether `warmed` or `revived` has something."""
        return self._coming is not None or self._revival is not None

    def aside(self, call: Callable[[], object]) -> None:
        """In the thread that warms versions: what may take its time, and no message waits for."""
        self._warmer.submit(call)

    def warm(self, source: Callable[[], Source]) -> None:
        """Load a version; `warmed` gives it out."""
        self.is_warming = True

        def warmed() -> None:
            try:
                self._coming = self._loaded(source())
            except FailoverError as error:
                self._say(f"it stays as it was: {error}")
            except Exception as error:  # the sentence must not be lost in a thread
                log.exception("a version could not be started")
                self._say(f"it stays as it was: {type(error).__name__}: {error}")
            finally:
                self.is_warming = False
                self._wake()

        self._warmer.submit(warmed)

    def warmed(self) -> Running | None:
        """The version that is warm, once."""
        coming, self._coming = self._coming, None
        return coming

    def revive(self, source: Source, state: Any, owed: Sequence[Command]) -> None:
        """Start a version anew with its last state, and have it carry out what it owes, without answers."""
        self.is_reviving = True
        self._reviver.submit(self._revive, source, state, owed)

    def revived(self) -> Revival | None:
        """What came of it, once."""
        if self._revival is None:
            return None
        revival, self._revival = self._revival, None
        self.is_reviving = False
        return revival

    def _revive(self, source: Source, state: Any, owed: Sequence[Command]) -> None:
        running, why = None, ""
        try:
            if source.digest:  # a key or a right may have gone since it was started
                self._place.store.admitted(source.digest, self._place.team)
            running = self._begun(source, state)
            for command in owed:
                try:
                    running.state = again(running, command)
                except FailoverError as error:
                    self._say(f"{command.verb} is left out: {error}")
                    left, running = running, None
                    left.end()
                    running = self._begun(source, left.state)
        except FailoverError as error:
            why = str(error)
            self._say(f"it cannot be started anew: {error}")
        except Exception as error:  # the sentence must not be lost in a thread
            log.exception("a version could not be started anew")
            self._say(f"it cannot be started anew: {type(error).__name__}: {error}")
        finally:
            self._revival = Revival(running, why)
            self._wake()

    def _begun(self, source: Source, state: Any) -> Running:
        """A new process of a version, with this state.

        Raises:
            ProgramError: it cannot be loaded, or cannot read the state.
        """
        running = self._loaded(source)
        try:
            running.begin(state, self._resumed(RESTARTED))
        except FailoverError:
            running.end()
            raise
        return running

    def _loaded(self, source: Source) -> Running:
        """A new process of a version, warm; `end_soon` ends it before that."""
        running = Running(source, self._wake)
        self._loading.add(running)
        try:
            if self._is_closing:
                running.end()
            return running.load()
        finally:
            self._loading.discard(running)

    def end_soon(self) -> None:
        """What is being loaded ends."""
        self._is_closing = True
        for loading in tuple(self._loading):
            loading.end()

    def close(self) -> tuple[Running | None, ...]:
        """Wait for the threads; what they started is left to be ended. A version dies with the thread that started it."""
        for thread in (self._warmer, self._reviver):
            thread.shutdown(wait=True)
        return self._coming, self._revival.running if self._revival is not None else None


def again(running: Running, command: Command) -> Any:
    """The state after a command that is carried out once more.

    Raises:
        ProgramError: its process ended, hangs, or said what is no answer.
    """
    return running.call(Envelope(verb=command.verb, body=command.body)).state
