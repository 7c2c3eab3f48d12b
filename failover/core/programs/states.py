"""The states of one version of a program on one robot, and of all versions of one program together.

====================  =====================================================================  ==================
state                 what is true                                                           goes on to
====================  =====================================================================  ==================
received              its bytes are here, nothing of them was believed                       verified, refused
verified              signature, key, right, form and version were checked                   staged, refused
staged                its files lie unpacked, read-only                                      warm, refused
warm                  its process runs, has imported all, and has no state yet               active, staged
active                it has the name, the mailbox and the state; on trial until committed   retired, rolled back
retired               another version has taken over; its files are kept                     warm
rolled back           it failed its trial, or a person took it back; its files are kept      warm
refused               it may not run here; nothing of it is kept
====================  =====================================================================  ==================

Always true: at most one version is active. The floor against downgrades is the version that was committed last.
"""

from __future__ import annotations

import enum
from collections.abc import Collection
from typing import Final

import msgspec
from msgspec import Struct

from failover.core.programs import versions
from failover.errors import ProgramError

VERSIONS_MAX: Final = 64
"""Of one program on one robot."""


class State(enum.StrEnum):
    """Of one version."""

    RECEIVED = "received"
    VERIFIED = "verified"
    STAGED = "staged"
    WARM = "warm"
    ACTIVE = "active"
    RETIRED = "retired"
    ROLLED_BACK = "rolled back"
    REFUSED = "refused"


ARROWS: Final = {
    State.RECEIVED: (State.VERIFIED, State.REFUSED),
    State.VERIFIED: (State.STAGED, State.REFUSED),
    State.STAGED: (State.WARM, State.REFUSED),
    State.WARM: (State.ACTIVE, State.STAGED),
    State.ACTIVE: (State.RETIRED, State.ROLLED_BACK),
    State.RETIRED: (State.WARM,),
    State.ROLLED_BACK: (State.WARM,),
    State.REFUSED: (),
}


class Version(Struct, frozen=True):
    """One version on one robot.

    Attributes:
        digest: the name of its bundle; "" for one that runs from a directory.
        is_committed: it has passed its health check since it became active.
        why: the last arrow's reason, for people.
    """

    version: str
    digest: str
    state: State = State.RECEIVED
    is_committed: bool = False
    why: str = ""


class Standing(Struct, frozen=True):
    """What a host tells of its program: the answer to ``_versions``.

    Attributes:
        active: the version that carries out messages; "" while none does.
        pid: of its process; 0: none.
        is_coming: another version is being started. said: what happened last, for people.
        gap_ms: how long no version could take a message at the last switch.
        enforced, not_enforced: one sentence each.
        before: the version whose process waits for a rollback; "": none does.
        versions: all of the shelf; none for a program that runs from a directory.
    """

    name: str
    path: str
    active: str
    pid: int
    on_trial: bool
    is_coming: bool
    said: str
    gap_ms: float
    enforced: tuple[str, ...]
    not_enforced: tuple[str, ...]
    before: str
    versions: tuple[Version, ...] = ()


def _moved(one: Version, state: State, why: str, *, is_committed: bool = False) -> Version:
    if state not in ARROWS[one.state]:
        raise ProgramError(f"version {one.version} is {one.state}, and cannot become {state}")
    return msgspec.structs.replace(one, state=state, why=why, is_committed=is_committed)


def verify(one: Version, who: str) -> Version:
    """received → verified."""
    return _moved(one, State.VERIFIED, f"signed by {who}")


def refuse(one: Version, why: str) -> Version:
    """received, verified or staged → refused."""
    return _moved(one, State.REFUSED, why)


def stage(one: Version) -> Version:
    """verified → staged."""
    return _moved(one, State.STAGED, one.why)


def warm(one: Version) -> Version:
    """staged, retired or rolled back → warm."""
    return _moved(one, State.WARM, "its process runs")


def cool(one: Version, why: str) -> Version:
    """warm → staged: its process has ended, or is not needed."""
    return _moved(one, State.STAGED, why)


def activate(one: Version, why: str) -> Version:
    """warm → active, on trial."""
    return _moved(one, State.ACTIVE, why)


def commit(one: Version, why: str) -> Version:
    """active stays active: the trial is over."""
    if one.state is not State.ACTIVE:
        raise ProgramError(f"version {one.version} is {one.state}, and only an active one can be committed")
    return msgspec.structs.replace(one, is_committed=True, why=why)


def retire(one: Version, why: str) -> Version:
    """active → retired."""
    return _moved(one, State.RETIRED, why)


def roll_back(one: Version, why: str) -> Version:
    """active → rolled back."""
    return _moved(one, State.ROLLED_BACK, why)


class Shelf(Struct, frozen=True):
    """All versions of one program on one robot.

    Attributes:
        floor: the version that was committed last; "" before the first.
        before: the version that was active before the present one; "" where none was.
        uid: of the user as whom it runs, where root may choose; 0: not chosen.
    """

    name: str
    path: str
    versions: tuple[Version, ...] = ()
    floor: str = ""
    before: str = ""
    uid: int = 0

    def find(self, version: str) -> Version | None:
        """A version by its number, in whatever spelling."""
        wanted = versions.order(version)
        return next((one for one in self.versions if versions.order(one.version) == wanted), None)

    @property
    def active(self) -> Version | None:
        """The one that has the name."""
        return next((one for one in self.versions if one.state is State.ACTIVE), None)


def put(shelf: Shelf, one: Version) -> Shelf:
    """The shelf with this version in its new state.

    Raises:
        ProgramError: there are too many, or two would be active.
    """
    others = tuple(other for other in shelf.versions if versions.order(other.version) != versions.order(one.version))
    if len(others) >= VERSIONS_MAX:
        raise ProgramError(f"{shelf.name} has {len(others)} versions here, and {VERSIONS_MAX} are the most")
    if one.state is State.ACTIVE and any(other.state is State.ACTIVE for other in others):
        raise ProgramError(f"{shelf.name} {one.version} cannot become active while another version is")
    found = tuple(sorted((*others, one), key=lambda each: versions.order(each.version)))
    floor = one.version if one.state is State.ACTIVE and one.is_committed else shelf.floor
    return msgspec.structs.replace(shelf, versions=found, floor=floor)


def succeed(shelf: Shelf, new: Version, why: str) -> Shelf:
    """The new version becomes active, and the one before it is retired: one step, so that there is always just one."""
    old = shelf.active
    if old is not None:
        shelf = put(shelf, retire(old, f"{new.version} has taken over"))
    shelf = put(shelf, activate(new, why))
    return msgspec.structs.replace(shelf, before=old.version if old is not None else "")


def fall_back(shelf: Shelf, why: str) -> Shelf:
    """The active version goes, and the one before it is active again, as committed as it was.

    Raises:
        ProgramError: none was there before it.
    """
    new, old = shelf.active, shelf.find(shelf.before) if shelf.before else None
    if new is None or old is None:
        raise ProgramError(f"{shelf.name} cannot be rolled back: no version was active before {new.version if new else 'it'}")
    shelf = put(shelf, roll_back(new, why))
    back = commit(activate(warm(old), f"{new.version} was rolled back"), f"{new.version} was rolled back: {why}")
    return msgspec.structs.replace(put(shelf, back), before="")


def undone(shelf: Shelf, earlier: Shelf) -> Shelf:
    """The shelf as it was at a moment before, with what has come since: a version that was to become active could not begin."""
    known = {versions.order(one.version) for one in earlier.versions}
    came = [one for one in shelf.versions if versions.order(one.version) not in known]
    both = sorted((*earlier.versions, *came), key=lambda one: versions.order(one.version))
    return msgspec.structs.replace(shelf, versions=tuple(both), floor=earlier.floor, before=earlier.before)


def carried_over(shelf: Shelf, here: Shelf | None, present: Collection[str]) -> Shelf:
    """The shelf of a program that goes on here: as it was where it ran, with the versions that are on this robot besides.

    Args:
        shelf: of the robot where it ran last. The higher floor of both counts: what came is not signed.
        here: of this robot; None: the program was never here.
        present: digests of those bundles of ``shelf`` that are here and may run.

    Raises:
        ProgramError: this robot's program of that name has another path.
    """
    if here is not None and here.path != shelf.path:
        raise ProgramError(f"{shelf.name} speaks for {here.path} here, and for {shelf.path} where it ran; give one another name")
    found = {versions.order(one.version): one for one in shelf.versions if one.digest in present}
    for one in here.versions if here is not None else ():
        if versions.order(one.version) not in found:
            is_active = one.state is State.ACTIVE
            kept = retire(one, f"{shelf.name} went on at another robot") if is_active else one
            found[versions.order(one.version)] = kept
    before = shelf.before if shelf.before and versions.order(shelf.before) in found else ""
    newest = tuple(found[order] for order in sorted(found))
    needed = [one for one in newest if one.state is State.ACTIVE or one.version == before]
    others = [one for one in newest if one not in needed][-(VERSIONS_MAX - len(needed)) :]
    both = tuple(one for one in newest if one in needed or one in others)
    floors = [one for one in (shelf.floor, here.floor if here is not None else "") if one]
    floor = max(floors, key=versions.order, default="")
    return Shelf(shelf.name, shelf.path, both, floor, before, here.uid if here is not None else 0)
