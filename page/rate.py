"""A limit on how often something may be done: so many at once, and so many a second in the long run."""

from __future__ import annotations

import time
from collections import OrderedDict


class Rate:
    """A bucket that fills with time."""

    def __init__(self, a_second: float, at_once: int) -> None:
        self._a_second = a_second
        self._at_once = float(at_once)
        self._left = float(at_once)
        self._at_s = time.monotonic()

    def wait_s(self) -> float:
        """Take one; or, if there is none, take nothing and return the seconds until there is one."""
        now_s = time.monotonic()
        self._left = min(self._left + (now_s - self._at_s) * self._a_second, self._at_once)
        self._at_s = now_s
        if self._left < 1:
            return (1 - self._left) / self._a_second
        self._left -= 1
        return 0.0


class Rates:
    """The same for each of many who ask; those who have not asked for longest are forgotten."""

    def __init__(self, a_second: float, at_once: int, most: int = 1_024) -> None:
        self._each = a_second, at_once
        self._most = most
        self._rates: OrderedDict[str, Rate] = OrderedDict()

    def wait_s(self, who: str) -> float:
        """As `Rate.wait_s`."""
        rate = self._rates.setdefault(who, Rate(*self._each))
        self._rates.move_to_end(who)
        if len(self._rates) > self._most:
            self._rates.popitem(last=False)
        return rate.wait_s()
