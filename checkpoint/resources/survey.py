"""Inspect all open files of a process: `gather` reads them during the freeze; `look` sorts the results into kinds afterwards."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Mapping, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import KEPT, REFUSED, Finding
from checkpoint.errors import CaptureError
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptor_cache import KeptTexts
from checkpoint.linux.procfs.descriptors import descriptors
from checkpoint.linux.trace import entry
from checkpoint.model import Fact, Resource
from checkpoint.resources import registry, shared_open_file, signal_owners
from checkpoint.resources.descriptor_groups import Grouping
from checkpoint.resources.devices import by_rule
from checkpoint.resources.events import epoll, fd_signals
from checkpoint.resources.files import locks, regular
from checkpoint.resources.ipc import boards, pipes, shared_memory, standard_streams
from checkpoint.resources.open_file import ALONE, Held, Kin, Opened, OpenFile, Owners, Surroundings
from checkpoint.resources.socket_cache import Recollection
from checkpoint.resources.sockets import scm_rights, sockets
from checkpoint.resources.sockets.sockets import Noted

STREAM_NUMBERS: Final = (1, 2)
GLANCES_MORE: Final = 3
"""How often a process that runs is looked at again that was in the middle of something."""


def pipes_of(outputs: Sequence[int]) -> dict[str, int]:
    """How /proc names the other ends of the guard's pipes, standard output first."""
    return {
        os.readlink(f"/proc/self/fd/{descriptor}"): stream for stream, descriptor in zip(STREAM_NUMBERS, outputs, strict=True)
    }


class Kept:
    """Facts kept of a process that is looked at again and again, so that only changes are read anew."""

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
        noted: see `checkpoint.resources.sockets.sockets.queue_of`; None for a process that runs.
        rules: of devices; others are not asked.
        recollection: of a process that is looked at again and again.

    Raises:
        CaptureError: one of them cannot be looked into.
    """
    if recollection and noted is not None and not rules and recollection.are_plain(opened, _is_plain):
        return signal_owners.asked(opened)
    found = []
    empty = recollection.empty_pipes(opened) if recollection and not rules else {}
    for held in _with_travelling(opened, noted, recollection):
        if empty and held.first.number in empty and held.lent is None:
            held = empty[held.first.number]
        elif held.is_echo or held.observed or boards.is_open_one(held):
            pass
        elif rules and by_rule.is_ruled(held.first, rules):
            held = replace(held, observed=by_rule.observe(held, opened))
        elif observe := registry.observer_of(held.first, noted):
            held = replace(held, observed=observe(held, opened))
        elif regular.must_carry(held):
            held = replace(held, observed=regular.observe_deleted(held, opened))
        elif pipes.is_pipe(held.first) and (held.both_ends or (_may_be_half(held) and pipes.is_half(held))):
            capacity, pieces = pipes.look_into(held)
            held = pipes.with_content(held, capacity, pieces)
        found.append(held)
    return signal_owners.asked(found) if noted is not None else tuple(found)


def _is_plain(held: OpenFile) -> bool:
    """Whether we need not look into it: its descriptors tell everything. The answer follows from them alone."""
    first = held.first
    if held.is_echo or held.lent or held.observed:
        return False
    if pipes.is_pipe(first):
        return not (held.both_ends or _may_be_half(held))
    is_known = stat.S_ISCHR(first.mode) or (stat.S_ISREG(first.mode) and first.links > 0)
    return is_known and registry.observer_of(first, None) is None


def _with_travelling(opened: Opened, noted: Noted | None, recollection: Recollection | None = None) -> list[OpenFile]:
    """All of them, sockets looked into, and the open files found on their way in these."""
    answers = recollection.recall(opened) if recollection else {}
    known = {number: one.whole for number, one in opened.recalled.items() if one.whole is not None}
    found = [
        same if held.lent is None and (same := known.get(held.first.number)) else _looked_into(held, opened, noted)
        for held in opened
    ]
    if recollection:
        recollection.remember(found, answers, opened)
    for held in opened.travelling:  # which grows meanwhile
        found.append(_looked_into(held, opened, noted and scm_rights.unnoted))
    is_hidden = scm_rights.may_hide(found, noted)
    if not (opened.travelling or is_hidden):
        return found
    whole = scm_rights.together(found)
    inodes = {held.first.inode for held in opened.travelling}

    def completed(held: OpenFile) -> OpenFile:
        if held.first.target in whole or (is_hidden and held.first.target.startswith("pipe:")):
            return replace(held, both_ends=True)
        peer = held.observed.get("peer")  # the number of a unix socket; of another kind an address
        is_ours = isinstance(peer, int) and bool(peer) and (is_hidden or peer in inodes)
        return replace(held, observed={**held.observed, "peer_is_ours": True}) if is_ours else held

    return list(map(completed, found))


def _looked_into(held: OpenFile, opened: Opened, noted: Noted | None) -> OpenFile:
    """A socket as it is observed now; as it was where that fails: the next question about it reports the cause."""
    if not held.is_echo and sockets.is_socket(held.first):
        with contextlib.suppress(CaptureError):
            return replace(held, observed=registry.observe_socket(held, opened, noted=noted))
    return held


def _may_be_half(held: OpenFile) -> bool:
    """Whether it is worth asking: the standard streams of a program that is by itself lead elsewhere."""
    return bool(held.kin.pids) or held.first.number not in (0, *STREAM_NUMBERS)


def glance(pid: int, kin: Kin = ALONE) -> tuple[OpenFile, ...]:
    """Read every descriptor of a process that runs on: enough to tell what is refused.

    A file that it closes between two of our looks is neither there nor gone: then all is looked at again.

    Args:
        kin: the known facts of the other processes of its component.
    """
    found = _glanced(pid, kin)
    for _ in range(GLANCES_MORE):
        if all(map(_is_still_there, found)) and not any(map(epoll.watches_what_is_gone, found)):
            break
        found = _glanced(pid, kin)
    return tuple(filter(_is_still_there, found))


def _is_still_there(held: OpenFile) -> bool:
    try:
        return os.readlink(f"/proc/{held.pid}/fd/{held.first.number}") == held.first.target
    except OSError:
        return not os.path.exists(f"/proc/{held.pid}")  # it has ended as a whole


def _glanced(pid: int, kin: Kin) -> tuple[OpenFile, ...]:
    opened = Opened(replace(held, kin=kin) for held in gather(pid))
    found = []
    for held in _with_travelling(opened, None):
        if held.observed:
            pass
        elif observe := registry.observer_of(held.first, None):
            with contextlib.suppress(CaptureError):  # closed meanwhile
                held = replace(held, observed=observe(held, opened))
        elif pipes.is_pipe(held.first) and not held.both_ends and pipes.is_half(held):
            held = replace(held, both_ends=True)
        found.append(held)
    return tuple(found)


def look(opened: Sequence[OpenFile], surroundings: Surroundings) -> Held:
    """Sort one process's open files into the kinds: those that come back, and those that do not.

    `registry.findings_of_all` tells the findings about all processes of a component together.
    """
    resources, findings = [], []
    for held in opened:
        is_board = not held.is_echo and boards.is_open_one(held)
        of_any = None if is_board else locks.refuse(held) or (None if held.is_echo else fd_signals.refuse(held))
        if surroundings.detached and not is_board:
            of_any = of_any or shared_memory.refuse_partial(held.first, surroundings.detached)
            held = _detached(held, surroundings.detached)
        for kind in registry.ASKED:
            if reason := kind.refuse(held, surroundings) or of_any:
                findings.append(Finding(kind.KIND, held.name, REFUSED, reason))
                break
            if resource := kind.describe(held, surroundings):
                of_every = _of_every_kind(held, resource)
                if reason := scm_rights.refuse(held, kind.KIND, of_every):
                    findings.append(Finding(kind.KIND, held.name, REFUSED, reason))
                    break
                resources.append(replace(resource, facts={**resource.facts, **of_every, **scm_rights.describe(held)}))
                findings.append(Finding(kind.KIND, held.name, KEPT, f"{held.name} is {held.first.target}"))
                break
    return Held(tuple(resources), tuple(findings))


def _detached(held: OpenFile, objects: Mapping[tuple[int, int], int]) -> OpenFile:
    """An open file of shared memory that becomes the program's own copy, as one without a name; any other as it is."""
    found = tuple(shared_memory.descriptor_detached(one, objects) for one in held.descriptors)
    return held if found == held.descriptors else replace(held, descriptors=found)


def _of_every_kind(held: OpenFile, resource: Resource) -> dict[str, Fact]:
    """Facts that any kind may have."""
    if resource.kind == boards.KIND:  # its locks are of this robot's board
        return {"description": held.description} if held.description else {}
    if resource.kind == shared_open_file.KIND:
        return locks.describe(held, kinds=locks.OF_PROCESSES)
    facts = {**fd_signals.describe(held), **locks.describe(held)}
    return facts | ({"description": held.description} if held.description and resource.kind != standard_streams.KIND else {})
