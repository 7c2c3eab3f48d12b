"""Reservations: a path and all below it is one user's for a time. Pure: every instant is an argument.

While a reservation stands, orders of other users about what is below its path are refused; the failover itself asks nothing here.
Each robot has a table; what one learns it tells the others, with spans in the place of instants, as their clocks differ. The end
of a reservation is told like its beginning, so no robot that was away brings it back.

Invariants: a reservation stands until its instant at the latest; one that is over never stands again; of two that overlap, which
only robots that did not hear each other can have granted, the older one counts.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Annotated, Final

from msgspec import Meta, Struct
from msgspec.structs import replace

from failover.core.rights.paths import SIZE_MAX, steps_of
from failover.core.types import MS
from failover.errors import RightsError

SPAN_MS_MAX: Final = 4 * 3_600_000
"""Four hours: a reservation that its user has forgotten ends before the next shift."""

OF_USER_MAX: Final = 8
"""Reservations of one user that stand at once."""

RESERVATIONS_MAX: Final = 64
"""At one robot, with those that are over and would still last: each order and each status compares them with each other."""

WHY_SIZE_MAX: Final = 120
"""Characters of a reason: it stands within one sentence."""

USER_SIZE_MAX: Final = 256
ID_SIZE_MAX: Final = 64

ONE_LINE: Final = r"\A[^\x00-\x1f\x7f-\x9f\u2028\u2029]*\Z"
"""Names and reasons stand in sentences and logs."""

Span = Annotated[int, Meta(ge=0, le=SPAN_MS_MAX)]


class Reservation(Struct, frozen=True, dict=True):
    """One of them, by this robot's clock.

    Attributes:
        id: of its own, the same at every robot.
        uid, user: whose it is, by number and by name.
        over: it has ended before its time.
    """

    id: str
    path: str
    uid: int
    user: str
    why: str
    begun_ns: int
    until_ns: int
    over: bool = False

    @functools.cached_property
    def steps(self) -> tuple[str, ...]:
        """Of its path."""
        return steps_of(self.path)


class Told(Struct, frozen=True, forbid_unknown_fields=True):
    """The same as it travels: how long it has stood, and how long it is to stand, in ms."""

    id: Annotated[str, Meta(min_length=1, max_length=ID_SIZE_MAX, pattern=ONE_LINE)]
    path: Annotated[str, Meta(min_length=1, max_length=SIZE_MAX, pattern=ONE_LINE)]
    uid: Annotated[int, Meta(ge=0)]
    user: Annotated[str, Meta(max_length=USER_SIZE_MAX, pattern=ONE_LINE)]
    why: Annotated[str, Meta(max_length=WHY_SIZE_MAX, pattern=ONE_LINE)]
    stood_ms: Span
    left_ms: Span
    over: bool


class Table:
    """What one robot knows."""

    def __init__(self, known: Iterable[Reservation] = ()) -> None:
        self._all = {one.id: one for one in known if _is_path(one.path)}

    def all(self, now_ns: int) -> tuple[Reservation, ...]:
        """Those whose time has not come, also those that are over; the oldest first."""
        self._all = {one.id: one for one in self._all.values() if one.until_ns > now_ns}
        return tuple(sorted(self._all.values(), key=_age))

    def standing(self, now_ns: int) -> tuple[Reservation, ...]:
        """Those that count; the oldest first."""
        found: list[Reservation] = []
        for one in self.all(now_ns):
            if not one.over and not any(_contradict(one, older) for older in found):
                found.append(one)
        return tuple(found)

    def over_path(self, path: str, now_ns: int) -> Reservation | None:
        """The one in which a path is. Raises RightsError: it is no path."""
        return covering(self.standing(now_ns), path)

    def hinders(self, uid: int, path: str, now_ns: int) -> Reservation | None:
        """The one because of which a user may give no order about a path; None: no other user has reserved it."""
        found = self.over_path(path, now_ns)
        return found if found is not None and found.uid != uid else None

    def why_not(self, wanted: Reservation, now_ns: int) -> Reservation | str:
        """What keeps it from beginning: another user's, or a sentence; "" for nothing."""
        standing = self.standing(now_ns)
        if other := next((one for one in standing if _contradict(one, wanted)), None):
            return other
        own = [one for one in standing if one.uid == wanted.uid and one.path != wanted.path]
        if len(own) >= OF_USER_MAX:
            return f"{wanted.user} has {OF_USER_MAX} reservations already; end one with failover unreserve NAME"
        if len(standing) >= RESERVATIONS_MAX:
            return f"this robot knows {RESERVATIONS_MAX} reservations already; wait until one has ended"
        return ""

    def begin(self, wanted: Reservation, now_ns: int) -> tuple[Reservation, ...]:
        """Let it stand, in the place of one of the same user at the same path; what has changed. `why_not` was asked."""
        replaced = [one for one in self.standing(now_ns) if (one.uid, one.path) == (wanted.uid, wanted.path)]
        changed = (*(self.end(one) for one in replaced), wanted)
        self._add(wanted, now_ns)
        return changed

    def _add(self, one: Reservation, now_ns: int) -> bool:
        """Take it in, in a full table in the place of the oldest that is over; whether there was room."""
        known = self.all(now_ns)
        if len(known) >= RESERVATIONS_MAX:
            past = next((each for each in known if each.over), None)
            if past is None:
                return False
            del self._all[past.id]
        self._all[one.id] = one
        return True

    def end(self, one: Reservation) -> Reservation:
        """It is over; the same, over."""
        self._all[one.id] = replace(one, over=True)
        return self._all[one.id]

    def hear(self, told: Told, now_ns: int) -> bool:
        """Take what another robot knows; whether it was news."""
        known = self._all.get(told.id)
        if known is not None:
            if told.over and not known.over:
                self.end(known)
                return True
            return False
        if not told.left_ms or not _is_path(told.path):
            return False
        begun_ns, until_ns = now_ns - told.stood_ms * MS, now_ns + told.left_ms * MS
        heard = Reservation(told.id, told.path, told.uid, told.user, told.why, begun_ns, until_ns, told.over)
        return self._add(heard, now_ns)


def reserved_path(path: str) -> str:
    """A path in the form in which it is kept.

    Raises:
        RightsError: it is no path, or its normal form (NFKC) is none, or is another path.
    """
    steps = steps_of(path)
    normal = "/" + "/".join(steps)
    if steps_of(normal) != steps:
        raise RightsError(f"{path!r} is no path: its characters stand for others (NFKC), among them a '/' or '→'; use those")
    return normal


def telling(one: Reservation, now_ns: int) -> Told:
    """As it travels."""
    stood_ms, left_ms = (min(max(span_ns // MS, 0), SPAN_MS_MAX) for span_ns in (now_ns - one.begun_ns, one.until_ns - now_ns))
    return Told(one.id, one.path, one.uid, one.user, one.why, stood_ms, left_ms, one.over)


def covering(standing: Iterable[Reservation], path: str) -> Reservation | None:
    """Of these the one in which a path is.

    Raises:
        RightsError: it is no path.
    """
    steps = steps_of(path)
    return next((one for one in standing if _is_below(steps, one.steps)), None)


def at_or_below(path: str, names: Iterable[str]) -> list[str]:
    """Of these names those about which a reservation of a path refuses orders.

    Raises:
        RightsError: it is no path. A name that is none is at no path.
    """
    above = steps_of(path)
    return [name for name in names if _is_path(name) and _is_below(steps_of(name), above)]


def _is_below(steps: tuple[str, ...], above: tuple[str, ...]) -> bool:
    return steps[: len(above)] == above


def _is_path(path: str) -> bool:
    try:
        return bool(steps_of(path))
    except RightsError:
        return False


def _contradict(one: Reservation, other: Reservation) -> bool:
    """Whether two users have reserved the same thing."""
    return one.uid != other.uid and (_is_below(one.steps, other.steps) or _is_below(other.steps, one.steps))


def _age(one: Reservation) -> tuple[int, str]:
    return one.begun_ns, one.id
