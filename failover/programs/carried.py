"""What a host under an agent keeps, so that another robot can go on with its program: one commit with the mailbox.

The bundles of the active version and of the one before it go with the state: a standby that holds the state can run it. There
they are checked like bundles that a person sends: key, signature, form and right, by that robot's own files.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import msgspec

from checkpoint.errors import UNDECODABLE
from failover.core.programs import states, versions
from failover.core.programs.manifest import Manifest
from failover.core.programs.states import Shelf, Version
from failover.drivers.declare import Declaration
from failover.drivers.keeping import Keeping
from failover.errors import BundleRefusedError, FailoverError, ProgramError
from failover.kept_state.agent_link import has_guard
from failover.kept_state.component import kept
from failover.programs.sources import Place
from failover.programs.store import Kept

T = TypeVar("T")


class Carried:
    """The attributes that are kept.

    Attributes:
        shelf: the program's versions, as JSON; b"" until the program has begun somewhere.
        newest: state and version now, a `Kept` as msgpack. switched: the same at the last switch; b"": there was none.
        bundles: digest → bundle, of the active version and of the one before it.
    """

    shelf: bytes = kept(default=b"")
    newest: bytes = kept(default=b"")
    switched: bytes = kept(default=b"")
    bundles: dict[str, bytes] = kept(factory=dict)

    def take_shelf(self, shelf: Shelf, place: Place) -> None:
        """Versions have changed.

        Raises:
            ProgramError: a bundle cannot be read.
        """
        needed = [one.digest for one in (shelf.active, shelf.find(shelf.before) if shelf.before else None) if one is not None]
        self.bundles = {digest: place.store.bundle(digest) for digest in needed if digest}
        self.shelf = msgspec.json.encode(shelf)


def open_carried(place: Place) -> Keeping | None:
    """What the agent keeps for this host; None without an agent. A host on a standby waits here until its robot takes over.

    Raises:
        ProgramError: another robot could not check what runs here.
    """
    if not has_guard():
        return None
    if place.directory is not None or place.beside:
        what = f"{place.directory}" if place.directory is not None else f"{place.name} --beside"
        raise ProgramError(
            f"cannot run {what} under an agent: another robot takes over signed bundles only; "
            f"pack, sign and send it, then: failover run -- failover program run {place.name}"
        )
    return Keeping(Carried, Declaration(place.name, (), None, {}, {}))


def kept_in(content: bytes) -> Kept | None:
    """A state that is carried; None: there is none.

    Raises:
        ProgramError: it is damaged.
    """
    return _read(content, Kept) if content else None


def unpack(carried: Carried, place: Place) -> None:
    """Make this robot's shelf that of the robot where the program ran last, and its bundles present, each checked here.

    Raises:
        BundleRefusedError: the version that would run may not run here.
        ProgramError: the shelf is damaged, or this robot's program of that name has another path.
    """
    shelf = _read(carried.shelf, Shelf)
    if shelf.name != place.name:
        raise ProgramError(f"the kept state is that of the program {shelf.name}, and this host is for {place.name}")
    store = place.store
    refused: dict[str, BundleRefusedError] = {}
    present: set[str] = set()
    for one in shelf.versions:
        if one.digest not in carried.bundles:
            continue
        check = functools.partial(_check_entry, shelf, one)
        try:
            if not _is_admitted(one.digest, place, check):
                store.bring(one.digest, carried.bundles[one.digest], place.team, check)
            present.add(one.digest)
        except BundleRefusedError as error:
            refused[one.digest] = error
    with store.locked():
        mine = store.find(place.name)
        known = {(one.version, one.digest) for one in mine.versions} if mine is not None else set()
        present |= {one.digest for one in shelf.versions if (one.version, one.digest) in known and store.has(one.digest)}
        found = states.carried_over(shelf, mine, present - refused.keys())
        if found.active is None:
            lost = shelf.active
            raise refused.get(lost.digest if lost is not None else "") or ProgramError(
                f"{shelf.name} cannot go on here: the bundle of its active version did not come with its state"
            )
        store.put(found)
    if mine is not None and mine.floor and versions.order(found.active.version) < versions.order(mine.floor):
        store.log(shelf.name, f"{found.active.version} goes on here, older than {mine.floor}: so it was where it ran last")
    for digest, why in refused.items():
        store.log(shelf.name, f"{digest[:12]}, which came with the state, may not run here: {why}")


def _is_admitted(digest: str, place: Place, check: Callable[[Manifest], None]) -> bool:
    """Whether this robot's own copy of a bundle may run: it may have a newer signature than the one that came.

    Raises:
        BundleRefusedError: by `check`.
    """
    if not place.store.has(digest):
        return False
    try:
        said = place.store.admitted(digest, place.team).program.manifest
    except FailoverError:
        return False
    check(said)
    return True


def _check_entry(shelf: Shelf, one: Version, said: Manifest) -> None:
    """The shelf is not signed: what it says of a bundle counts only if the bundle says the same.

    Raises:
        BundleRefusedError: it says something else.
    """
    if (said.name, said.path) != (shelf.name, shelf.path) or versions.order(said.version) != versions.order(one.version):
        raise BundleRefusedError(
            f"the bundle {one.digest[:12]} came under another name: the shelf calls it {shelf.name} {one.version} "
            f"for {shelf.path}, and its manifest {said.name} {said.version} for {said.path}"
        )


def _read(content: bytes, kind: type[T]) -> T:
    try:
        found: T = (msgspec.json if kind is Shelf else msgspec.msgpack).decode(content, type=kind)
    except UNDECODABLE as error:
        raise ProgramError(f"what came with the program's state is damaged: {error}") from error
    return found
