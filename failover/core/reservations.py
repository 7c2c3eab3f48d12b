"""Reservations: a path and all below it is one user's for a time. Pure: every instant is an argument.

While a reservation stands, orders of other users about what is below its path are refused; the failover itself asks nothing here.
Each robot has a table; what one learns it tells the others, with spans in the place of instants, as their clocks differ. The end
of a reservation is told like its beginning, so no robot that was away brings it back.

Invariants: a reservation stands until its instant at the latest; one that is over never stands again; of two that overlap, which
only robots that had not heard each other yet can have granted, the one with the lesser id counts, at all robots alike.
"""

from __future__ import annotations

import functools
from collections import Counter
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
"""At one robot, of those that are not over: each order and each status compares them with each other. As many more of root's."""

OVER_MAX: Final = 64
"""Of those that are over and would still last."""

KNOWN_MAX: Final = 2 * RESERVATIONS_MAX + OVER_MAX
"""All of them together."""

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
        id: of its own, the same at every robot. It begins with the instant by the calendar, see `id_of`: the lesser one is older.
        uid, user: whose it is, by number and by name.
        over: it has ended before its time.
    """

    id: str
    path: str
    uid: int
    user: str
    why: str
    until_ns: int
    over: bool = False

    @functools.cached_property
    def steps(self) -> tuple[str, ...]:
        """Of its path."""
        return steps_of(self.path)


class Told(Struct, frozen=True, forbid_unknown_fields=True):
    """The same as it travels: how long it is to stand, in ms."""

    id: Annotated[str, Meta(min_length=1, max_length=ID_SIZE_MAX, pattern=ONE_LINE)]
    path: Annotated[str, Meta(min_length=1, max_length=SIZE_MAX, pattern=ONE_LINE)]
    uid: Annotated[int, Meta(ge=0)]
    user: Annotated[str, Meta(max_length=USER_SIZE_MAX, pattern=ONE_LINE)]
    why: Annotated[str, Meta(max_length=WHY_SIZE_MAX, pattern=ONE_LINE)]
    left_ms: Span
    over: bool


class Table:
    """What one robot knows."""

    def __init__(self, known: Iterable[Reservation] = (), above: frozenset[int] = frozenset()) -> None:
        """
        Args:
            above: users who have places of their own: root, and the user of the agent.
        """
        self._all = {one.id: one for one in known if _is_path(one.path)}
        self._above = above

    def all(self, now_ns: int) -> tuple[Reservation, ...]:
        """Those whose time has not come, also those that are over; the oldest first."""
        self._all = {one.id: one for one in self._all.values() if one.until_ns > now_ns}
        return tuple(sorted(self._all.values(), key=lambda one: one.id))

    def standing(self, now_ns: int) -> tuple[Reservation, ...]:
        """Those that count; the oldest first."""
        found: list[Reservation] = []
        for one in self.all(now_ns):
            if not one.over and not any(_contradict(one, older) for older in found):
                found.append(one)
        return tuple(found)

    def over_path(self, path: str, now_ns: int) -> Reservation | None:
        """The one in which a path is, see `covering`. Raises RightsError: it is no path."""
        return covering(self.standing(now_ns), path)

    def hinders(self, uid: int, path: str, now_ns: int) -> Reservation | None:
        """The one because of which a user may give no order about a path; None: no other user has reserved it."""
        found = self.over_path(path, now_ns)
        return found if found is not None and found.uid != uid else None

    def why_not(self, wanted: Reservation, now_ns: int) -> Reservation | str:
        """What keeps it from beginning: another user's, or a sentence; "" for nothing."""
        if other := next((one for one in self.standing(now_ns) if _contradict(one, wanted)), None):
            return other
        others = [one for one in self._lasting(now_ns) if (one.uid, one.path) != (wanted.uid, wanted.path)]
        if sum(one.uid == wanted.uid for one in others) >= OF_USER_MAX:
            return f"{wanted.user} has {OF_USER_MAX} reservations already; end one with failover unreserve NAME"
        if self._fill(wanted, others):
            return f"this robot knows {RESERVATIONS_MAX} reservations already; wait until one has ended"
        return ""

    def begin(self, wanted: Reservation, now_ns: int) -> tuple[Reservation, ...]:
        """Let it stand, in the place of one of the same user at the same path; what has changed. `why_not` was asked."""
        replaced = [one for one in self.standing(now_ns) if (one.uid, one.path) == (wanted.uid, wanted.path)]
        changed = (*(self.end(one) for one in replaced), wanted)
        self._add(wanted, now_ns)
        return changed

    def _add(self, one: Reservation, now_ns: int) -> bool:
        """Take it in; whether there was room."""
        if not one.over and self._fill(one, self._lasting(now_ns)):
            return False
        self._all[one.id] = one
        self._forget_some()
        return True

    def _lasting(self, now_ns: int) -> list[Reservation]:
        return [one for one in self.all(now_ns) if not one.over]

    def _fill(self, one: Reservation, others: list[Reservation]) -> bool:
        """Whether these leave no place for one."""
        return sum((other.uid in self._above) is (one.uid in self._above) for other in others) >= RESERVATIONS_MAX

    def _forget_some(self) -> None:
        """Of too many that are over, forget those of the user who has most of them: none makes room by another user's."""
        over = [one for one in self._all.values() if one.over]
        while len(over) > OVER_MAX:
            many = Counter(one.uid for one in over)
            least = max(over, key=lambda one: (many[one.uid], -one.until_ns))
            over.remove(least)
            del self._all[least.id]

    def end(self, one: Reservation) -> Reservation:
        """It is over; the same, over."""
        ended = self._all[one.id] = replace(self._all.get(one.id, one), over=True)
        self._forget_some()
        return ended

    def hear(self, told: Told, now_ns: int) -> bool:
        """Take what another robot knows; whether it was news. A telling that comes late makes none longer."""
        known, until_ns = self._all.get(told.id), now_ns + told.left_ms * MS
        if known is not None:
            if until_ns < known.until_ns:
                self._all[told.id] = replace(known, until_ns=until_ns)
            if told.over and not known.over:
                self.end(known)
                return True
            return False
        if not told.left_ms or not _is_path(told.path):
            return False
        return self._add(Reservation(told.id, told.path, told.uid, told.user, told.why, until_ns, told.over), now_ns)


def id_of(now_ns: int, dice: str) -> str:
    """Of one that begins now.

    Args:
        now_ns: since 1970, by the calendar of the robot where it begins. dice: so that no two are the same.
    """
    return f"{now_ns:016x}{dice}"


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
    left_ms = min(max(-((now_ns - one.until_ns) // MS), 0), SPAN_MS_MAX)  # rounded up: no telling shortens it
    return Told(one.id, one.path, one.uid, one.user, one.why, left_ms, one.over)


def covering(standing: Iterable[Reservation], path: str) -> Reservation | None:
    """Of these the one in which a path is; of one user's several the deepest.

    Raises:
        RightsError: it is no path.
    """
    steps = steps_of(path)
    return max((one for one in standing if _is_below(steps, one.steps)), key=lambda one: len(one.steps), default=None)


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
