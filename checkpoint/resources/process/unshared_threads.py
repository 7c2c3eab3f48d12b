"""Restore what a thread does not share with the others: its working directory and umask, its table of descriptors.

A thread gets these by unshare(2) with CLONE_FS or CLONE_FILES, or by clone(2) without them. A restored thread begins by sharing
everything with the first one, and unshares it as it did then. Every open file in a table of its own must also be open in the
first thread, under any number: the snapshot records such a table as a choice from the first thread's.

The capture looks up which threads have any of these before and after the freeze; it reads their values during the freeze.

Facts: ``descriptors`` (none); ``threads``: a list of [tid, directory, umask, files]; ``directory`` is "" where it is the first
thread's; ``files`` is a list of [number, number in the first one's table, 1 if close-on-exec], or 0 where the table is the same.

Source: unshare(2), kcmp(2), proc_pid_task(5).
"""

from __future__ import annotations

import fcntl
import functools
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import descriptor, descriptor_numbers
from checkpoint.linux.procfs.tasks import thread_count, thread_ids
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.restore_context import number_of
from checkpoint.sentences import in_words

KIND: Final = "thread_tables"

CAPABILITIES: Final = (
    preserved(
        Area.THREADS,
        "a thread with its own working directory and umask, or its own table of descriptors (unshare)",
        "its own again; the first thread must have open, too, what this thread has open there",
    ),
    refused(
        Area.THREADS,
        "a thread with open files that the first thread does not have; a thread with its own root, record lock or deleted "
        "directory; two threads that share what the others do not",
        "let the first thread have them, too",
        "which its first thread has not",
        "a root directory of its own",
        "a working directory of its own that",
        "has directories or open files {}",
        "a record lock of its own",
    ),
    refused(Area.THERE, "a missing working directory of a single thread", "make the directory", "in which its thread"),
)

CLONE_FS: Final = 0x200
CLONE_FILES: Final = 0x400
SAME: Final = 0
LESS: Final = 1
"""Results of kcmp(2)."""
KINDS: Final = (abi.KCMP_FS, abi.KCMP_FILES)
SHARED_TABLE: Final = 0
"""In place of a thread's descriptors: they are the first one's."""

OF_TWINS: Final = "that two of its threads share, but not all, which is not kept yet"

Own = frozenset[int]
"""Those of `KINDS` that a thread has for itself."""


def own(pid: int, tid: int) -> Own:
    """The kinds that a thread has for itself; of one that is about to end nothing is told.

    Raises:
        ProcessGoneError: it has ended.
    """
    found = frozenset(kind for kind in KINDS if (abi.kcmp(pid, tid, kind) or SAME) > SAME)
    return found if found and not procfs.thread_stat(pid, tid).flags & procfs.PF_EXITING else frozenset()


def refuse(pid: int, tid: int, kinds: Own) -> Iterator[str]:
    """Why a thread's own directory or descriptors cannot be kept."""
    _, reasons = _look_at(pid, tid, kinds)
    yield from reasons
    yield from _against_twins(pid, tid, kinds)


class _Told(Struct, frozen=True):
    """One thread, as the facts tell it, and what speaks against that."""

    fact: list[Fact]
    reasons: tuple[str, ...]


class ThreadTables:
    """The directories and descriptors that threads of one process have for themselves, from capture to capture."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._known: Mapping[int, Own] = {}
        self._told: dict[int, _Told] = {}

    def prepare(self) -> None:
        """Look before the freeze which threads have anything."""
        self._known = _all_own(self._pid)

    def look(self) -> None:
        """Read what they have, while all stand still.

        Raises:
            CaptureError: it cannot be read.
        """
        self._told.clear()
        for tid, kinds in self._known.items():
            try:
                fact, reasons = _look_at(self._pid, tid, kinds)
            except ProcessGoneError:
                continue
            except (ProbeError, OSError) as error:
                whose = f"thread {tid} of pid {self._pid}"
                raise CaptureError(f"cannot look at the directories and open files of {whose}: {in_words(error)}") from error
            self._told[tid] = _Told(fact, tuple(reasons))

    def describe(self) -> tuple[Resource, ...]:
        """The result of the look.

        Raises:
            CaptureError: one of them has just taken leave of the first thread, or what it had could not be kept.
        """
        now = _all_own(self._pid)
        for tid in now:
            if now[tid] != self._known.get(tid):
                raise CaptureError(f"thread {tid} of pid {self._pid} has just got files of its own (unshare); capture it again")
        if not self._told:
            return ()
        reasons = [reason for told in self._told.values() for reason in told.reasons]
        if any(_are_twins([tid for tid, kinds in now.items() if kind in kinds], kind) for kind in KINDS):
            reasons.append(f"it has directories or open files {OF_TWINS}")
        if reasons:
            raise CaptureError(f"cannot capture pid {self._pid} at this moment: {'; '.join(reasons)}")
        threads: list[Fact] = [told.fact for told in self._told.values()]
        return (Resource(KIND, "what threads have for themselves", {"descriptors": [], "threads": threads}),)


def _all_own(pid: int) -> dict[int, Own]:
    found: dict[int, Own] = {}
    if thread_count(pid) == 1:
        return found
    for tid in thread_ids(pid)[1:]:
        try:
            if kinds := own(pid, tid):
                found[tid] = kinds
        except (ProcessGoneError, ProbeError):
            continue  # it has ended
    return found


def _look_at(pid: int, tid: int, kinds: Own) -> tuple[list[Fact], list[str]]:
    """One thread as the facts tell it, and why it cannot be kept."""
    status = procfs.parse_status(procfs.read_text(pid, f"task/{tid}/status"))
    named = f"its thread {tid} ({status.name})"
    reasons: list[str] = []
    directory, files = "", SHARED_TABLE
    if abi.KCMP_FS in kinds:
        directory = procfs.read_link(pid, f"task/{tid}/cwd")
        reasons += _against_directory(pid, tid, directory, named)
    fact: list[Fact] = [status.pids[-1], directory, status.umask, files]
    if abi.KCMP_FILES in kinds:
        pairs, against = _pairs(pid, tid, named)
        fact[3] = pairs
        reasons += against
    return fact, reasons


def _against_directory(pid: int, tid: int, directory: str, named: str) -> Iterator[str]:
    if procfs.read_link(pid, f"task/{tid}/root") != procfs.read_link(pid, "root"):
        yield f"{named} has a root directory of its own, which is not kept yet"
    elif procfs.read_link(pid, "root") != "/":
        yield f"{named} has a root directory of its own, if the same one (chroot): that is not kept yet"
    if procfs.is_gone(directory):
        yield f"{named} has a working directory of its own that was deleted, which is not kept yet"
    if directory.startswith("/proc/"):
        yield f"{named} has a working directory of its own that is one of /proc, which is not kept yet"


def _against_twins(pid: int, tid: int, kinds: Own) -> Iterator[str]:
    """Another thread that shares with this one what it does not share with the first."""
    for other in thread_ids(pid)[1:]:
        if other != tid and any(abi.kcmp(tid, other, kind) == SAME for kind in kinds):
            yield f"its thread {tid} has directories or open files {OF_TWINS}"
            return


def _are_twins(owners: Iterable[int], kind: int) -> bool:
    """Whether two of these threads share something; the kernel's order of what they have makes them neighbours."""

    def by_what_they_have(one: int, other: int) -> int:
        return _order(one, other, kind)

    ordered = sorted(owners, key=functools.cmp_to_key(by_what_they_have))
    return any(_order(one, other, kind) == 0 for one, other in itertools.pairwise(ordered))


def _order(one: int, other: int, kind: int) -> int:
    return {LESS: -1, SAME: 0}.get(abi.kcmp(one, other, kind) or SAME, 1)


def _pairs(pid: int, tid: int, named: str) -> tuple[list[Fact], list[str]]:
    """Its descriptors, each with one of the first thread's; and those that cannot be told so."""
    found: list[Fact] = []
    reasons: list[str] = []
    first = descriptor_numbers(pid)
    for number in descriptor_numbers(tid):
        held = descriptor(tid, number)
        if held is None:
            continue
        match = _match(pid, tid, number, first)
        if match is None:
            reason = f"{named} has {held.name}, {held.target}, open, which its first thread has not"
            reasons.append(reason)
        elif _has_record_lock(held):
            reason = f"{named} has a record lock of its own by {held.name}, which is not kept yet"
            reasons.append(reason)
        else:
            found.append([number, match, int(bool(held.flags & os.O_CLOEXEC))])
    return found, reasons


def _match(pid: int, tid: int, number: int, candidates: list[int]) -> int | None:
    """A descriptor of the first thread for the same open file, of the same number if that is one."""
    for candidate in sorted(candidates, key=lambda one: one != number):
        if abi.kcmp(pid, tid, abi.KCMP_FILE, candidate, number) == SAME:
            return candidate
    return None


def _has_record_lock(held: Descriptor) -> bool:
    return any(line.startswith("lock:") and " POSIX " in line for line in held.text.splitlines())


def has_own_table(resources: Iterable[Resource]) -> bool:
    """Whether a thread has a table of descriptors for itself."""
    return any(files is not None for _, _, _, files in _threads(resources))


# --- The restore -----------------------------------------------------------------------------------------------------


def mismatches(held: Resource) -> Iterator[str]:
    """Directories that are not there."""
    for tid, directory, _, _ in _threads((held,)):
        if directory and not os.path.isdir(directory):
            yield f"{directory}, in which its thread {tid} works, is missing here: make it"


def enter(table: CallTable, resources: Iterable[Resource], tid: int) -> None:
    """Add the calls by which a thread gets a working directory and umask of its own."""
    for number, directory, umask, _ in _threads(resources):
        if number == tid and directory:
            table.call(f"have thread {tid} take leave of the working directory", "unshare", CLONE_FS)
            table.call(f"enter {directory}, where thread {tid} works", "chdir", table.place_path(directory))
            table.call(f"set the umask of thread {tid}", "umask", umask)


def part(table: CallTable, resources: Iterable[Resource], tid: int, open_here: Mapping[int, bool]) -> None:
    """Add the calls by which a thread gets its own table: a copy of the first one's, in which descriptors change their places.

    Args:
        open_here: descriptors of the first thread; whether they are close-on-exec.
    """
    files = next((files for number, _, _, files in _threads(resources) if number == tid), None)
    if files is None:
        return
    table.call(f"have thread {tid} take leave of the open files", "unshare", CLONE_FILES)
    table.descriptors |= set(open_here)
    wanted = {number for number, _, _ in files}
    spare = itertools.count(max(wanted | table.descriptors, default=0) + 1)
    copies = {source: next(spare) for source in sorted({source for number, source, _ in files if number != source})}
    for source, copy in copies.items():
        table.duplicate(source, copy, os.O_CLOEXEC)
    for number in sorted(set(open_here) - wanted):
        table.close(number)
    for number, source, is_closed in files:
        if number != source:
            table.duplicate(copies[source], number, os.O_CLOEXEC if is_closed else 0)
        elif is_closed != open_here[number]:
            table.call(f"mark descriptor {number}", "fcntl", number, fcntl.F_SETFD, fcntl.FD_CLOEXEC if is_closed else 0)
    for copy in copies.values():
        table.close(copy)


Files = list[tuple[int, int, bool]]


def _threads(resources: Iterable[Resource]) -> Iterator[tuple[int, str, int, Files | None]]:
    """(tid, directory, umask, descriptors) of each; None where the table is the first one's."""
    for held in resources:
        listed = held.facts["threads"] if held.kind == KIND else []
        assert isinstance(listed, list)
        for one in listed:
            assert isinstance(one, list)
            tid, directory, umask, files = one
            told = [tuple(map(number_of, pair)) for pair in files if isinstance(pair, list)] if isinstance(files, list) else None
            parsed = None if told is None else [(number, source, bool(mark)) for number, source, mark in told]
            yield number_of(tid), str(directory), number_of(umask), parsed
