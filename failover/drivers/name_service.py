"""The name service of one driver: a thread that registers it, and knows all names that others have registered."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from failover.boards import boottime
from failover.core.naming.records import Record
from failover.core.naming.scan import MULTICAST, Scan, Send, Terms
from failover.core.naming.tree import Place, Reach, Tree, robot_of
from failover.drivers.exchange import DOOR_RETRY_NS, ENDING, Exchange
from failover.drivers.here import Here, TeamNow, stem
from failover.errors import NameFormatError

BOOT_SHIFT: Final = 20
"""A boot is the wall clock in ns, shifted: it grows each millisecond. If the clock was set back, the scan mends it."""


FAREWELL_NS: Final = 50_000_000
"""How long a driver that ends answers those that ask what has changed."""


_boots_lock: Final = threading.Lock()
_last_boot = 0


def new_boot() -> int:
    """Greater than all that this process has got, and than in all lives before, unless the wall clock was set back."""
    global _last_boot
    with _boots_lock:
        _last_boot = max(_last_boot + 1, time.time_ns() >> BOOT_SHIFT)
        return _last_boot


TEAM_LOOK_NS: Final = 1_000_000_000
"""Between two looks at the team's files."""


def _seeds(here: Here) -> list[str]:
    return [f"{robot}/" for robot in here.others]


class NameService:
    """Registers what a process speaks for as long as it is open. `resolve` and `tree` may be called from any thread."""

    def __init__(
        self,
        here: Here,
        record: Record,
        terms: Terms = Terms(),  # noqa: B008  frozen
        epoch: Callable[[], int] = lambda: 0,
        others: Sequence[Record] = (),
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        """
        Args:
            changed: called when members or keys of the team are others.
            epoch: of the primacy under which the driver runs now; 0 without an agent.
            others: what else this process speaks for.

        Raises:
            NameFormatError: the record cannot be registered.
            DriverError: the sockets cannot be made.
        """
        name = stem(record.path, here.directory)
        self._exchange = Exchange(here, f"{name}.{ENDING}")
        self._now = TeamNow(here)
        self._changed = changed
        self._lock = threading.Lock()
        self._skew = boottime.skew_ns()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._is_over = False
        self._epoch = epoch
        self.rival: Place | None = None
        """A living driver of the same path under the highest epoch of all that are not this one; None: there is none."""
        self._told: dict[str, tuple[int, int]] = {}
        self._scan = Scan(
            f"{here.robot}/{name}",
            new_boot(),
            self._now_ns(),
            address=self._exchange.address,
            seeds=_seeds(here),
            multicast=True,
            terms=terms,
            claims=here.claims,
        )
        try:
            self.record = self._scan.put(record, self._now_ns())
            for other in others:
                self._scan.put(other, self._now_ns())
        except BaseException:
            self._close()
            raise
        self._thread = threading.Thread(target=self._serve, name="failover names", daemon=True)

    def start(self) -> None:
        """Tell the others."""
        self._exchange.be_door(self._now_ns())
        self._thread.start()

    def replace(self, record: Record) -> None:
        """Register another record of the same path.

        Raises:
            NameFormatError: it cannot be registered; the one before stands.
        """
        with self._lock:
            self.record = self._scan.put(record, self._now_ns())
        os.eventfd_write(self._wake, 1)

    def look(self) -> None:
        """The epoch has changed: register it, from any thread."""
        os.eventfd_write(self._wake, 1)

    def tree(self) -> Tree:
        """All names as this process knows them now."""
        with self._lock:
            return self._scan.tree(self._now_ns())

    def resolve(self, name: str) -> Place:
        """What answers to a name of any kind; raises as `Tree.resolve`."""
        return self.tree().resolve(name)

    def close(self) -> None:
        """Withdraw the record, and tell the others at once."""
        self._is_over = True
        os.eventfd_write(self._wake, 1)
        if self._thread.is_alive():
            self._thread.join()
        self._close()

    def _close(self) -> None:
        self._exchange.close()
        os.close(self._wake)

    def _now_ns(self) -> int:
        return boottime.now_ns(self._skew)

    def _serve(self) -> None:
        while not self._is_over:
            now_ns = self._now_ns()
            self._look()
            self._exchange.be_door(now_ns)
            self._turn(now_ns, now_ns + (DOOR_RETRY_NS if self._now.here.team is None else TEAM_LOOK_NS))
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)
        with self._lock:
            for path in list(self._scan.own.entries):
                self._scan.remove(path, self._now_ns(), urgent=True)
            until_ns = self._scan.next_ns() + FAREWELL_NS
        while (now_ns := self._now_ns()) < until_ns:
            self._turn(now_ns, until_ns)

    def _turn(self, now_ns: int, until_ns: int) -> None:
        """Scan if it is due; then take in what comes, once it comes, until the next scan at most."""
        with self._lock:
            self._renew(now_ns)
            sends = self._scan.tick(now_ns)
            until_ns = min(until_ns, self._scan.next_ns())
        self._exchange.send(sends)
        messages = self._exchange.receive(until_ns - now_ns, self._wake if not self._is_over else -1)
        for message in messages:
            with self._lock:
                sends = self._scan.heard(message, self._now_ns())
            self._exchange.send(sends)
        self._find_rival()
        if messages and self._exchange.is_door:
            self._pass_on()

    def _look(self) -> None:
        """Go on with the team as its files have it now."""
        if self._now.look():
            with self._lock:
                self._scan.know(_seeds(self._now.here), self._now.here.claims)
                self._scan.soon(self._now_ns())
            self._exchange.know(self._now.here)
            self._changed()

    def _renew(self, now_ns: int) -> None:
        """Tell the epoch under which the driver runs on, if it is another one."""
        if not self._is_over and (epoch := self._epoch()) > self.record.epoch:
            with contextlib.suppress(NameFormatError):  # no room for a larger number: what senders tell each other decides
                self.record = self._scan.put(msgspec.structs.replace(self.record, epoch=epoch), now_ns, urgent=True)

    def _find_rival(self) -> None:
        if not self._epoch():
            self.rival = None  # without an agent no copy is fenced
            return
        places = self.tree().claimants(self.record.path)
        others = [one for one in places if one.origin != self._scan.origin and one.reach is Reach.LIVE and not one.refused]
        self.rival = max(others, key=lambda one: one.record.epoch, default=None)

    def _pass_on(self) -> None:
        """The door tells other robots at once what is new on this one, and this one's drivers what is new elsewhere."""
        with self._lock:
            versions = self._scan.versions()
            news = {robot_of(origin) for origin, version in versions.items() if self._told.get(origin) != version}
            self._told = versions
            if self._exchange.here.robot in news:
                self._scan.soon(self._now_ns())
            digest = self._scan.digest(self._now_ns())
        if news - {self._exchange.here.robot}:
            self._exchange.send([Send(MULTICAST, digest)])
