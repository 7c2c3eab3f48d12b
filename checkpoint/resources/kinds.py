"""Which kinds of open files there are, in the order in which they are asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

from checkpoint.model import Fact, Resource
from checkpoint.resources import (
    OpenFile,
    Surroundings,
    devices,
    epolls,
    eventfds,
    files,
    pipes,
    signalfds,
    streams,
    timerfds,
    unsupported,
)


class Kind(Protocol):
    """What every file of this room has; for an open file of another kind both answer None."""

    KIND: str

    def describe(self, held: OpenFile, surroundings: Surroundings, /) -> Resource | None:
        """The open file as facts."""

    def refuse(self, held: OpenFile, surroundings: Surroundings, /) -> str | None:
        """Why it cannot be kept."""


ASKED: Final[tuple[Kind, ...]] = (streams, devices, files, pipes, eventfds, timerfds, signalfds, epolls, unsupported)
"""The last one refuses whatever no other took."""

OBSERVED: Final[Mapping[str, Callable[[OpenFile, Sequence[OpenFile]], Mapping[str, Fact]]]] = {
    timerfds.TARGET: timerfds.observe,
    epolls.TARGET: epolls.observe,
}
"""By the kernel's name for it: what only a process that stands still can tell. Given one open file, and all."""
