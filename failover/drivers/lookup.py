"""What others have registered, for a process that registers nothing: it asks the drivers of its robot, else other robots."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable
from typing import Final

from failover.core.naming.scan import MULTICAST, SECOND, Ask, Digest, Message, Pages, Scan, Send
from failover.core.naming.tree import Place, Tree
from failover.drivers.exchange import Exchange
from failover.drivers.here import Here
from failover.errors import NameUnknownError

LOCAL_NS: Final = SECOND
"""How long the drivers of this robot are waited for at most: they answer within milliseconds."""

TEAM_NS: Final = 5 * SECOND
"""How long other robots are, where this one has no driver: a connection is made first."""

ASK_AGAIN_NS: Final = SECOND // 4

DOOR_AGAIN_S: Final = 0.02
"""Between two tries to be the door: a program that asks is it for some milliseconds."""

_NUMBERS: Final = itertools.count(1)


class Lookup:
    """Asks once, and then is closed."""

    def __init__(self, here: Here, limit_ns: int = TEAM_NS) -> None:
        """
        Args:
            limit_ns: how long it may take at most.

        Raises:
            DriverError: the sockets cannot be made.
        """
        self._here = here
        self._limit_ns = limit_ns
        self._exchange = Exchange(here, f"{os.getpid()}-{next(_NUMBERS)}.ask")
        self._scan = Scan(f"{here.robot}/", 0, time.monotonic_ns(), address=self._exchange.address, claims=here.claims)
        self._announced: dict[str, dict[str, tuple[int, int]]] = {}

    def close(self) -> None:
        """Be reached no more."""
        self._exchange.close()

    def tree(self) -> Tree:
        """All names, once those that this robot's drivers know have arrived; without drivers those of other robots.

        Raises:
            NameUnknownError: no driver answers.
        """
        return self._found(lambda: None)

    def resolve(self, name: str) -> Place:
        """What answers to a name of any kind, as soon as that is known.

        Raises:
            NameFormatError, NameUnknownError, NameAmbiguousError: as `Tree.resolve`.
        """

        def place() -> Place | None:
            try:
                return self._tree().resolve(name, self._here.world)
            except NameUnknownError:
                return None

        found = self._found(place)
        return found.resolve(name, self._here.world)

    def _tree(self) -> Tree:
        return self._scan.tree(time.monotonic_ns())

    def _found(self, wanted: Callable[[], object | None]) -> Tree:
        neighbours = self._ask() or self._await_door()
        if not neighbours and not self._exchange.is_door:
            raise NameUnknownError(f"no driver runs on {self._here.robot} for this user{self._alone()}")
        now_ns = time.monotonic_ns()
        until_ns = now_ns + min(LOCAL_NS if neighbours else TEAM_NS, self._limit_ns)
        again_ns = now_ns if not neighbours else until_ns
        while now_ns < until_ns and not (neighbours and len(self._announced) >= neighbours and self._is_whole()):
            if now_ns >= again_ns:
                self._ask()
                again_ns = now_ns + ASK_AGAIN_NS
            for message in self._exchange.receive(min(until_ns, again_ns) - now_ns):
                self._take(message)
            if self._is_whole() and wanted() is not None:
                break
            now_ns = time.monotonic_ns()
        if not self._announced:
            raise NameUnknownError(f"no driver answers: none on {self._here.robot}, and none of another robot within 5 s")
        return self._tree()

    def _await_door(self) -> int:
        """Be the door, once other programs that ask have been it. Returns the number of drivers that have come meanwhile."""
        now_ns = time.monotonic_ns()
        until_ns = now_ns + min(TEAM_NS, self._limit_ns)
        while self._here.team is not None and not self._exchange.be_door(now_ns, 0) and now_ns < until_ns:
            time.sleep(DOOR_AGAIN_S)
            if neighbours := self._ask():
                return neighbours
            now_ns = time.monotonic_ns()
        return 0

    def _alone(self) -> str:
        return f", and other robots are not reached: {self._here.alone}" if self._here.alone else ""

    def _ask(self) -> int:
        """Ask for digests; how many drivers of this robot were asked."""
        nothing = Digest(self._exchange.address, ())
        reached = self._exchange.send([Send(MULTICAST, nothing)])
        self._exchange.send([Send(f"{robot}/", nothing) for robot in self._here.others])
        return reached

    def _take(self, message: Message) -> None:
        """Take in what a driver tells; all that goes out for it are questions."""
        if isinstance(message, Digest):
            self._announced[message.address] = {row.origin: (row.boot, row.serial) for row in message.rows}
        if isinstance(message, Digest | Pages):
            sends = self._scan.heard(message, time.monotonic_ns())
            self._exchange.send([one for one in sends if isinstance(one.message, Ask)])

    def _is_whole(self) -> bool:
        """Whether all that was announced has arrived."""
        versions = self._scan.versions()
        return bool(self._announced) and all(
            versions.get(origin, (0, 0)) >= version for rows in self._announced.values() for origin, version in rows.items()
        )


def lookup(here: Here, name: str, limit_ns: int = TEAM_NS) -> Place:
    """What answers to a name; raises as `Lookup.resolve`."""
    asking = Lookup(here, limit_ns)
    try:
        return asking.resolve(name)
    finally:
        asking.close()


def whole_tree(here: Here) -> Tree:
    """All names; raises as `Lookup.tree`."""
    asking = Lookup(here)
    try:
        return asking.tree()
    finally:
        asking.close()
