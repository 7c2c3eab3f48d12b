"""What a process holds besides memory: one file a kind, each with the same furniture.

``describe`` (an open file that is of this kind, as facts), ``refuse`` (why one cannot be kept), and ``rebuild`` for all of them.
`gather` reads while the process stands still; `look` sorts what was read, afterwards.
"""

from __future__ import annotations

import contextlib
import functools
import os
import stat
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field
from msgspec.structs import astuple, replace

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import KEPT, REFUSED, Finding
from checkpoint.errors import CaptureError
from checkpoint.linux import entry
from checkpoint.linux.descriptors import Descriptor, descriptors
from checkpoint.linux.kept_descriptors import KeptTexts
from checkpoint.model import Fact, Resource
from checkpoint.resources.grouping import Grouping
from checkpoint.resources.listings import Listings

if TYPE_CHECKING:
    from checkpoint.resources.owners import Signals
    from checkpoint.resources.recollection import Recollection
    from checkpoint.resources.sockets import Noted
    from checkpoint.resources.travelling import Lent

Owners = set[tuple[int, int]]
"""Number and inode of the open files that had an owner at the last look; see `checkpoint.resources.owners`."""

STREAM_NUMBERS: Final = (1, 2)
GLANCES_MORE: Final = 3
"""How often a process that runs is looked at again that was in the middle of something."""


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


class OpenFile(Struct, frozen=True, eq=False):
    """One open file description and every descriptor that shares it, lowest number first.

    Attributes:
        content: what waits in a pipe, read while the process stood still; None where that was not needed.
        capacity: of a pipe, in bytes.
        both_ends: of a pipe: the process itself has another descriptor for its other end, or nobody has.
        is_its_own: the former alone.
        observed: facts that only the process standing still could tell, as its kind's ``observe`` found them.
        kin: the other processes of its component.
        description: the number of an open file that several processes of a component share (`sharing`); 0: it is this one's.
        is_echo: another process of the component has told of it already.
        lent: through which it is looked at, if it is on its way to the program (`travelling`); ``pid`` is ours then.
        owners: what is known of who has owners, of a process that is looked at again and again.
        signals: what it sends, to whom, if that was asked while the process stood still; else none, or it is asked now.
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
        """What is known of owners makes no other open file of one."""
        return isinstance(other, OpenFile) and astuple(replace(self, owners=None)) == astuple(replace(other, owners=None))

    __hash__ = None  # type: ignore[assignment]

    @property
    def first(self) -> Descriptor:
        """The descriptor that speaks for all."""
        return self.descriptors[0]

    @property
    def name(self) -> str:
        """What reports call it."""
        return self.first.name

    @property
    def numbers(self) -> list[Fact]:
        """[number, 1 if close-on-exec] of each."""
        return [[one.number, int(bool(one.flags & os.O_CLOEXEC))] for one in self.descriptors]


class Surroundings(Struct, frozen=True):
    """What the kinds must know about the process's guard.

    Attributes:
        pipes: "pipe:[123]" or a terminal's path → stream 0, 1 or 2: of a component under a guard, or what its first process has.
        devices: what the operator wants to become of devices.
        connections: TCP connections with others go along where it is handed over.
        is_first: it is about the first process of a component.
    """

    pipes: Mapping[str, int] = field(default_factory=dict)
    devices: tuple[DeviceRule, ...] = ()
    connections: bool = False
    is_first: bool = True


class Held(Struct, frozen=True):
    """What a process's descriptors are."""

    resources: tuple[Resource, ...]
    findings: tuple[Finding, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it cannot be captured as it is."""
        return tuple(finding.text for finding in self.findings if finding.verdict == REFUSED)


def pipes_of(outputs: Sequence[int]) -> dict[str, int]:
    """How /proc names the other ends of the guard's pipes, standard output first."""
    return {
        os.readlink(f"/proc/self/fd/{descriptor}"): stream for stream, descriptor in zip(STREAM_NUMBERS, outputs, strict=True)
    }


class Recalled(Struct, frozen=True):
    """What a socket answers as it did at the last look.

    Attributes:
        settings: facts that follow from what the program has set.
        whole: the open file with all that was observed, where everything is as it was.
    """

    settings: Mapping[str, Fact]
    whole: OpenFile | None = None


class Opened(tuple[OpenFile, ...]):
    """All open files of a process, one entry for those that share one; and what is asked once for many of them."""

    @functools.cached_property
    def listings(self) -> Listings:
        """What is read once for all of them."""
        return Listings()

    @functools.cached_property
    def recalled(self) -> dict[int, Recalled]:
        """Of sockets that are, in part at least, as they were at the last look, by their descriptors."""
        return {}

    @functools.cached_property
    def travelling(self) -> list[OpenFile]:
        """What is on its way to the process and not open in it, as far as it was found."""
        return []

    @functools.cached_property
    def inodes(self) -> frozenset[int]:
        """Their numbers."""
        return frozenset(one.first.inode for one in self)


class Kept:
    """What is kept of a process that is looked at again and again, so that only what has changed is read anew."""

    def __init__(self, pid: int) -> None:
        self.texts = KeptTexts(pid)
        self.grouping = Grouping(pid)
        self.owners: Owners = set()
        self._groups: tuple[tuple[Descriptor, ...], ...] = ()
        self._opened: tuple[OpenFile, ...] = ()

    def opened(self, groups: tuple[tuple[Descriptor, ...], ...], pid: int) -> tuple[OpenFile, ...]:
        """The open files; the very same where they have not changed."""
        if groups is not self._groups:
            self._groups, self._opened = groups, _opened_of(groups, pid, self.owners)
        return self._opened


def gather(pid: int, kept: Kept | None = None, owners: Owners | None = None) -> Opened:
    """Read every descriptor, and which of them share an open file. For an exact picture the process stands still.

    Args:
        kept: of a process that is looked at again and again.
        owners: of such a process where all else is read anew, see `OpenFile`.
    """
    found = descriptors(pid, kept.texts if kept else None)
    if any(map(entry.is_left_open, found)):  # ours, and closed when it is entered
        found = tuple(one for one in found if not entry.is_left_open(one))
    groups = (kept.grouping if kept else Grouping(pid)).of(found)
    return Opened(kept.opened(groups, pid) if kept else _opened_of(groups, pid, owners))


def _opened_of(groups: Sequence[tuple[Descriptor, ...]], pid: int, owners: Owners | None = None) -> tuple[OpenFile, ...]:
    ends = {(group[0].target, group[0].flags & os.O_ACCMODE) for group in groups}
    other = {os.O_RDONLY: os.O_WRONLY, os.O_WRONLY: os.O_RDONLY}
    own = [(group[0].target, other.get(group[0].flags & os.O_ACCMODE)) in ends for group in groups]
    return tuple(
        OpenFile(pid, group, both_ends=is_own, is_its_own=is_own, owners=owners)
        for group, is_own in zip(groups, own, strict=True)
    )


def with_contents(
    opened: Opened, noted: Noted | None, rules: tuple[DeviceRule, ...] = (), recollection: Recollection | None = None
) -> tuple[OpenFile, ...]:
    """Add the content of every deleted file and of every pipe that is kept, and what else must be asked while it stands still.

    Args:
        noted: see `checkpoint.resources.sockets.queue_of`; None for a process that runs.
        rules: of devices; others are not asked.
        recollection: of a process that is looked at again and again.

    Raises:
        CaptureError: one of them cannot be looked into.
    """
    from checkpoint.resources import attached_devices, files, kinds, owners, pipes

    if recollection and noted is not None and not rules and recollection.are_plain(opened, _is_plain):
        return owners.asked(opened)
    found = []
    empty = recollection.empty_pipes(opened) if recollection and not rules else {}
    for held in _with_travelling(opened, noted, recollection):
        if empty and held.first.number in empty and held.lent is None:
            held = empty[held.first.number]
        elif held.is_echo or held.observed:
            pass
        elif rules and attached_devices.is_ruled(held.first, rules):
            held = replace(held, observed=attached_devices.observe(held, opened))
        elif observe := kinds.observer_of(held.first, noted):
            held = replace(held, observed=observe(held, opened))
        elif files.must_carry(held):
            held = replace(held, observed=files.observe_deleted(held, opened))
        elif pipes.is_pipe(held.first) and (held.both_ends or (_may_be_half(held) and pipes.is_half(held))):
            capacity, pieces = pipes.look_into(held)
            held = pipes.with_content(held, capacity, pieces)
        found.append(held)
    return owners.asked(found) if noted is not None else tuple(found)


def _is_plain(held: OpenFile) -> bool:
    """Whether nothing is to be looked into: what its descriptors say is all that there is. It follows from them alone."""
    from checkpoint.resources import kinds, pipes

    first = held.first
    if held.is_echo or held.lent or held.observed:
        return False
    if pipes.is_pipe(first):
        return not (held.both_ends or _may_be_half(held))
    is_known = stat.S_ISCHR(first.mode) or (stat.S_ISREG(first.mode) and first.links > 0)
    return is_known and kinds.observer_of(first, None) is None


def _with_travelling(opened: Opened, noted: Noted | None, recollection: Recollection | None = None) -> list[OpenFile]:
    """All of them, sockets looked into, and what was found on its way in these."""
    from checkpoint.resources import travelling

    answers = recollection.recall(opened) if recollection else {}
    known = {number: one.whole for number, one in opened.recalled.items() if one.whole is not None}
    found = [
        same if held.lent is None and (same := known.get(held.first.number)) else _looked_into(held, opened, noted)
        for held in opened
    ]
    if recollection:
        recollection.remember(found, answers, opened)
    for held in opened.travelling:  # which grows meanwhile
        found.append(_looked_into(held, opened, noted and travelling.unnoted))
    is_hidden = travelling.may_hide(found, noted)
    if not (opened.travelling or is_hidden):
        return found
    whole = travelling.together(found)
    inodes = {held.first.inode for held in opened.travelling}

    def completed(held: OpenFile) -> OpenFile:
        if held.first.target in whole or (is_hidden and held.first.target.startswith("pipe:")):
            return replace(held, both_ends=True)
        peer = held.observed.get("peer")  # the number of a unix socket; of another kind an address
        is_ours = isinstance(peer, int) and bool(peer) and (is_hidden or peer in inodes)
        return replace(held, observed={**held.observed, "peer_is_ours": True}) if is_ours else held

    return list(map(completed, found))


def _looked_into(held: OpenFile, opened: Opened, noted: Noted | None) -> OpenFile:
    """A socket as it is observed now; as it was where it cannot be, of which whoever asks next is told."""
    from checkpoint.resources import kinds, sockets

    if not held.is_echo and sockets.is_socket(held.first):
        with contextlib.suppress(CaptureError):
            return replace(held, observed=kinds.observe_socket(held, opened, noted=noted))
    return held


def _may_be_half(held: OpenFile) -> bool:
    """Whether it is worth asking: the standard streams of a program that is by itself lead elsewhere."""
    return bool(held.kin.pids) or held.first.number not in (0, *STREAM_NUMBERS)


def glance(pid: int, kin: Kin = ALONE) -> tuple[OpenFile, ...]:
    """Read every descriptor of a process that runs on: enough to tell what is refused.

    What it closes between two of our looks is neither there nor gone: then all is looked at again.

    Args:
        kin: what is known of the other processes of its component.
    """
    from checkpoint.resources import epolls

    found = _glanced(pid, kin)
    for _ in range(GLANCES_MORE):
        if all(map(_is_still_there, found)) and not any(map(epolls.watches_what_is_gone, found)):
            break
        found = _glanced(pid, kin)
    return tuple(filter(_is_still_there, found))


def _is_still_there(held: OpenFile) -> bool:
    try:
        return os.readlink(f"/proc/{held.pid}/fd/{held.first.number}") == held.first.target
    except OSError:
        return not os.path.exists(f"/proc/{held.pid}")  # it has ended as a whole


def _glanced(pid: int, kin: Kin) -> tuple[OpenFile, ...]:
    from checkpoint.resources import kinds, pipes

    opened = Opened(replace(held, kin=kin) for held in gather(pid))
    found = []
    for held in _with_travelling(opened, None):
        if held.observed:
            pass
        elif observe := kinds.observer_of(held.first, None):
            with contextlib.suppress(CaptureError):  # closed meanwhile
                held = replace(held, observed=observe(held, opened))
        elif pipes.is_pipe(held.first) and not held.both_ends and pipes.is_half(held):
            held = replace(held, both_ends=True)
        found.append(held)
    return tuple(found)


def look(opened: Sequence[OpenFile], surroundings: Surroundings) -> Held:
    """Sort one process's open files into the kinds: what comes back, and what does not.

    What can be told only of all processes of a component together is told by `kinds.findings_of_all`.
    """
    from checkpoint.resources import kinds, locks, signalling, travelling

    resources, findings = [], []
    for held in opened:
        of_any = locks.refuse(held) or (None if held.is_echo else signalling.refuse(held))
        for kind in kinds.ASKED:
            if reason := kind.refuse(held, surroundings) or of_any:
                findings.append(Finding(kind.KIND, held.name, REFUSED, reason))
                break
            if resource := kind.describe(held, surroundings):
                of_every = _of_every_kind(held, resource)
                if reason := travelling.refuse(held, kind.KIND, of_every):
                    findings.append(Finding(kind.KIND, held.name, REFUSED, reason))
                    break
                resources.append(replace(resource, facts={**resource.facts, **of_every, **travelling.describe(held)}))
                findings.append(Finding(kind.KIND, held.name, KEPT, f"{held.name} is {held.first.target}"))
                break
    return Held(tuple(resources), tuple(findings))


def _of_every_kind(held: OpenFile, resource: Resource) -> dict[str, Fact]:
    """Facts that any kind may have."""
    from checkpoint.resources import locks, shared, signalling, streams

    if resource.kind == shared.KIND:
        return locks.describe(held, kinds=locks.OF_PROCESSES)
    facts = {**signalling.describe(held), **locks.describe(held)}
    return facts | ({"description": held.description} if held.description and resource.kind != streams.KIND else {})
