"""Errors of the package `checkpoint`: one family of classes for everything that it can refuse or fail at."""

from __future__ import annotations

import contextlib
from typing import Final

UNDECODABLE: Final = (ValueError, RecursionError)
"""The errors of msgspec for bytes that are no message: its own errors and those of text that is not UTF-8 are `ValueError`s."""


class CheckpointError(Exception):
    """Something about capturing, storing or restoring a process did not work.

    The message says what was tried, on what, why not, and what to do about it.
    """


class ProbeError(CheckpointError):
    """This machine or process cannot be looked into at all (no such process, not ours, already traced)."""


class UnsupportedError(CheckpointError):
    """The process holds something that cannot be preserved; it was not touched.

    Attributes:
        reasons: one sentence per thing found, each with what to do about it.
    """

    def __init__(self, message: str, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.reasons = reasons


class CaptureError(CheckpointError):
    """A capture was begun and not finished; the process runs on unharmed and nothing was forgotten."""


class ProcessGoneError(CaptureError):
    """The process ended while it was being looked at."""


class RanOnError(CaptureError):
    """The program did not wait for us any longer, because we got no processor. The next attempt is waited for longer."""


class NothingCommittedError(CaptureError):
    """The program keeps its state itself, and has committed nothing yet: nothing is wrong, there is nothing to capture."""


class RestoreError(CheckpointError):
    """A restore was begun and not finished; nothing of it is left behind."""


class MismatchError(RestoreError):
    """This machine differs from the snapshot's in something the program depends on; nothing was started.

    Attributes:
        reasons: one sentence per difference, each with what to do about it.
    """

    def __init__(self, message: str, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.reasons = reasons


class AuthorError(CheckpointError):
    """Whose word a snapshot's file is cannot be told; nothing of it was restored."""


class FormatError(CheckpointError):
    """Bytes that are not a whole, unaltered snapshot of a version that we read."""


class ChainError(CheckpointError):
    """A delta does not continue the position it is offered to."""


class StoreError(CheckpointError):
    """The snapshot store could not do what was asked; what it already held is intact."""


class MapsFormatError(CheckpointError):
    """A line of /proc/PID/maps is not of the documented form."""


class SegmentError(CheckpointError):
    """A segment is not as SEGMENT.md says, or its program does not keep the rules; nothing of it was used."""


class SegmentBusyError(SegmentError):
    """The newest bank could not be held just now; ask again later."""


class TaskPacketError(CheckpointError):
    """The bytes from a task socket are no packet as TASK.md says; none of them was used."""


def let_go(error: BaseException) -> None:
    """Have an error that was answered hold nothing: the frames that it came through hold memory, and often the error itself."""
    met: set[int] = set()
    waiting: list[BaseException | None] = [error]
    while waiting:
        one = waiting.pop()
        if one is not None and id(one) not in met:
            met.add(id(one))
            step = one.__traceback__
            while step is not None:
                with contextlib.suppress(RuntimeError):  # it runs still
                    step.tb_frame.clear()
                step = step.tb_next
            waiting += (one.__cause__, one.__context__)
