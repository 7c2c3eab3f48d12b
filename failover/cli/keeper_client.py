"""Keeper for one command: starts the tracer's process, asks it, and ends it with the command.

The one-shot verbs use the same program as the agent, so that python-ptrace is never in this process.
"""

from __future__ import annotations

import contextlib
import os
import select
from typing import IO, TypeVar

import msgspec

from checkpoint import errors
from checkpoint.errors import CheckpointError, MismatchError, UnsupportedError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Channel, ChannelClosedError, Failed, Release, Released, Reply
from failover.cli import keeper_prestart

LEAVE_S = 10.0
"""How long a keeper that was hung up on may take to let go of its tracee."""

A = TypeVar("A", bound=msgspec.Struct)


class Keeper:
    """One keeper process and our end of its channel. A context manager; leaving it lets go of the tracee."""

    def __init__(self, process: keeper_prestart.Child, link: Channel[Reply], complaints: IO[bytes]) -> None:
        self._process = process
        self._link = link
        self._complaints = complaints
        self._is_released = False

    @classmethod
    def spawn(cls) -> Keeper:
        """One of our own, which may have been started ahead."""
        process, ours, complaints = keeper_prestart.taken()
        return cls(process, Channel(ours, Reply), complaints)

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._process.pid

    def ask(self, request: msgspec.Struct, wanted: type[A], descriptors: tuple[int, ...] = ()) -> tuple[A, tuple[int, ...]]:
        """Send one request and wait for its answer: it, and the descriptors that came with it, now ours.

        Raises:
            CheckpointError: of the class that the keeper names, or that it went away.
        """
        try:
            self._link.send(request, descriptors)
            answer, found = self._link.receive()
        except ChannelClosedError as error:
            raise CheckpointError(
                f"the keeper (the tracer's process) ended during {type(request).__name__}; the program runs on, "
                f"unharmed. It said: {self._last_words()}"
            ) from error
        if isinstance(answer, Failed):
            messages.close_all(found)
            raise as_error(answer)
        if not isinstance(answer, wanted):
            messages.close_all(found)
            raise CheckpointError(f"the keeper answered {type(request).__name__} with {type(answer).__name__}; same version?")
        return answer, found

    def tell(self, request: msgspec.Struct) -> None:
        """Send a request that has no answer.

        Raises:
            ChannelError: the keeper has gone.
        """
        self._link.send(request)

    def _last_words(self) -> str:
        """The last line that it wrote to standard error."""
        self._process.wait(LEAVE_S)
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "nothing"

    def release(self) -> None:
        """Have it let go of the program that it follows, and leave it to its end: the more memory it held, the longer that takes.

        For a command, which ends soon itself: no process reaps it.
        """
        with contextlib.suppress(CheckpointError):  # the program that it followed has been killed: nothing is left to let go of
            self.ask(Release(), Released)
        self._complaints.close()
        self._link.close()
        self._is_released = True

    def close(self) -> None:
        """Hang up, and wait until it has let go."""
        if self._is_released:
            return
        self._complaints.close()
        self._link.close()
        with contextlib.suppress(ProcessLookupError):  # no other process reaps it
            end = os.pidfd_open(self._process.pid)
            try:
                if not select.select([end], [], [], LEAVE_S)[0]:
                    self._process.kill()
            finally:
                os.close(end)
        self._process.wait()

    def __enter__(self) -> Keeper:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ChannelClosedError):
            self.close()


def as_error(failed: Failed) -> CheckpointError:
    """The error that a keeper told of, as it was raised there."""
    kind = getattr(errors, failed.error, CheckpointError)
    if kind in (UnsupportedError, MismatchError):
        return kind(failed.message, failed.reasons)
    return (
        kind(failed.message) if isinstance(kind, type) and issubclass(kind, CheckpointError) else CheckpointError(failed.message)
    )
