"""Logins with a password: few guesses at once, each counted before it is checked, and slow after the first wrong ones."""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from failover.config.page import UserConfig, is_password
from page.errors import TurnedAwayError
from page.limits import GUESSES_AT_ONCE

FREE_TRIES: Final = 3
"""Wrong passwords for a name from one place before the next one has to wait …"""

DELAY_MAX_S: Final = 60.0
"""… twice as long each time, up to so long: a person with the right password waits at most this."""

DOUBLINGS_MAX: Final = 6
"""2⁶ s are more than `DELAY_MAX_S`."""

FORGOTTEN_S: Final = 600.0
"""After so long without a wrong password the tries are free again."""

PLACES_MAX: Final = 1_024
"""Names and places whose wrong passwords are remembered."""

_NO_USER: Final = UserConfig(password="scrypt:16384:8:1:AAAAAAAAAAAAAAAAAAAAAA==:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=")
"""A name that there is not takes as long as a wrong password."""


class Passwords:
    """Who knows the password of a name. Lives in one loop.

    Wrong ones are counted for each name and place: a guess from elsewhere does not keep a user, or Prometheus, out. All unknown
    names are one name.
    """

    def __init__(self, users: Mapping[str, UserConfig]) -> None:
        self._users = users
        self._wrong: OrderedDict[tuple[str, str], tuple[int, float]] = OrderedDict()
        self._busy: set[tuple[str, str]] = set()
        self._checker = ThreadPoolExecutor(1, "password")  # each check takes 16 MB and some hundredths of a second

    async def check(self, name: str, password: str, place: str, *, forgives: bool) -> None:
        """Let a user in.

        Args:
            place: from which it is tried. forgives: a right one makes the tries free again; otherwise it counts for nothing.

        Raises:
            TurnedAwayError: it is not right, too many wrong ones came before, or too many are checked now.
        """
        key = (name if name in self._users else "", place)
        if wait_s := self._wait_s(key):
            raise TurnedAwayError(429, f"wrong passwords for this name: wait {math.ceil(wait_s)} s", wait_s)
        if key in self._busy or len(self._busy) >= GUESSES_AT_ONCE:
            raise TurnedAwayError(429, "another password is being checked; try again in a moment", 1)
        before = self._wrong.get(key)
        self._note(key)
        self._busy.add(key)
        try:
            right = await asyncio.get_running_loop().run_in_executor(self._checker, self.is_right, name, password)
        finally:
            self._busy.discard(key)
        if not right:
            raise TurnedAwayError(403, "name and password do not belong together")
        self._wrong.pop(key, None)
        if before is not None and not forgives:
            self._wrong[key] = before

    def is_right(self, name: str, password: str) -> bool:
        """Whether it is that user's password; takes a tenth of a second of a thread."""
        user = self._users.get(name)
        return is_password(password, (user or _NO_USER).password) and user is not None and bool(password)

    def close(self) -> None:
        """Check no more."""
        self._checker.shutdown(wait=False, cancel_futures=True)

    def _wait_s(self, key: tuple[str, str]) -> float:
        """How long the next try must wait."""
        tries, at_s = self._wrong.get(key, (0, 0.0))
        if tries < FREE_TRIES:
            return 0.0
        return max(at_s + min(2.0 ** min(tries - FREE_TRIES, DOUBLINGS_MAX), DELAY_MAX_S) - time.monotonic(), 0.0)

    def _note(self, key: tuple[str, str]) -> None:
        """One more, wrong until it is found right."""
        now_s = time.monotonic()
        tries, at_s = self._wrong.pop(key, (0, now_s))
        self._wrong[key] = (tries + 1 if now_s - at_s < FORGOTTEN_S else 1), now_s
        if len(self._wrong) > PLACES_MAX:
            self._wrong.popitem(last=False)
