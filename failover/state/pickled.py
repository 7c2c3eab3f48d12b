"""The only place where pickle may appear: a field whose declaration says ``pickled``.

Unpickling runs any code that the bytes contain. A person who can write the stored state can then run code in the program: declare
it only where every robot and server that holds the state may do that anyway. A state that holds pickled bytes is refused by every
declaration that does not say so itself.
"""

from __future__ import annotations

import pickle
from typing import Any

from msgspec import Struct

from failover.state.kinds import Build, Kind, Walk
from failover.state.wire import Place, Wire, mark_of

PICKLED = "$pickled"

PROTOCOL = 4
"""Read by every Python that we support."""


class Unread(Struct, frozen=True):
    """Pickled bytes, not unpickled: a migration meets them in the place of a pickled value, and leaves them as they are."""

    packed: bytes


class UnreadKind(Kind):
    """Pickled bytes as bytes."""

    name = "pickled bytes"
    types = frozenset({Unread})
    shapes = frozenset({PICKLED})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        return _lower_packed(value.packed, walk, place)

    def lift(self, wire: Wire, build: Build, place: Place) -> Unread:
        return Unread(bytes(_lift_packed(wire, self, build, place)))


class PickledKind(Kind):
    """Any value that pickle takes."""

    name = "pickled"
    shapes = frozenset({PICKLED})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        try:
            packed = pickle.dumps(value, protocol=PROTOCOL)
        except (pickle.PicklingError, TypeError, AttributeError, RecursionError, ValueError) as error:
            raise self.stranger(value, place, f"pickle says: {error}") from error
        return _lower_packed(packed, walk, place)

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        packed = _lift_packed(wire, self, build, place)
        try:
            return pickle.loads(packed)  # the program asked for this, loudly
        except Exception as error:
            raise self.misfit(wire, place, f"cannot be unpickled: {type(error).__name__}: {error}"[:200]) from error


def _lower_packed(packed: bytes, walk: Walk, place: Place) -> Wire:
    if len(packed) >= walk.inline_size:
        return {PICKLED: [len(packed), walk.put_aside(memoryview(packed), "pickled", (len(packed),), place)]}
    return {PICKLED: packed}


def _lift_packed(wire: Wire, kind: Kind, build: Build, place: Place) -> bytes | memoryview:
    if mark_of(wire) != PICKLED:
        raise kind.misfit(wire, place)
    payload = wire[PICKLED]
    if type(payload) is bytes:
        return payload
    if type(payload) is list and len(payload) == 2 and type(payload[0]) is int and payload[0] >= 0:
        return build.fetch(payload[1], payload[0], place)
    raise kind.misfit(wire, place, "not bytes, nor a length and a region")
