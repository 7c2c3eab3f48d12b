"""Restore files without a name (deleted files, memfds) and named pipes that several processes of a component opened separately.

Each process describes such a file as its own, with its whole content. The restore makes each file once, before it creates the
processes, fills and seals it there, and leaves out the content and seals that the processes describe. Where such a file is
mapped, its pages come with the mappings: it is sealed when all processes have mapped it. One process fills a named pipe when it
opens it. A named pipe whose name is gone is also made before the processes are created.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence

from msgspec.structs import replace

from checkpoint.engines.ptrace.restore.memory import Object, is_object_mapping, object_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource, Snapshot
from checkpoint.resources import rebuild
from checkpoint.resources.files import memfd, regular
from checkpoint.resources.ipc import fifos
from checkpoint.resources.restore_context import number_of

Found = dict[Object, Resource]
"""By (device, inode): one that tells all of it."""


def made_once(views: Sequence[Snapshot]) -> tuple[tuple[Snapshot, ...], Found]:
    """The processes, which only open objects that several of them have; and those objects, to be made before any is born."""
    views = _filled_once(views)
    mapped = {object_of(vma) for view in views for vma in view.vmas if is_object_mapping(vma)}
    found = {key: held for key, held in _of_several(views).items() if key not in mapped}
    return _told_once(views, found, mapped), found


def _of_several(views: Sequence[Snapshot]) -> Found:
    """The objects that more than one process has open."""
    told = [_of(view.resources) for view in views]
    found: Found = {}
    for ours in told:
        for key, held in ours.items():
            if sum(key in others for others in told) > 1 and not (key in found and _has_content(found[key])):
                found[key] = held
    return found


def _of(resources: Iterable[Resource]) -> Found:
    found: Found = {}
    for held in resources:
        if held.kind == memfd.KIND or (held.kind in (regular.KIND, fifos.KIND) and held.facts.get("deleted")):
            key = _key(held)
            if key not in found or _has_content(held):
                found[key] = held
    return found


def _key(held: Resource) -> Object:
    return number_of(held.facts["device"]), number_of(held.facts["inode"])


def _has_content(held: Resource) -> bool:
    return bool(held.facts.get("content"))


def make(table: CallTable, held: Resource) -> int:
    """Make one, with everything that it had."""
    if held.kind == memfd.KIND:
        return memfd.make_whole(table, held)
    if held.kind == fifos.KIND:
        return fifos.make_nameless(table, held)
    return rebuild.make_deleted(table, held)


def _filled_once(views: Sequence[Snapshot]) -> tuple[Snapshot, ...]:
    """The same processes, of which one alone tells what is in a named pipe: by an open file that is shared, if one is."""
    tells: dict[Object, Resource] = {}
    for held in (held for view in views for held in view.resources if held.kind == fifos.KIND and _has_content(held)):
        key = fifos.key_of(held)
        if key not in tells or ("description" in held.facts and "description" not in tells[key].facts):
            tells[key] = held

    def told(held: Resource) -> Resource:
        if held.kind != fifos.KIND or held is tells.get(fifos.key_of(held)):
            return held
        return replace(held, facts={**held.facts, "content": b""})

    return tuple(replace(view, resources=tuple(map(told, view.resources))) for view in views)


def _told_once(views: Sequence[Snapshot], made: Container[Object], mapped: Container[Object]) -> tuple[Snapshot, ...]:
    """The same processes, whose open files of these are opened and nothing else.

    Args:
        made: those that are there already, with content and seals.
        mapped: those whose content comes with mappings; the last process that has one open seals it.
    """
    sealed: set[Object] = set()
    found = []
    for view in reversed(views):
        found.append(replace(view, resources=tuple(_without(held, made, mapped, sealed) for held in view.resources)))
        sealed |= _of(view.resources).keys()
    return tuple(reversed(found))


def _without(held: Resource, made: Container[Object], mapped: Container[Object], sealed: Container[Object]) -> Resource:
    is_memory_file = held.kind == memfd.KIND
    if not (is_memory_file or (held.kind == regular.KIND and held.facts.get("deleted"))):
        return held
    key = _key(held)
    if key in made:
        return replace(held, facts={**held.facts, "content": [], **({"seals": 0} if is_memory_file else {})})
    if is_memory_file and key in mapped and key in sealed:
        return replace(held, facts={**held.facts, "seals": 0})
    return held
