"""The way to one driver, wherever it runs: found by its name, and found anew once the driver is elsewhere."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING, Final

from failover.boards import boottime
from failover.core.naming.tree import Place
from failover.drivers.here import Here, TeamNow
from failover.drivers.local import SCHEME, LocalWay
from failover.drivers.lookup import lookup
from failover.errors import DriverError, FailoverError

if TYPE_CHECKING:
    from failover.drivers.sockets import TeamWay

LOOK_NS: Final = 2_000_000_000
"""How long it may take to look a name up while messages wait."""


class Route:
    """A driver's place, and an open way to it; used by one thread at a time."""

    def __init__(self, here: Here, place: Place) -> None:
        """
        Raises:
            DriverError: the driver is on another robot that cannot be reached.
        """
        self._now = TeamNow(here)
        self._now.look()  # the driver may have gone to a robot that came into the team since
        here = self._now.here
        self.path = place.record.path
        self.place = place
        self.address = address_of(here, place)
        self.way = way_to(here, self.address, place.robot)
        self._skew = boottime.skew_ns()

    def now_ns(self) -> int:
        """The clock of this process's hops."""
        return boottime.now_ns(self._skew)

    def look_again(self, limit_ns: int = LOOK_NS) -> bool:
        """The driver does not answer: it may have been started anew, at another address; whether it was. Then the way is new."""
        with contextlib.suppress(*_may_pass()):  # it is waited for where it was
            self._now.look()
            here = self._now.here
            place = lookup(here, self.path, min(limit_ns, LOOK_NS))
            address = address_of(here, place)
            if address != self.address:
                way = way_to(here, address, place.robot)
                self.way.close()
                self.place, self.address, self.way = place, address, way
                return True
        return False

    def close(self, linger_ms: int = 0) -> None:
        """Let the connection go."""
        self.way.close(linger_ms)


def way_to(here: Here, address: str, robot: str) -> LocalWay | TeamWay:
    """A way to a driver at this address; `DriverError`: the team's keys are not here."""
    if address.startswith(SCHEME):
        return LocalWay(address.removeprefix(SCHEME))
    from failover.drivers.sockets import TeamWay  # ZeroMQ is loaded only by who needs other robots

    return TeamWay(address, here, robot)


def address_of(here: Here, place: Place) -> str:
    """By which address this process reaches a driver: a unix socket on its own robot, else tcp.

    Raises:
        DriverError: by none.
    """
    scheme = SCHEME if place.robot == here.robot else "tcp://"
    found = next((address for address in place.record.addresses if address.startswith(scheme)), "")
    if not found:
        why = here.alone or f"its driver on {place.robot} opened no port: the key of the team could not be read there"
        raise DriverError(f"cannot reach {place.record.path} on {place.robot}: {why}")
    return found


def _may_pass() -> tuple[type[Exception], ...]:
    """What may be over at the next look: no name, no descriptor, no memory of the kernel."""
    zmq = sys.modules.get("zmq")  # loaded only by who needs other robots
    return (FailoverError, OSError, *((zmq.ZMQError,) if zmq is not None else ()))
