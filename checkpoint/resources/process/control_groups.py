"""Restore the place of a program's processes in control groups (cgroup v2, and each hierarchy of v1).

The usual place needs no record: the group of the keeper, or under a guard the group that the guard made for the component.
The vessel is born in the usual place of the robot on which it is restored. A process that is elsewhere was put there by
itself, its service manager or an operator. A restore puts the process back where the group exists, or where the group is the
program's own, which the restore makes anew: a group whose processes are all of the program, and which systemd does not name.
Where neither holds, a note says so. Limits and weights of a group are not recorded, so a group that is made anew has none.

A process is put back when it is whole, a moment before it resumes: a frozen group would hold the restore, too. The keeper
writes with its own rights. For a component of another user than root, it writes only to groups that this user owns or that
lie below the usual place.

Facts: ``descriptors`` (none); ``groups``, for each hierarchy a list of its name (controllers of /proc/PID/cgroup, "" of v2),
the path, the path below the usual place ("" if it is not below), and whether the group is the program's own; ``threads``,
of a base only: the paths of groups in which only threads of the process are.

Source: cgroups(7); Documentation/admin-guide/cgroup-v2.rst.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.capability import Area, by_rule
from checkpoint.errors import CheckpointError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.model import Fact, Resource, Snapshot

KIND: Final = "control_groups"
CAPABILITIES: Final = (
    by_rule(
        Area.PROCESS,
        "the place of each process in control groups (cgroup v2 and v1)",
        "the same, where the group exists or is the program's own; else the restore says which place it lost. Limits of a group "
        "are not kept, and threads get the place of their process",
        "this kernel has no such hierarchy",
        "that hierarchy is not mounted here",
        "the group is not one of user {} here",
        "that group does not exist here",
        "an administrator writes the PID to cgroup.procs",
        "were in the control group",
    ),
)
GUARDS: Final = re.compile(r"/failover-[0-9a-f]+(?=/|$)")
"""The group that a guard makes for its component (`agent.guard.freezer`)."""
MANAGED: Final = (".service", ".scope", ".slice", ".mount", ".swap", ".socket")
"""How groups end that systemd makes and names."""
REMOVED: Final = " (deleted)"
DELEGATED: Final = ("cgroup.procs", "cgroup.subtree_control", "cgroup.threads", "tasks")
"""Files of a group that its user may write. Source: cgroup-v2.rst, *Model of Delegation*."""
UNIFIED: Final = ""
"""The hierarchy of version 2."""

Groups = Mapping[str, str]
"""The path of a process by the hierarchy's name."""


def groups_of(pid: int) -> Groups:
    """Where a process is; nothing of one that has ended."""
    with contextlib.suppress(CheckpointError):
        return groups_in(procfs.read_text(pid, "cgroup"))
    return {}


def groups_in(text: str) -> Groups:
    """The same, by its /proc/PID/cgroup.

    Source: cgroups(7): ``hierarchy-ID:controller-list:cgroup-path``.
    """
    lines = [line.split(":", 2) for line in text.splitlines()]
    return {line[1]: line[2] for line in lines if len(line) == 3 and not line[2].endswith(REMOVED)}


class _Mounts:
    """Where this machine shows the hierarchies."""

    def __init__(self) -> None:
        self._places: list[tuple[str, str, str, frozenset[str]]] = []
        for line in procfs.read_text(os.getpid(), "mountinfo").splitlines():
            before, _, after = line.partition(" - ")
            root, place = before.split()[3:5]
            kind, _, options = after.split(" ", 2)
            if kind in ("cgroup", "cgroup2"):
                self._places.append((kind, root, place, frozenset(options.split(","))))

    def directory(self, hierarchy: str, path: str) -> Path | None:
        """The directory of a group, whether it exists or not; None where its hierarchy, or that part of it, is not mounted."""
        for kind, root, place, options in self._places:
            is_meant = (
                kind == "cgroup2" if hierarchy == UNIFIED else kind == "cgroup" and options.issuperset(hierarchy.split(","))
            )
            below = os.path.relpath(path, root)
            if is_meant and not below.startswith(".."):
                return Path(place, below)
        return None


# --- Captured ----------------------------------------------------------------------------------------------------------


def added_to(state: Snapshot, places: Mapping[int, Groups], guard: int) -> Snapshot:
    """A snapshot with the places of its processes that are not the usual one.

    Args:
        places: of its processes, by pid, as `Snapshot.processes` orders them.
        guard: pid of its guard; 0: it has none.
    """
    usual = groups_of(guard or os.getpid())
    told = [tuple(_elsewhere(groups, usual, places, is_guarded=bool(guard))) for groups in places.values()]
    threads = [_of_threads(pid) if state.is_base else () for pid in places]  # a program of 200 threads has 200 files
    if not any(told) and not any(threads):
        return state
    first, *others = map(_described, told, threads)
    members = tuple(
        replace(member, resources=(*member.resources, *more)) for member, more in zip(state.members, others, strict=True)
    )
    return replace(state, resources=(*state.resources, *first), members=members)


def _described(groups: Sequence[Fact], threads: Sequence[str]) -> tuple[Resource, ...]:
    facts: dict[str, Fact] = {"descriptors": [], "groups": list(groups), "threads": list(threads)}
    return (Resource(KIND, "control groups", facts),) if groups or threads else ()


def _of_threads(pid: int) -> tuple[str, ...]:
    """The groups in which only threads of a process are, but not the process."""
    ours = set(groups_of(pid).items())
    with contextlib.suppress(CheckpointError):
        theirs = {place for tid in thread_ids(pid) if tid != pid for place in groups_of(tid).items()}
        return tuple(sorted(path for hierarchy, path in theirs - ours if hierarchy in dict(ours)))
    return ()


def _elsewhere(groups: Groups, usual: Groups, pids: Collection[int], *, is_guarded: bool) -> Iterator[Fact]:
    """Those of a process's groups that are not the usual ones."""
    for hierarchy, path in groups.items():
        home = usual.get(hierarchy, "/")
        if is_guarded and hierarchy == UNIFIED and (made := GUARDS.search(path)):
            home = path[: made.end()]
        if path != home:
            below = path.removeprefix(home.rstrip("/") + "/")
            yield [hierarchy, path, below if below != path else "", _is_own(hierarchy, path, pids)]


def _is_own(hierarchy: str, path: str, pids: Collection[int]) -> bool:
    """Whether all processes of a group are the program's, and it is not one of systemd's."""
    directory = _Mounts().directory(hierarchy, path)
    if directory is None or path.endswith(MANAGED):
        return False
    with contextlib.suppress(OSError):
        return set(map(int, (directory / "cgroup.procs").read_text().split())) <= set(pids)
    return False


# --- Restored ----------------------------------------------------------------------------------------------------------


class _Place(Struct, frozen=True):
    """One group that a process was in."""

    hierarchy: str
    path: str
    below: str
    is_own: bool


def put_back(state: Snapshot, pids: Sequence[int], owner: int | None) -> tuple[str, ...]:
    """Put the processes of a program that stands still where they were; a note for each place that one has lost.

    Args:
        pids: of its processes as `Snapshot.processes` orders them.
        owner: the user id that must own the groups that are not below the usual place; None: any user may.
    """
    wanted = [(pid, place) for one, pid in zip(state.processes, pids, strict=True) for place in _places(one.resources)]
    notes = [note for one, pid in zip(state.processes, pids, strict=True) for note in _thread_notes(one.resources, pid)]
    if not wanted:
        return tuple(notes)
    usual, mounts = groups_of(pids[0]), _Mounts()
    for pid, place in sorted(wanted, key=lambda one: one[1].path.count("/")):  # a group before those below it
        if lost := _lost(pid, place, usual.get(place.hierarchy), mounts, owner):
            version = f"v1, {place.hierarchy}" if place.hierarchy else "v2"
            now = groups_of(pid).get(place.hierarchy)
            where = f"; it is in {now} now" if now is not None else ""
            notes.append(f"pid {_name_of(pid)} was in the control group {place.path} ({version}){where}: {lost}")
    return tuple(dict.fromkeys(notes))


def _thread_notes(resources: Sequence[Resource], pid: int) -> Iterator[str]:
    for held in resources:
        if held.kind == KIND:
            groups = held.facts["threads"]
            assert isinstance(groups, list)
            for group in groups:
                assert isinstance(group, str)
                yield f"threads of pid {_name_of(pid)} were in the control group {group}; they are in that of their process now"


def _places(resources: Sequence[Resource]) -> Iterator[_Place]:
    for held in resources:
        if held.kind == KIND:
            groups = held.facts["groups"]
            assert isinstance(groups, list)
            for told in groups:
                assert isinstance(told, list)
                hierarchy, path, below, is_own = told
                assert isinstance(hierarchy, str) and isinstance(path, str) and isinstance(below, str)
                yield _Place(hierarchy, _joined("/", path), below, bool(is_own))


def _name_of(pid: int) -> str:
    with contextlib.suppress(CheckpointError):
        return f"{pid} ({procfs.status(pid).name})"
    return str(pid)


def _lost(pid: int, place: _Place, usual: str | None, mounts: _Mounts, owner: int | None) -> str:
    """Why a process cannot be put back, and what helps; "" where it was put back."""
    if usual is None:
        return "this kernel has no such hierarchy"
    candidates = tuple(_candidates(place, usual))
    mounted = [(path, found) for path in candidates if (found := mounts.directory(place.hierarchy, path)) is not None]
    if not mounted:
        return "that hierarchy is not mounted here"
    allowed = [found for path, found in mounted if owner is None or path != place.path or _belongs_to(found, owner)]
    if not allowed:
        return f"the group is not one of user {owner} here; an administrator puts it there"
    try:
        directory = next((found for found in allowed if found.is_dir()), None)
        if directory is None and not place.is_own:
            return "that group does not exist here; make it, and write the PID to its cgroup.procs"
        directory = directory or _made(allowed[-1], pid)
        (directory / "cgroup.procs").write_text(str(pid), encoding="ascii")
    except OSError as error:
        return f"{error.strerror}; an administrator writes the PID to cgroup.procs of that group"
    return ""


def _candidates(place: _Place, usual: str) -> Iterator[str]:
    """Where the group may be: at its old path, unless that is below the group of an earlier guard; below the usual place here."""
    if not GUARDS.search(place.path):
        yield place.path
    if place.below:
        path = _joined(usual, place.below)
        if path != place.path and path.startswith(f"{usual.rstrip('/')}/"):
            yield path


def _joined(above: str, below: str) -> str:
    """A path of a group, which begins with one slash and does not lead up."""
    return "/" + os.path.normpath(f"{above}/{below}").lstrip("/")


def _belongs_to(directory: Path, owner: int) -> bool:
    with contextlib.suppress(OSError):
        return (directory / "cgroup.procs").stat().st_uid == owner
    return False


def _made(directory: Path, pid: int) -> Path:
    """Make a program's own group anew, for the user of its process."""
    directory.mkdir(parents=True)
    if os.geteuid() == 0:
        status = procfs.status(pid)
        for one in (directory, *(directory / name for name in DELEGATED if (directory / name).exists())):
            os.chown(one, status.uids[0], status.gids[0])
    return directory
