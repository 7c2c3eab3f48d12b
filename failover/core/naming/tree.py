"""The tree of names, as one process sees it: what stands behind a name, whether it is still heard, and who else claims it.

An entry is *live* while its origin is heard, then *unreachable* and still shown, then it is gone. Several origins may claim one
path, after a split was healed or by mistake: each stays visible as a *conflict*, and every process prefers the same one: what is
live, then the higher epoch of a primary, then the robot of lesser weight.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from msgspec import Struct

from checkpoint.sentences import near
from failover.core.naming import names, worlds
from failover.core.naming.names import Kind
from failover.core.naming.records import Record, numeric, unpack
from failover.core.naming.tables import Table
from failover.core.wire.names import weight
from failover.errors import NameAmbiguousError, NameUnknownError

LISTED_MAX: Final = 8
"""Paths that a sentence lists of an ambiguous name."""


class Reach(enum.StrEnum):
    """Whether the origin of a name is heard."""

    LIVE = "live"
    UNREACHABLE = "unreachable"


class Place(Struct, frozen=True):
    """A record, whose it is, and how it stands.

    Attributes:
        origin: the process that registered it: ``robot1``, or ``robot1/NAME`` for a driver without an agent.
        rivals: origins that claim the same path.
        refused: why it is shown and never resolved: the path belongs to another robot. "": it is none of these.
    """

    record: Record
    origin: str
    reach: Reach = Reach.LIVE
    rivals: tuple[str, ...] = ()
    refused: str = ""

    @property
    def robot(self) -> str:
        """Where it runs."""
        return robot_of(self.origin)


class Claims(Struct, frozen=True):
    """Which paths a robot may claim.

    Attributes:
        robots: whose paths are guarded; without any, each origin may claim all.
        paths: robot → beginnings of paths that it may claim besides its own subtree.
    """

    robots: frozenset[str] = frozenset()
    paths: Mapping[str, tuple[str, ...]] = {}

    def refusal(self, path: str, robot: str) -> str:
        """Why a robot may not claim a path; "" if it may.

        A path with a robot's name as a step is that robot's subtree. What belongs to no robot, any may claim, and what is
        simulated belongs to none.
        """
        if not self.robots or worlds.is_simulated(path) or any(_is_under(path, first) for first in self.paths.get(robot, ())):
            return ""
        owners = [step for step in path.split("/") if step in self.robots]
        if not owners or robot in owners:
            return ""
        return f"{robot} claims {path}, which is in the subtree of {owners[0]}; it needs another path"


def robot_of(origin: str) -> str:
    """The robot on which an origin runs."""
    return origin.partition("/")[0]


def _is_in(world: str, path: str) -> bool:
    """Whether an alias of a path is one for who lives in a world: a simulated thing is no real one's namesake."""
    return _is_under(path, world) if world else not worlds.is_simulated(path)


def _is_under(path: str, first: str) -> bool:
    return path == first or path.startswith(f"{first.rstrip('/')}/")


class Tree:
    """All names of some tables, found by each of their kinds."""

    def __init__(self, tables: Iterable[Table], reach: Mapping[str, Reach], claims: Claims) -> None:
        """
        Args:
            reach: origin → whether it is heard; an origin that is not there is left out.
        """
        found: dict[str, list[Place]] = {}
        for table in tables:
            if (state := reach.get(table.origin)) is None:
                continue
            for entry in table.entries.values():
                record = unpack(entry.body) if entry.body else None
                if record is not None and record.path == entry.path:
                    refused = claims.refusal(entry.path, robot_of(table.origin))
                    found.setdefault(entry.path, []).append(Place(record, table.origin, state, (), refused))
        self._paths = {path: _ranked(places) for path, places in found.items()}
        self._others: dict[tuple[Kind, str], list[Place]] = {}
        for places in self._paths.values():
            for place in places:
                for name in _other_names(place):
                    self._others.setdefault(name, []).append(place)

    def __len__(self) -> int:
        return len(self._paths)

    def resolve(self, text: str, world: str = "") -> Place:
        """What answers to a name of any kind.

        Args:
            world: of the one who asks: paths are below it, and aliases of what is there; "": the real one.

        Raises:
            NameFormatError: the text is no name.
            NameUnknownError: nothing answers to it.
            NameAmbiguousError: several do; lists their paths.
        """
        name = names.parse(text)
        places = self.claimants(text, world)
        able = [place for place in places if not place.refused]
        if not able:
            because = places[0].refused if places else "no process that was heard lately has registered it"
            known = [*self._paths, *(other for kind, other in self._others if kind is Kind.TEXT)]
            raise NameUnknownError(f"{text!r} names nothing: {because}{near(text, known)}")
        paths = sorted({place.record.path for place in able})
        if len(paths) > 1:
            lives = sorted({place.record.path for place in able if place.reach is Reach.LIVE})
            if len(lives) != 1:
                shown = ", ".join(paths[:LISTED_MAX]) + (" …" if len(paths) > LISTED_MAX else "")
                raise NameAmbiguousError(f"{text!r} names {len(paths)} things: {shown}; use one of these paths", tuple(paths))
            able = [place for place in able if place.record.path in lives]
        return able[0] if name.kind is Kind.PATH else self._paths[able[0].record.path][0]

    def claimants(self, text: str, world: str = "") -> Sequence[Place]:
        """All that a name may mean, the preferred one of each path first; raises as `names.parse`."""
        name = names.parse(text)
        path = name.text if name.kind is Kind.ADDRESS else worlds.within(world, name.text)
        if name.kind is Kind.PATH or path in self._paths:
            return self._paths.get(path, ())
        others = self._others.get((name.kind, name.text), ())
        return others if name.kind is Kind.ADDRESS else [one for one in others if _is_in(world, one.record.path)]

    def under(self, prefix: str = "") -> list[Place]:
        """Every claim of a path that is the prefix or lies under it, in natural order of the paths; "" for all."""
        first = names.path(prefix) if prefix.strip("/") else ""
        paths = [path for path in self._paths if not first or _is_under(path, first)]
        return [place for path in sorted(paths, key=weight) for place in self._paths[path]]


def _ranked(places: list[Place]) -> tuple[Place, ...]:
    """The claims of one path, the preferred one first, each with its rivals."""
    if len(places) == 1:
        return tuple(places)
    places.sort(key=_preference)
    origins = [place.origin for place in places if not place.refused]
    return tuple(
        Place(place.record, place.origin, place.reach, tuple(one for one in origins if one != place.origin), place.refused)
        for place in places
    )


def _preference(place: Place) -> tuple[object, ...]:
    return bool(place.refused), place.reach is not Reach.LIVE, -place.record.epoch, weight(place.robot), weight(place.origin)


def _other_names(place: Place) -> list[tuple[Kind, str]]:
    addresses = {numeric(address) for address in place.record.addresses}
    return [(Kind.TEXT, one) for one in place.record.aliases] + [(Kind.ADDRESS, one) for one in addresses if one]
