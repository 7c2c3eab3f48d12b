"""Where versions of one program come from: the store, with all about a bundle checked anew; or a directory of one's own."""

from __future__ import annotations

import os
from pathlib import Path

from msgspec import Struct

from failover.core.programs import states
from failover.core.programs.states import Shelf, State
from failover.errors import ProgramError
from failover.programs import packing
from failover.programs.running import Source
from failover.programs.store import Store


class Place(Struct, frozen=True):
    """Which program a host runs, and where things are.

    Attributes:
        directory: its files, for one that runs unsigned as the host's user; None: one of the store.
        beside: run under ``PATH@VERSION``, with a state of its own.
    """

    store: Store
    team: Path
    name: str
    directory: Path | None = None
    beside: bool = False


def source_of_directory(directory: Path) -> Source:
    """A program that runs as this user, unsigned, because it is this user's own.

    Raises:
        ProgramError: others may change it, or its program.toml is mistaken.
    """
    try:
        found = directory.resolve(strict=True)
        status = found.stat()
    except OSError as error:
        raise ProgramError(f"cannot run {directory}: {error.strerror}") from error
    if status.st_uid not in (0, os.geteuid()) or status.st_mode & 0o002:
        raise ProgramError(
            f"cannot run {directory}: it is another user's, or all may write to it; sign it, and send it as a bundle"
        )
    return Source(packing.manifest_of(found), found, "")


def source_of_store(place: Place, version: str) -> Source:
    """A version of the store, once all about it was checked anew.

    Raises:
        BundleRefusedError: its key, its signature or its author's right is no more.
        ProgramError: it is not here, or was changed.
    """
    shelf = place.store.shelf(place.name)
    one = version_of(shelf, version) if version else shelf.active or _newest(shelf)
    found = place.store.admitted(one.digest, place.team)
    uid = shelf.uid if os.geteuid() == 0 else 0
    return Source(found.program.manifest, place.store.tree(one.digest), one.digest, uid)


def end_trial(place: Place) -> None:
    """If the last host ended during a trial: the version before is active again."""
    with place.store.locked():
        shelf = place.store.shelf(place.name)
        active = shelf.active
        if active is None or active.is_committed or not shelf.before:
            return
        place.store.put(states.fall_back(shelf, "its host ended during the trial"))
    place.store.log(place.name, f"{active.version} is rolled back: its host ended during the trial")


def before(path: str) -> str:
    """Under which path the state at the last switch is kept."""
    return f"{path} before"


def _newest(shelf: Shelf) -> states.Version:
    staged = [one for one in shelf.versions if one.state in (State.STAGED, State.RETIRED)]
    if not staged:
        raise ProgramError(f"{shelf.name} has no version that could run; failover program list shows why")
    return staged[-1]


def version_of(shelf: Shelf, version: str) -> states.Version:
    found = shelf.find(version)
    if found is None or not found.digest:
        known = ", ".join(one.version for one in shelf.versions)
        raise ProgramError(f"{shelf.name} {version} is not here, but {known}; failover program send brings it")
    return found
