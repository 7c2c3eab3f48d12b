"""Hours of the week in which a rule holds: ``Mon-Fri 08:00-20:00``, ``Sat 22:00-06:00``, ``Mon,Wed``, ``09:00-17:00``."""

from __future__ import annotations

import re
from typing import Final

from msgspec import Struct

from failover.errors import RightsError

DAYS: Final = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
DAY_MINUTES: Final = 24 * 60
WEEK_MINUTES: Final = 7 * DAY_MINUTES

_FORM: Final = re.compile(r"(?:(?P<days>[A-Za-z][A-Za-z,\-]*))?\s*(?:(?P<begin>\d\d:\d\d)-(?P<end>\d\d:\d\d))?")


class Hours(Struct, frozen=True):
    """Spans of minutes of the week, from Monday 00:00, each ``begin <= minute < end``; one may go beyond the week's end."""

    text: str
    spans: tuple[tuple[int, int], ...]

    def hold(self, minute: int) -> bool:
        """Whether a minute of the week (0 … 10,079) is within."""
        return any(begin <= minute + shift < end for begin, end in self.spans for shift in (0, WEEK_MINUTES))


def parse(text: str) -> Hours:
    """Read hours. An end before the begin is on the next day.

    Raises:
        RightsError: they are not of the documented form.
    """
    found = _FORM.fullmatch(text.strip())
    if found is None or not found[0]:
        raise _wrong(text)
    days = sorted(_days(found["days"], text)) if found["days"] else range(7)
    begin, end = (_minute(found["begin"], text), _minute(found["end"], text)) if found["begin"] else (0, DAY_MINUTES)
    if begin == end:
        raise _wrong(text)
    length = (end - begin) % DAY_MINUTES or DAY_MINUTES
    return Hours(text, tuple((day * DAY_MINUTES + begin, day * DAY_MINUTES + begin + length) for day in days))


def minute_of(day: int, hour: int, minute: int) -> int:
    """The minute of the week; day 0 is Monday."""
    return day * DAY_MINUTES + hour * 60 + minute


def spelled(minute: int) -> str:
    """A minute of the week as a person writes it: ``Mon 09:05``."""
    day, rest = divmod(minute, DAY_MINUTES)
    return f"{DAYS[day]} {rest // 60:02}:{rest % 60:02}"


def _days(text: str, whole: str) -> set[int]:
    found: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.partition("-")
        begin = _day(first, whole)
        end = _day(last, whole) if dash else begin
        found |= {(begin + step) % 7 for step in range((end - begin) % 7 + 1)}
    return found


def _day(text: str, whole: str) -> int:
    if text.capitalize() not in DAYS:
        raise _wrong(whole)
    return DAYS.index(text.capitalize())


def _minute(text: str, whole: str) -> int:
    hour, minute = int(text[:2]), int(text[3:])
    if minute > 59 or hour * 60 + minute > DAY_MINUTES:
        raise _wrong(whole)
    return hour * 60 + minute


def _wrong(text: str) -> RightsError:
    return RightsError(f"hours = {text[:60]!r} is not understood; write days, hours or both: 'Mon-Fri 08:00-20:00', 'Sat,Sun'")
