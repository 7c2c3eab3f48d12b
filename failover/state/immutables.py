"""Kinds of immutable values: dates and times, Decimal, Fraction, UUID, addresses, paths, ranges, slices; msgspec.UNSET.

Each is a mark and two functions: value → payload, payload → value. The second refuses, by ValueError or TypeError, each payload
that the first would not have written; the kind turns that into a sentence with the place.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import pathlib
import uuid
import zoneinfo
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import Any

import msgspec
import numpy as np

from failover.errors import FitError, KeepError
from failover.state.kinds import Build, Kind, Walk
from failover.state.numbers import INT, TEXT, lower_text
from failover.state.wire import Place, Wire, mark_of, root_place

DIGITS_MAX = 100_000
"""Digits of a Decimal: more are a mistake or an attack."""

ZONE_NAME_MAX = 100
"""Characters of a time zone's name."""


class MarkedKind(Kind):
    """Immutable values of one class, stored under one mark."""

    evident = True

    def __init__(
        self,
        mark: str,
        cls: type,
        lower: Callable[[Any], Wire],
        lift: Callable[[Wire], Any],
        types: tuple[type, ...] = (),
    ) -> None:
        self.name = cls.__name__
        self.types = frozenset(types or (cls,))
        self.shapes = frozenset({mark})
        self.mark = mark
        self._lower, self._lift = lower, lift

    def lower(self, value: Any, walk: Walk, place: Place) -> Wire:
        if type(value) not in self.types:
            raise self.stranger(value, place)
        try:
            return {self.mark: self._lower(value)}
        except ValueError as error:
            raise self.stranger(value, place, str(error)) from error

    def lift(self, wire: Wire, build: Build, place: Place) -> Any:
        if mark_of(wire) != self.mark:
            raise self.misfit(wire, place)
        try:
            value = self._lift(wire[self.mark])
            same = self._lower(value) == wire[self.mark]
        except (ValueError, TypeError, KeyError, OverflowError, InvalidOperation, OSError) as error:
            raise self.misfit(wire, place, f"{error}"[:200]) from error
        if type(value) not in self.types or not same:
            raise self.misfit(wire, place, "not in the form that we write")
        return value


# Time


def _lower_zone(zone: dt.tzinfo | None) -> Wire:
    """A time zone: its name in the database, or [offset in µs, name or None]."""
    if zone is None:
        return None
    if type(zone) is zoneinfo.ZoneInfo and zone.key is not None:
        return zone.key
    if type(zone) is dt.timezone:
        offset = zone.utcoffset(None)
        name = zone.tzname(None)
        return [offset // dt.timedelta(microseconds=1), None if dt.timezone(offset).tzname(None) == name else name]
    raise ValueError("its time zone is neither a datetime.timezone nor a zoneinfo.ZoneInfo with a key; use one of these")


def _lift_zone(wire: Wire) -> dt.tzinfo | None:
    if wire is None:
        return None
    if type(wire) is str:
        if len(wire) > ZONE_NAME_MAX:
            raise ValueError("too long a name of a time zone")
        return zoneinfo.ZoneInfo(wire)
    offset_us, name = _parts(wire, int, object)
    offset = dt.timedelta(microseconds=offset_us)
    if name is None:
        return dt.UTC if not offset_us else dt.timezone(offset)
    return dt.timezone(offset, name)


def _parts(wire: Wire, *kinds: type) -> list[Any]:
    """The elements of a list, each of exactly one type (``object``: any)."""
    if type(wire) is not list or len(wire) != len(kinds):
        raise ValueError(f"not a list of {len(kinds)}")
    if not all(kind is object or type(part) is kind for part, kind in zip(wire, kinds, strict=True)):
        raise ValueError(f"not of {', '.join(kind.__name__ for kind in kinds)}")
    return wire


def _lower_moment(value: Any) -> Wire:
    """A datetime or a time: ISO text without zone, zone, fold."""
    return [value.replace(tzinfo=None).isoformat(), _lower_zone(value.tzinfo), value.fold]


def _lift_datetime(wire: Wire) -> dt.datetime:
    text, zone, fold = _parts(wire, str, object, int)
    return dt.datetime.fromisoformat(text).replace(tzinfo=_lift_zone(zone), fold=fold)


def _lift_time(wire: Wire) -> dt.time:
    text, zone, fold = _parts(wire, str, object, int)
    return dt.time.fromisoformat(text).replace(tzinfo=_lift_zone(zone), fold=fold)


def _lift_timedelta(wire: Wire) -> dt.timedelta:
    days, seconds, microseconds = _parts(wire, int, int, int)
    return dt.timedelta(days, seconds, microseconds)


# Numbers beyond those of a wire


def _lift_decimal(wire: Wire) -> Decimal:
    if len(_text(wire)) > DIGITS_MAX:
        raise ValueError(f"more than {DIGITS_MAX} digits")
    return Decimal(wire)


def _lower_decimal(value: Decimal) -> str:
    text = str(value)
    if len(text) > DIGITS_MAX:
        raise ValueError(f"more than {DIGITS_MAX} digits")
    return text


_BUILD = Build({}, lambda name, shape, dtype: np.empty(shape, dtype), shared=False)
"""For parts that hold neither arrays nor shared objects."""


def _whole(*numbers: int) -> list[Wire]:
    """Integers of any size."""
    try:
        return [INT.lower(number, Walk(0), root_place("integer")) for number in numbers]
    except KeepError as error:
        raise ValueError("one of its integers is too large") from error


def _integers(wire: Wire, count: int) -> list[int]:
    try:
        return [INT.lift(part, _BUILD, root_place("integer")) for part in _parts(wire, *[object] * count)]
    except FitError as error:
        raise ValueError(f"not {count} integers") from error


def _lift_fraction(wire: Wire) -> Fraction:
    numerator, denominator = _integers(wire, 2)
    if denominator < 1:
        raise ValueError("its denominator is not positive")
    return Fraction(numerator, denominator)


def _lower_slice(value: slice) -> Wire:
    """Of whole numbers; others are anything that an index may be."""
    parts = (value.start, value.stop, value.step)
    if not all(part is None or type(part) is int for part in parts):
        raise ValueError("its bounds are neither integers nor None")
    return [None if part is None else _whole(part)[0] for part in parts]


def _lift_slice(wire: Wire) -> slice:
    return slice(*(None if part is None else _integers([part], 1)[0] for part in _parts(wire, object, object, object)))


# Names


def _text(wire: Wire) -> str:
    if type(wire) is not str:
        raise TypeError("not text")
    return wire


def _lift_uuid(wire: Wire) -> uuid.UUID:
    if type(wire) is not bytes:
        raise TypeError("not 16 bytes")
    return uuid.UUID(bytes=wire)


def _address_kind(cls: type) -> MarkedKind:
    """Addresses, networks and interfaces, by their text."""
    return MarkedKind(f"${cls.__name__.lower()}", cls, str, lambda wire: cls(_text(wire)))


def _lift_unset(wire: Wire) -> msgspec.UnsetType:
    if wire is not None:
        raise ValueError("it has no content")
    return msgspec.UNSET


def _lift_text(wire: Wire) -> str:
    try:
        return str(TEXT.lift(wire, _BUILD, root_place("path")))
    except FitError as error:
        raise ValueError("not text") from error


def _path_kind(mark: str, cls: type[pathlib.PurePath]) -> MarkedKind:
    """Paths of one class; ``Path`` is what the machine makes of it."""
    return MarkedKind(mark, cls, lambda value: lower_text(str(value)), lambda wire: cls(_lift_text(wire)), (type(cls()),))


DATETIME = MarkedKind("$datetime", dt.datetime, _lower_moment, _lift_datetime)
PATH = _path_kind("$path", pathlib.Path)

PLAIN_KINDS: dict[type, MarkedKind] = {
    dt.datetime: DATETIME,
    dt.date: MarkedKind("$date", dt.date, dt.date.isoformat, lambda wire: dt.date.fromisoformat(_text(wire))),
    dt.time: MarkedKind("$time", dt.time, _lower_moment, _lift_time),
    dt.timedelta: MarkedKind(
        "$timedelta", dt.timedelta, lambda value: [value.days, value.seconds, value.microseconds], _lift_timedelta
    ),
    dt.timezone: MarkedKind("$timezone", dt.timezone, _lower_zone, _lift_zone),
    zoneinfo.ZoneInfo: MarkedKind("$zone", zoneinfo.ZoneInfo, _lower_zone, _lift_zone),
    Decimal: MarkedKind("$decimal", Decimal, _lower_decimal, _lift_decimal),
    Fraction: MarkedKind("$fraction", Fraction, lambda value: _whole(value.numerator, value.denominator), _lift_fraction),
    uuid.UUID: MarkedKind("$uuid", uuid.UUID, lambda value: value.bytes, _lift_uuid),
    range: MarkedKind(
        "$range", range, lambda value: _whole(value.start, value.stop, value.step), lambda wire: range(*_integers(wire, 3))
    ),
    slice: MarkedKind("$slice", slice, _lower_slice, _lift_slice),
    msgspec.UnsetType: MarkedKind("$unset", msgspec.UnsetType, lambda value: None, _lift_unset),
    **{
        cls: _address_kind(cls)
        for cls in (
            ipaddress.IPv4Address,
            ipaddress.IPv6Address,
            ipaddress.IPv4Network,
            ipaddress.IPv6Network,
            ipaddress.IPv4Interface,
            ipaddress.IPv6Interface,
        )
    },
    pathlib.Path: PATH,
    pathlib.PurePosixPath: _path_kind("$posixpath", pathlib.PurePosixPath),
    pathlib.PureWindowsPath: _path_kind("$windowspath", pathlib.PureWindowsPath),
}
"""Every class that is kept this way."""

PLAIN_KINDS[type(pathlib.Path())] = PATH
PLAIN_KINDS[pathlib.PurePath] = PLAIN_KINDS[type(pathlib.PurePath())]
