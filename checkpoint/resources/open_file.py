"""One open file of a process, and the facts that the resource kinds need besides it: values only."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Mapping
from typing import Final

from msgspec import Struct, field
from msgspec.structs import astuple, replace

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import NO_TERMS, REFUSED, Finding, Terms
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.model import Fact, Resource
from checkpoint.resources.kernel_listings import Listings

Owners = set[tuple[int, int]]
"""Number and inode of the open files that had an owner at the last look; see `checkpoint.resources.signal_owners`."""


class Kin(Struct, frozen=True):
    """The processes of one component, and what they have among them.

    Attributes:
        pids: of all; none if there is but one.
        sockets: inode numbers of all their sockets.
        pipes: as /proc names them, those of which both ends are theirs.
        terminals: numbers of the pseudo-terminals of which they have the master.
    """

    pids: frozenset[int] = frozenset()
    sockets: frozenset[int] = frozenset()
    pipes: frozenset[str] = frozenset()
    terminals: frozenset[int] = frozenset()


ALONE: Final = Kin()


class Lent:
    """A descriptor of ours that is closed when no object refers to it any more."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __del__(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self.number)


class Signals(Struct, frozen=True):
    """The signals that an open file sends, and their receiver.

    Attributes:
        signal: 0 for SIGIO; ``kind``: F_OWNER_TID, F_OWNER_PID or F_OWNER_PGRP; ``owner``: 0 for none.
    """

    signal: int = 0
    kind: int = 0
    owner: int = 0

    def __bool__(self) -> bool:
        return bool(self.signal or self.owner)


class OpenFile(Struct, frozen=True, eq=False):
    """One open file description and every descriptor that shares it, lowest number first.

    Attributes:
        content: the bytes that wait in a pipe, read while the process stood still; None where that was not needed.
        capacity: of a pipe, in bytes.
        both_ends: of a pipe: the process itself has another descriptor for its other end, or no process has.
        is_its_own: the former alone.
        observed: facts that only the process standing still could tell, as its kind's ``observe`` found them.
        kin: the other processes of its component.
        description: the number of an open file that several processes of a component share (`shared_descriptions`); 0: of
            this one alone.
        is_echo: another process of the component has told of it already.
        lent: through which it is looked at, if it is on its way to the program (`scm_rights`); ``pid`` is ours then.
        owners: the known owners of signals, of a process that is looked at again and again.
        signals: the signals that it sends, if that was asked while the process stood still; else none, or it is asked now.
    """

    pid: int
    descriptors: tuple[Descriptor, ...]
    content: bytes | None = None
    capacity: int = 0
    both_ends: bool = False
    is_its_own: bool = False
    observed: Mapping[str, Fact] = field(default_factory=dict)
    kin: Kin = ALONE
    description: int = 0
    is_echo: bool = False
    lent: Lent | None = None
    owners: Owners | None = None
    signals: Signals | None = None

    def __eq__(self, other: object) -> bool:
        """Compare all but the known owners: they do not make it another open file."""
        return isinstance(other, OpenFile) and astuple(replace(self, owners=None)) == astuple(replace(other, owners=None))

    __hash__ = None  # type: ignore[assignment]

    @property
    def first(self) -> Descriptor:
        """The descriptor that speaks for all."""
        return self.descriptors[0]

    @property
    def name(self) -> str:
        """Its name in reports."""
        return self.first.name

    @property
    def numbers(self) -> list[Fact]:
        """[number, 1 if close-on-exec] of each."""
        return [[one.number, int(bool(one.flags & os.O_CLOEXEC))] for one in self.descriptors]


class Surroundings(Struct, frozen=True):
    """The facts about the process's guard that the kinds must know.

    Attributes:
        pipes: "pipe:[123]" or a terminal's path → stream 0, 1 or 2: of a component under a guard, or what its first process has.
        devices: the operator's rules for devices.
        connections: TCP connections with others go along where it is handed over.
        is_first: it is about the first process of a component.
        detached: by device and inode number, the shared memory that becomes the program's own copy, and how much of it, from its
            beginning on, the component has mapped; None where the operator's rules say that such a program is refused.
        terms: the operator's other rules.
        may_repeat: the program may go on from an older state than its last output, as after a takeover: unlike a restore of what
            stood still for good.
    """

    pipes: Mapping[str, int] = field(default_factory=dict)
    devices: tuple[DeviceRule, ...] = ()
    connections: bool = False
    is_first: bool = True
    detached: Mapping[tuple[int, int], int] | None = None
    terms: Terms = NO_TERMS
    may_repeat: bool = True


class Held(Struct, frozen=True):
    """The resources behind a process's descriptors, and the findings about them."""

    resources: tuple[Resource, ...]
    findings: tuple[Finding, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it cannot be captured as it is."""
        return tuple(finding.text for finding in self.findings if finding.verdict == REFUSED)


class Recalled(Struct, frozen=True):
    """The facts of a socket that answers as at the last look.

    Attributes:
        settings: facts that follow from what the program has set.
        whole: the open file with all that was observed, where everything is as it was.
    """

    settings: Mapping[str, Fact]
    whole: OpenFile | None = None


class Opened(tuple[OpenFile, ...]):
    """All open files of a process, one entry for those that share one; and facts that are asked once for many of them."""

    @functools.cached_property
    def listings(self) -> Listings:
        """The kernel's lists, read once for all of them."""
        return Listings()

    @functools.cached_property
    def recalled(self) -> dict[int, Recalled]:
        """Sockets that are, in part at least, as they were at the last look, by their descriptors."""
        return {}

    @functools.cached_property
    def travelling(self) -> list[OpenFile]:
        """Open files on their way to the process and not open in it, as far as they were found."""
        return []

    @functools.cached_property
    def inodes(self) -> frozenset[int]:
        """Their numbers."""
        return frozenset(one.first.inode for one in self)
