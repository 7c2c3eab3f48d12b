"""Kinds that choose one of several: enums, literals, unions, and Any."""

from __future__ import annotations

import enum
from typing import Any

from failover.errors import FitError, KeepError
from failover.state.advice import advice_for
from failover.state.containers import TUPLE
from failover.state.kinds import Build, Kind, Walk, with_article
from failover.state.wire import INT_MAX, INT_MIN, SAME, Place, Wire, mark_of, text_of

AS = "$as"
"""Mark of a union's value where the wire alone would not say which of its types it is: [label, value]. A label is looked up in
the declaration only."""


class EnumKind(Kind):
    """Members of an enum, by name."""

    shapes = frozenset({"str"})

    def __init__(self, cls: type[enum.Enum]) -> None:
        self.name = cls.__name__
        self.types = frozenset({cls})
        self._cls = cls

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not self._cls:
            raise self.stranger(value, place)
        return value.name

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        member = self._cls.__members__.get(wire) if type(wire) is str else None
        if member is None:
            raise self.misfit(wire, place, f"its members are {', '.join(list(self._cls.__members__)[:8])}")
        return member

    def description(self) -> str:
        return f"{self.name}({' | '.join(self._cls.__members__)})"


class FlagKind(Kind):
    """Sets of flags, by the names of their members; bits without a name as one integer at the end."""

    shapes = frozenset({TUPLE})

    def __init__(self, cls: type[enum.Flag]) -> None:
        self.name = cls.__name__
        self.types = frozenset({cls})
        self._cls = cls

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) is not self._cls:
            raise self.stranger(value, place)
        members = list(value) if value.value >= 0 else []
        rest = value.value
        for member in members:
            rest &= ~member.value
        if not INT_MIN <= rest <= INT_MAX:
            raise self.stranger(value, place, "its bits without a name are beyond 64; name them")
        names = [member.name for member in members]
        return {TUPLE: [*names, rest] if rest else names}

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        if mark_of(wire) != TUPLE or type(wire[TUPLE]) is not list:
            raise self.misfit(wire, place)
        names: list[Wire] = wire[TUPLE]
        rest = names[-1] if names and type(names[-1]) is int else 0
        bits = rest
        for name in names[:-1] if rest else names:
            if type(name) is not str or name not in self._cls.__members__:
                raise self.misfit(name, place, f"its members are {', '.join(list(self._cls.__members__)[:8])}")
            bits |= self._cls.__members__[name].value
        try:
            found = self._cls(bits)
        except ValueError as error:
            raise self.misfit(wire, place, str(error)) from error
        if 0 <= bits != found.value:  # Python 3.11.2 drops bits that a strict Flag does not know
            raise self.misfit(wire, place, f"it has no member for some bits of {bits:#x}")
        return found

    def description(self) -> str:
        return f"{self.name}({' | '.join(self._cls.__members__)})"


class LiteralKind(Kind):
    """One of a few values, each kept by the kind of its type."""

    def __init__(self, members: tuple[tuple[Any, Kind], ...]) -> None:
        self._members = members
        self.name = f"Literal[{', '.join(repr(value) for value, _ in members)}]"
        self.types = frozenset(type(value) for value, _ in members)
        self.shapes = frozenset[str]().union(*(kind.shapes for _, kind in members))

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        for member, kind in self._members:
            if type(member) is type(value) and member == value:
                return kind.lower(value, walk, place)
        raise self.stranger(value, place, "")

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        for member, kind in self._members:
            try:
                value = kind.lift(wire, build, place)
            except FitError:
                continue
            if type(member) is type(value) and member == value:
                return member
        raise self.misfit(wire, place)


class UnionKind(Kind):
    """A value of one of several types; the first that fits, in the order of declaration."""

    def __init__(self, arms: tuple[Kind, ...]) -> None:
        self.name = " | ".join(arm.name for arm in arms)
        self._arms = arms
        self._labels = {arm.name: arm for arm in arms}
        self.types = frozenset[type]().union(*(arm.types for arm in arms))
        self.exact = frozenset[type]().union(*(arm.exact for arm in arms))
        self.shapes = frozenset[str]({AS}).union(*(arm.shapes for arm in arms))
        self._by_type = {cls: tuple(arm for arm in arms if cls in arm.types) for cls in self.types}
        self._labelled = frozenset(arm for arm in arms if any(_contradict(arm, other, arm.shapes) for other in arms))

    @property
    def has_twins(self) -> bool:
        """Whether two of its types have the same name, so that a label would not tell them apart."""
        return len(self._labels) != len(self._arms)

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        likely = self._by_type.get(type(value), self._arms)
        if len(likely) == 1:
            return self._labelled_as(likely[0], likely[0].lower(value, walk, place))
        mark = walk.mark()
        refusals = []
        for arm in likely:
            try:
                return self._labelled_as(arm, arm.lower(value, walk, place))
            except KeepError as refusal:
                walk.back_to(mark)
                refusals.append(refusal)
        raise refusals[0] if likely is not self._arms else self.stranger(value, place)

    def _labelled_as(self, arm: Kind, wire: Wire) -> Wire:
        return {AS: [arm.name, wire]} if arm in self._labelled and mark_of(wire) != SAME else wire

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        shape = shape_of(wire)
        if shape == SAME:
            made = build.made.get(wire[SAME]) if type(wire[SAME]) is str else None
            return build.again(wire, made[1] if made is not None and made[1] in self._arms else self, place)
        if shape == AS:
            return self._lift_labelled(wire, build, place)
        likely = [arm for arm in self._arms if shape in arm.shapes]
        if not likely or any(_contradict(likely[0], other, frozenset({shape})) for other in likely):
            raise self.misfit(wire, place)
        for arm in likely[:-1]:
            try:
                return arm.lift(wire, build, place)
            except FitError:
                continue
        return likely[-1].lift(wire, build, place)

    def _lift_labelled(self, wire: Wire, build: Build, place: Place) -> Any:
        payload = wire[AS]
        if type(payload) is not list or len(payload) != 2 or type(payload[0]) is not str:
            raise self.misfit(wire, place, "not a label and a value")
        arm = self._labels.get(payload[0])
        if arm is None:
            raise self.misfit(payload[1], place, f"stored as {payload[0][:40]!r}")
        return arm.lift(payload[1], build, place)

    def parts(self) -> tuple[Kind, ...]:
        return self._arms


def _contradict(left: Kind, right: Kind, shapes: frozenset[str]) -> bool:
    """Whether a wire value of one of these shapes could be meant for both, with different results."""
    return left is not right and not shapes.isdisjoint(right.shapes) and not (left.evident and right.evident)


def _nameless(value: object, where: str) -> KeepError:
    """The refusal of a value whose type a stored state would not tell."""
    cure = advice_for(type(value))
    if cure:
        return KeepError(f"cannot keep {where}: it holds {with_article(type(value).__name__)}: {cure}", where)
    message = f"cannot keep {where}: nothing but its own type ({type(value).__name__}) would say what it is"
    return KeepError(f"{message}; declare the type at its place, or take it out of the state", where)


def shape_of(wire: Wire) -> str:
    """The shape of a wire value, in the words of ``Kind.shapes``."""
    if type(wire) is dict:
        return mark_of(wire) or "record"
    return type(wire).__name__


class AnyKind(Kind):
    """A value of any of the built-in kinds, by its own type. No classes of the program: these are declared."""

    name = "Any"
    keeps_text = True

    def __init__(self) -> None:
        self._by_type: dict[type, Kind] = {}
        self._by_shape: dict[str, Kind] = {}

    def complete(self, kinds: tuple[Kind, ...]) -> None:
        """The built-in kinds, once those that contain Any exist; of two of one shape the first is meant."""
        self._by_type = {cls: kind for kind in reversed(kinds) for cls in kind.types}
        self._by_shape = {shape: kind for kind in reversed(kinds) for shape in kind.shapes}
        self.types = frozenset(self._by_type)
        self.shapes = frozenset(self._by_shape)
        self.exact = frozenset({type(None), bool, float})

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        kind = self._by_type.get(type(value)) or self._by_base(value)
        if kind is None:
            raise _nameless(value, text_of(place))
        return kind.lower(value, walk, place)

    def _by_base(self, value: object) -> Kind | None:
        """numpy's scalar types have a base in common."""
        return next((kind for cls, kind in self._by_type.items() if cls.__module__ == "numpy" and isinstance(value, cls)), None)

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        shape = shape_of(wire)
        if shape == SAME:
            made = build.made.get(wire[SAME]) if type(wire[SAME]) is str else None
            return build.again(wire, made[1] if made is not None and made[1] in self._by_type.values() else self, place)
        kind = self._by_shape.get(shape)
        if kind is None:
            raise self.misfit(wire, place)
        return kind.lift(wire, build, place)
