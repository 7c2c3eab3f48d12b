"""Divide one memory limit among the page caches of all streams of a robot (`checkpoint.store.xor_cache`), by need.

A cache that needs little gets all that it needs; the others share the rest equally. No cache is given memory that another one
still holds: a cache that is to have less gives it up at its next snapshot, so that the total never exceeds the limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from threading import Lock
from typing import Final

from msgspec import Struct

PARTS: Final = 256
"""Parts of the bound: a share is a number of these, because a change of a share copies its pages."""


class _User(Struct):
    """Bytes: ``wanted``, 0 as long as that is not known; ``granted``; ``held`` when it was told last."""

    wanted: int = 0
    granted: int = 0
    held: int = 0


class PageBudget:
    """The share of each user of the budget. From any thread.

    Args:
        limit: bytes for all together.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._grain = max(limit // PARTS, 1)
        self._users: dict[str, _User] = {}
        self._lock = Lock()

    @property
    def held(self) -> int:
        """Bytes that are held now, by all."""
        with self._lock:
            return sum(user.held for user in self._users.values())

    def share(self, name: str, wanted: int, held: int) -> int:
        """How many bytes one may hold from now on.

        Args:
            wanted: bytes that it would hold if it had room; 0: not known yet, then it gets the free rest and none from others.
            held: bytes that it holds.
        """
        with self._lock:
            user = self._users.setdefault(name, _User())
            user.held = held
            user.wanted = 1 << (max(wanted, self._grain) - 1).bit_length() if wanted else 0  # few steps, so that shares stay
            free = self.limit - sum(other.granted for other in self._users.values() if other is not user)
            wants = {one: other.wanted for one, other in self._users.items()}
            fair = shares(self.limit, wants)[name] if wanted else self.limit
            user.granted = max(min(fair, free), 0) // self._grain * self._grain
            return user.granted

    def leave(self, name: str) -> None:
        """It holds nothing any more."""
        with self._lock:
            self._users.pop(name, None)


def shares(limit: int, wants: Mapping[str, int]) -> dict[str, int]:
    """The share of each: all that it wants, or as much as every other one that does not get all."""
    left, given = limit, {}
    for count, name in zip(range(len(wants), 0, -1), sorted(wants, key=lambda name: wants[name]), strict=True):
        given[name] = min(wants[name], left // count)
        left -= given[name]
    return given
