"""Restore every descriptor of a snapshot inside a vessel, under its own number.

Every resource stands for one *open file description*: descriptors made by dup share one, with its offset and flags, and share one
again. Facts that all resources have: ``descriptors``, a list of [number, 1 if close-on-exec].

Order: first the vessel's own 0, 1 and 2 move out of the way. Then every number is restored in ascending order, so that each file
that is opened gets a number that is still wanted or free. Then the moved descriptors are closed. Last, the restore passes other
descriptors to the files that refer to them.

Sources: open(2), dup(2), fdinfo of proc_pid_fdinfo(5).
"""

from __future__ import annotations

import fcntl
import os
import stat
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import groupby
from typing import Final

from msgspec import Struct

from checkpoint.engine import RestoreOptions
from checkpoint.errors import RestoreError
from checkpoint.linux.abi import PAGE_SIZE
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource, Snapshot
from checkpoint.resources import shared_open_file
from checkpoint.resources.devices import by_rule, stateless
from checkpoint.resources.events import epoll, eventfd, fd_signals, inotify, pidfd, signalfd, timerfd
from checkpoint.resources.files import (
    clean_private_pages,
    locks,
    memfd,
    namespaces,
    overmounted,
    proc_and_sys,
    regular,
    unlinked,
)
from checkpoint.resources.ipc import boards, fifos, pipes, pseudo_terminals, shared_memory, standard_streams, system_v_memory
from checkpoint.resources.process import (
    audit_login,
    control_groups,
    job_control,
    mlockall,
    parent_death_signals,
    scheduling,
    seccomp,
    shared_with_parent,
    unshared_threads,
)
from checkpoint.resources.restore_context import Rebuilding, number_of
from checkpoint.resources.sockets import inet, netlink, packet, tcp, unix_names
from checkpoint.resources.sockets import unix as unix_kind
from checkpoint.resources.sockets.peer_credentials import Disguise
from checkpoint.resources.sockets.unix_rebuild import Work
from checkpoint.snapshot import credentials

NS_PER_S: Final = 1_000_000_000
UTIME_OMIT: Final = (1 << 30) - 2
REOPENED_FLAGS: Final = (
    os.O_ACCMODE | os.O_APPEND | os.O_NONBLOCK | os.O_DSYNC | os.O_SYNC | os.O_DIRECT | os.O_NOATIME | os.O_DIRECTORY
)
"""Flags of open(2) that belong to an open file; O_CREAT, O_TRUNC and the like belong to the moment of opening."""

O_PATH: Final = 0o10000000
AT_EMPTY_PATH: Final = 0x1000
OWN_ATTRIBUTES: Final = ("user.", "system.posix_acl_")
"""How attributes begin that belong to a file as its content does. Source: xattr(7)."""
ENTRIES_SIZE: Final = 1024
"""Bytes that hold the first entries of a directory, however long their names are."""
STREAMS: Final = (0, 1, 2)
MADE: Final[Mapping[str, Callable[[CallTable, Resource, Rebuilding], int]]] = {
    eventfd.KIND: eventfd.rebuild,
    timerfd.KIND: timerfd.rebuild,
    signalfd.KIND: signalfd.rebuild,
    pidfd.KIND: pidfd.rebuild,
    namespaces.KIND: namespaces.rebuild,
    epoll.KIND: epoll.rebuild,
    inotify.KIND: inotify.rebuild,
    stateless.KIND: stateless.rebuild,
    fifos.KIND: fifos.rebuild,
    proc_and_sys.KIND: proc_and_sys.rebuild,
    memfd.KIND: memfd.rebuild,
    overmounted.KIND: overmounted.rebuild,
    by_rule.KIND: by_rule.rebuild,
    boards.KIND: boards.rebuild,
}
"""Kinds that are made anew: each adds its calls and answers with a descriptor."""
NEEDED: Final[Mapping[str, Callable[[Resource], Iterable[str]]]] = {
    fifos.KIND: fifos.mismatches,
    inotify.KIND: inotify.mismatches,
    unix_kind.KIND: unix_names.mismatches,
    proc_and_sys.KIND: proc_and_sys.mismatches,
    overmounted.KIND: overmounted.mismatches,
    inet.KIND: inet.mismatches,
    packet.KIND: packet.mismatches,
    system_v_memory.KIND: system_v_memory.mismatches,
    seccomp.KIND: seccomp.mismatches,
    unshared_threads.KIND: unshared_threads.mismatches,
}
"""Kinds that need something of this machine: why it does not have that, one sentence each."""
OF_KERNEL: Final = {netlink.KIND: netlink.prepare, packet.KIND: packet.prepare}
"""Sockets that lead to the kernel or an interface alone."""
SOCKETS: Final = (unix_kind.KIND, tcp.KIND, inet.KIND, *OF_KERNEL)
NOT_OPEN: Final = (
    mlockall.KIND,
    system_v_memory.KIND,
    shared_memory.KIND,
    credentials.KIND,
    scheduling.KIND,
    parent_death_signals.KIND,
    job_control.KIND,
    audit_login.KIND,
    seccomp.KIND,
    shared_with_parent.KIND,
    clean_private_pages.KIND,
    unshared_threads.KIND,
    control_groups.KIND,
)
"""Kinds of what no descriptor stands for."""
KINDS: Final = (
    regular.KIND,
    standard_streams.KIND,
    shared_open_file.KIND,
    pipes.KIND,
    pseudo_terminals.KIND,
    *NOT_OPEN,
    *MADE,
    *SOCKETS,
)


class Wanted(Struct, frozen=True):
    """One descriptor that the program had."""

    number: int
    close_on_exec: bool
    resource: Resource


def rebuild_all(
    table: CallTable,
    state: Snapshot,
    options: RestoreOptions,
    inner_pid: int,
    objects: Mapping[tuple[int, int], int],
    vessel_pid: int,
    descriptions: Mapping[int, int] | None = None,
) -> tuple[str, ...]:
    """Add the calls that bring all descriptors back: a note for each difference.

    Args:
        inner_pid: what the process itself will know as its PID.
        objects: files without a name that were made for its mappings: a descriptor of each, by (device, inode).
        vessel_pid: the process, as we know it.
        descriptions: of a component of several processes, the open files that it has by birth: a descriptor of each.

    Raises:
        RestoreError: a resource of a kind that this version does not know.
    """
    for held in state.resources:
        if held.kind not in KINDS:
            raise RestoreError(
                f"cannot restore {held.name}: kind {held.kind!r} is unknown here; use the version that captured it"
            )
    wanted = sorted(descriptors_of(state), key=lambda one: one.number)
    given = descriptions or {}
    inherited = sorted(given.values())
    if not wanted:
        for number in (*objects.values(), *inherited, *(STREAMS if descriptions is not None else ())):
            table.close(number)
        return shared_memory.notes(state.resources)
    moved = _move_streams_away(table, max(wanted[-1].number, *table.descriptors, 0) + 1)
    piped = pipes.rebuild(table, [held for held in state.resources if _is_own(held, given, pipes.KIND)], moved[-1] + 1)
    disguise = Disguise(procfs.status(vessel_pid), state.process, options.own_eyes, inner_pid)
    unix, connected = _prepare_sockets(table, state, moved[-1] + 1 + len(piped), given, disguise)
    last = max((moved[-1] + len(piped), unix.end, *connected.values()))
    lines = pseudo_terminals.prepare(
        table, [held for held in state.resources if _is_own(held, given, pseudo_terminals.KIND)], last + 1, vessel_pid
    )
    rebuilding = Rebuilding(options, state.clocks, inner_pid, max((last, *lines.values())) + 1)
    for key, number in objects.items():
        rebuilding.keep(table, key, number)
    holders: dict[int, int] = {}  # which number already stands for an open file description
    for one in wanted:
        if id(one.resource) in holders:
            _duplicate(table, holders[id(one.resource)], one)
        else:
            if (description := number_of(one.resource.facts.get("description", 0))) in given:
                _duplicate(table, given[description], one)
            elif id(one.resource) in lines:
                _duplicate(table, lines[id(one.resource)], one)
            else:
                _obtain(table, one, moved, piped, connected, rebuilding)
            holders[id(one.resource)] = one.number
            fd_signals.rebuild(table, one.number, one.resource, inner_pid)
    memfd.seal(table, [held for held in state.resources if _is_own(held, given, memfd.KIND)], rebuilding)
    unix.fill()
    for number in (*moved, *piped.values(), *connected.values(), *lines.values(), *rebuilding.objects.values(), *inherited):
        table.close(number)
    _settle(table, wanted, holders)
    for one in wanted:
        if one.resource.facts.get("travelling"):  # it was sent, and is open no more
            table.close(one.number)
    of_tcp = tcp.notes([held for held in state.resources if _is_own(held, given, tcp.KIND)])
    return (*of_tcp, *unix.notes(), *shared_memory.notes(state.resources))


def deleted_directory(state: Snapshot) -> int | None:
    """A descriptor that the program has of its working directory, if that was deleted."""
    directory = state.process.working_directory
    if not procfs.is_gone(directory):
        return None
    named = [one for one in descriptors_of(state) if one.resource.facts.get("path") == directory.removesuffix(procfs.DELETED)]
    return next((one.number for one in named if one.resource.kind == regular.KIND and one.resource.facts.get("deleted")), None)


def _is_own(held: Resource, given: Mapping[int, int], kind: str) -> bool:
    """Whether it is of a kind, and not there by birth."""
    return held.kind == kind and number_of(held.facts.get("description", 0)) not in given


def _prepare_sockets(
    table: CallTable, state: Snapshot, first: int, given: Mapping[int, int], disguise: Disguise
) -> tuple[Work, dict[int, int]]:
    """Make all sockets at numbers from ``first`` on, in the working directory: names may be relative to it."""
    of_unix = [held for held in state.resources if _is_own(held, given, unix_kind.KIND)]
    of_internet = [held for held in state.resources if _is_own(held, given, inet.KIND)]
    of_tcp = [held for held in state.resources if _is_own(held, given, tcp.KIND)]
    if of_unix and not procfs.is_gone(state.process.working_directory):
        directory = state.process.working_directory
        table.call(f"enter the working directory {directory}", "chdir", table.place_path(directory))
    unix = Work(table, of_unix, first, disguise=disguise, working_directory=state.process.working_directory)
    made = dict(unix.run())
    connected = tcp.prepare(table, of_tcp, unix.end)
    made |= connected
    made |= inet.prepare(table, of_internet, unix.end + len(connected), disguise)
    tcp.settle(table, of_tcp, connected)
    for kind, prepare in OF_KERNEL.items():
        of_kernel = [held for held in state.resources if _is_own(held, given, kind)]
        made |= prepare(table, of_kernel, max((unix.end - 1, *made.values())) + 1, disguise)
    return unix, made


def _settle(table: CallTable, wanted: list[Wanted], holders: Mapping[int, int]) -> None:
    """Set what refers to other descriptors: all of them are there now."""
    marked = frozenset(one.number for one in wanted if one.close_on_exec)
    for one in wanted:
        if one.resource.kind == epoll.KIND and holders[id(one.resource)] == one.number:
            epoll.settle(table, one.resource, one.number, marked, spare=wanted[-1].number + 1)


def rebuild_last(table: CallTable, state: Snapshot, inner_pid: int) -> None:
    """Add the calls that must come after everything else of a restore: watches would tell of it, locks would be lost."""
    pseudo_terminals.settle(table, state.resources, state.process.pid)
    for held in state.resources:
        numbers = _pairs(held.facts["descriptors"])
        if not numbers:
            continue  # nothing that is open
        first = number_of(numbers[0][0])
        locks.settle(table, held, first, inner_pid)
        fd_signals.settle(table, first, held)
        if held.kind == inotify.KIND:
            inotify.settle(table, held, first, state.process.root_directory)


def descriptors_of(state: Snapshot) -> list[Wanted]:
    """Every descriptor that the snapshot describes."""
    return [
        Wanted(int(str(number)), bool(close_on_exec), held)
        for held in state.resources
        for number, close_on_exec in _pairs(held.facts["descriptors"])
    ]


def open_here(state: Snapshot) -> dict[int, bool]:
    """The descriptors that a restored process has; whether they are close-on-exec."""
    return {one.number: one.close_on_exec for one in descriptors_of(state) if not one.resource.facts.get("travelling")}


def _pairs(fact: Fact) -> list[tuple[Fact, Fact]]:
    assert isinstance(fact, list)
    return [(pair[0], pair[1]) for pair in fact if isinstance(pair, list)]


def _move_streams_away(table: CallTable, first: int) -> tuple[int, ...]:
    """Move the vessel's standard streams to numbers above all that are wanted."""
    moved = tuple(max(first, len(STREAMS)) + stream for stream in STREAMS)
    for stream, number in zip(STREAMS, moved, strict=True):
        table.duplicate(stream, number, os.O_CLOEXEC)
        table.close(stream)
    return moved


def _obtain(
    table: CallTable,
    one: Wanted,
    moved: tuple[int, ...],
    piped: Mapping[int, int],
    connected: Mapping[int, int],
    rebuilding: Rebuilding,
) -> None:
    """The first descriptor of an open file description."""
    facts = one.resource.facts
    if one.resource.kind == pipes.KIND:
        _duplicate(table, piped[id(one.resource)], one)
        return
    if one.resource.kind in SOCKETS:
        _duplicate(table, connected[number_of(facts["socket"])], one)
        return
    if one.resource.kind == "streams":
        table.duplicate(moved[number_of(facts["stream"])], one.number, os.O_CLOEXEC if one.close_on_exec else 0)
        if number_of(facts.get("flags", 0)) & os.O_NONBLOCK:
            table.attempt(f"{one.resource.name} waits where it did not", "fcntl", one.number, fcntl.F_SETFL, os.O_NONBLOCK)
        return
    if one.resource.kind in MADE:
        opened = MADE[one.resource.kind](table, one.resource, rebuilding)
    else:
        open_file = _open_deleted if facts.get("deleted") else _open
        opened = open_file(table, one.resource, rebuilding)
    if opened != one.number:
        table.duplicate(opened, one.number, os.O_CLOEXEC if one.close_on_exec else 0)
        table.close(opened)
    elif one.close_on_exec:
        table.close_on_exec(opened)


def _duplicate(table: CallTable, holder: int, one: Wanted) -> None:
    table.duplicate(holder, one.number, os.O_CLOEXEC if one.close_on_exec else 0)


def _open(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    facts = held.facts
    path, flags = str(facts["path"]), number_of(facts["flags"])
    brought = rebuilding.objects.get((number_of(facts.get("device", 0)), number_of(facts.get("inode", 0))))
    if brought is not None and not flags & O_PATH:
        path = f"/proc/self/fd/{brought}"  # the file that was brought along in its place
    descriptor = table.open(path, flags & (O_PATH | os.O_NOFOLLOW | os.O_DIRECTORY if flags & O_PATH else REOPENED_FLAGS))
    if held.kind == "files" and not flags & O_PATH:
        options = rebuilding.options
        keeps = path in options.accept_changed or options.terms.is_shared(path)
        if brought is None and not keeps and has_grown(held):
            size = number_of(facts["size"])
            table.call(f"cut {path} back to {size} bytes", "ftruncate", descriptor, size)
        _seek(table, descriptor, held)
    return descriptor


def _open_deleted(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make a file that no name leads to, with the content that it had, opened as it was; it may be mapped already."""
    facts, mode = held.facts, number_of(held.facts.get("mode", 0o600))
    key = number_of(facts["device"]), number_of(facts["inode"])
    if key not in rebuilding.objects:
        rebuilding.keep(table, key, _empty(table, held, mode))
    made = rebuilding.objects[key]
    _finish(table, made, held, mode)
    again, flags = f"/proc/self/fd/{made}", number_of(facts["flags"])
    if flags & O_PATH:
        return table.open(again, O_PATH | (flags & os.O_DIRECTORY))
    if _was_born_so(flags):
        opened = table.obtain(f"open {facts['path']!s}", "fcntl", made, fcntl.F_DUPFD, 0)
        table.call(f"set the flags of {held.name}", "fcntl", opened, fcntl.F_SETFL, flags & (os.O_APPEND | os.O_NONBLOCK))
        _seek(table, opened, held)
        return opened
    is_temporary = stat.S_ISREG(mode)  # O_DIRECTORY is a part of O_TMPFILE, by which it may have been made
    opened = table.open(again, flags & REOPENED_FLAGS & ~(os.O_DIRECTORY if is_temporary else 0))
    _seek(table, opened, held)
    return opened


def make_deleted(table: CallTable, held: Resource) -> int:
    """Make what no name leads to, with all that it had: a descriptor of it."""
    mode = number_of(held.facts.get("mode", 0o600))
    made = _empty(table, held, mode)
    _finish(table, made, held, mode)
    return made


def _empty(table: CallTable, held: Resource, mode: int) -> int:
    path = str(held.facts["path"])
    if stat.S_ISLNK(mode):
        return unlinked.make_link(table, path, str(held.facts["link"]))
    if stat.S_ISDIR(mode):
        return unlinked.make_directory(table, path, stat.S_IMODE(mode))
    return unlinked.make_file(table, path, stat.S_IMODE(mode), was_born_so=_was_born_so(number_of(held.facts["flags"])))


def _was_born_so(flags: int) -> bool:
    """Whether an open file is the one by which a file without a name was made (O_TMPFILE), to read and to write it."""
    return flags & os.O_TMPFILE == os.O_TMPFILE and flags & os.O_ACCMODE == os.O_RDWR


def _finish(table: CallTable, made: int, held: Resource, mode: int) -> None:
    """Content, owner and times."""
    facts, path, again = held.facts, str(held.facts["path"]), f"/proc/self/fd/{made}"
    if stat.S_ISREG(mode):
        _fill(table, made, held)
    if "uid" in facts:
        owner = number_of(facts["uid"]), number_of(facts["gid"])
        lost = f"the deleted file {path} belongs to the user that the program runs as"
        table.attempt(lost, "fchownat", made, table.place_path(""), *owner, AT_EMPTY_PATH)
        table.attempt("", "fchmodat", -1, table.place_path(again), stat.S_IMODE(mode))  # a change of owner takes set-user-ID away
    attributes = facts.get("attributes", {})
    assert isinstance(attributes, dict)
    for name, value in attributes.items():
        assert isinstance(value, bytes)
        if not name.startswith(OWN_ATTRIBUTES):
            continue  # it would come with our rights: capabilities of a file, which its user gave it where they do not count
        lost = f"the deleted file {path} is without its attribute {name}"
        table.attempt(lost, "setxattr", table.place_path(again), table.place_path(name), table.place(value), len(value), 0)
    if "mtime_ns" in facts:
        changed = struct.pack("<qq", *divmod(number_of(facts["mtime_ns"]), NS_PER_S))
        times = table.place(struct.pack("<qq", 0, UTIME_OMIT) + changed)
        table.attempt("", "utimensat", -1, table.place_path(again), times, 0)


def _fill(table: CallTable, made: int, held: Resource) -> None:
    """Give a file that was deleted its size and its content; with one of its open files the snapshot has that."""
    path, content = str(held.facts["path"]), held.facts.get("content", [])
    table.call(f"size {path}", "ftruncate", made, number_of(held.facts["size"]))
    if isinstance(content, bytes):
        content = [[0, content]]  # as versions before carried it
    assert isinstance(content, list)
    for part in content:
        assert isinstance(part, list) and isinstance(part[1], bytes)
        for offset, piece in _written_pieces(number_of(part[0]), part[1]):
            size = len(piece)
            table.call(f"fill {path}", "pwrite64", made, table.place(piece), size, offset, least=size, most=size)


def _written_pieces(begin: int, content: bytes) -> Iterator[tuple[int, bytes]]:
    """The pieces of a part of a file that are not zero, in whole pages, and their places: the rest becomes holes."""
    filled = [start for start in range(0, len(content), PAGE_SIZE) if content[start : start + PAGE_SIZE].strip(b"\0")]
    for _, run in groupby(enumerate(filled), key=lambda one: one[1] - one[0] * PAGE_SIZE):
        starts = [start for _, start in run]
        yield begin + starts[0], content[starts[0] : starts[-1] + PAGE_SIZE]


def _seek(table: CallTable, descriptor: int, held: Resource) -> None:
    offset = number_of(held.facts.get("offset", 0))
    if offset:
        if stat.S_ISDIR(number_of(held.facts.get("mode", 0))):
            # ext4 forgets where it reads only when the place differs from where it last read (ext4_dx_readdir): a directory
            # that goes on at its end, without having been read, would be empty after rewinddir(3)
            begun = f"a part of the directory {held.name} may be read again"
            table.attempt(begun, "getdents64", descriptor, table.place(bytes(ENTRIES_SIZE)), ENTRIES_SIZE)
        table.call(f"set the offset of {held.name}", "lseek", descriptor, offset, os.SEEK_SET, least=offset, most=offset)


def is_writable(flags: int) -> bool:
    """Whether something opened with these flags can be written to."""
    return flags & os.O_ACCMODE in (os.O_WRONLY, os.O_RDWR) and not flags & O_PATH


def is_written(held: Resource) -> bool:
    """Whether the program may write to a file through this descriptor."""
    return is_writable(number_of(held.facts["flags"]))


def grows_at_its_end(held: Resource) -> bool:
    """Whether the program writes to the end of a file, like a log: then all that came later lies beyond its size."""
    flags, offset, size = (number_of(held.facts[name]) for name in ("flags", "offset", "size"))
    return is_writable(flags) and (bool(flags & os.O_APPEND) or offset == size)


def has_grown(held: Resource) -> bool:
    """Whether a regular file is longer here than the program knows: what it wrote after the snapshot is to be cut off."""
    try:
        about = os.stat(str(held.facts["path"]))
    except FileNotFoundError:  # shared memory, which the restore makes
        return False
    return stat.S_ISREG(about.st_mode) and grows_at_its_end(held) and about.st_size > number_of(held.facts["size"])
