"""Many drivers in one process, behind the same sockets: of simulated devices. Each has its own mailbox, pace, streams and rights.

One driver stands for the process itself: its name is held, and is where messages without a receiver go. A message is given to the
driver that it names. What a driver of a process of its own promises holds for each of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from failover.core.naming import names
from failover.core.naming.records import Record
from failover.core.naming.scan import Terms
from failover.drivers.actor import Actor
from failover.drivers.call_rights import CallRights
from failover.drivers.declare import Declaration
from failover.drivers.here import Here
from failover.drivers.server import Serving
from failover.errors import NameFormatError

Device = tuple[Declaration, Callable[[], object]]
"""A driver as it is declared, and what makes its instance, when its first message comes."""


class ManyDrivers(Serving):
    """Serves all of them; a context manager as `Serving`."""

    def __init__(self, first: type, devices: Sequence[Device], place: Here | None = None, terms: Terms = Terms()) -> None:  # noqa: B008
        """
        Args:
            first: the class of the driver that stands for the process.

        Raises:
            DriverError: it cannot take messages.
            NameFormatError: a path cannot be registered here.
        """
        self._devices: Mapping[str, Device] = {declared.path: (declared, made) for declared, made in devices}
        self._paths = {alias: path for path, (declared, _) in self._devices.items() for alias in declared.aliases}
        self._actors: dict[str, Actor] = {}
        self._rights_by_actor: dict[Actor, CallRights] = {}
        self._busy: set[Actor] = set()
        super().__init__(first, place, terms)

    def end_with(self, descriptor: int) -> None:
        """End `serve` as soon as a descriptor can be read."""
        self._wait_for(descriptor, self.stop)

    def _others(self) -> Sequence[Record]:
        return [self.record_of(declared) for declared, _ in self._devices.values()]

    def _addressed(self, to: str) -> Actor | None:
        actor = self._actor_of(to)
        if actor is not None:
            self._busy.add(actor)
        return actor

    def _actor_of(self, to: str) -> Actor | None:
        path = to if not to or to in self._devices else self._path_of(to)
        if path not in self._devices:
            return self._actor if not path or self._actor.is_meant(path) else None
        found = self._actors.get(path)
        if found is None:
            declared, made = self._devices[path]
            found = self._actors[path] = Actor(made(), declared, f"{self.here.robot}/{self._name}")
            found.fence = self._fence
            self._rights_by_actor[found] = CallRights(self.here.rules, path)
        return found

    def _path_of(self, to: str) -> str:
        try:
            text = names.parse(to).text
        except NameFormatError:
            return to
        return self._paths.get(text, text)

    def _rights_of(self, actor: Actor) -> CallRights:
        return self._rights_by_actor.get(actor, self._rights)

    def _act(self) -> None:
        for actor in tuple(self._busy):
            self._act_for(actor)

    def _due_ns(self, now_ns: int) -> int | None:
        waits: list[int] = []
        for actor in tuple(self._busy):
            wait_ns = actor.wait_ns(now_ns)
            if wait_ns is None:
                self._busy.discard(actor)  # until its next message
            else:
                waits.append(wait_ns)
        return min(waits, default=None)


def device(cls: type, declared: Declaration, path: str, aliases: Sequence[str] = (), **fields: Any) -> Device:
    """One device of a class, at a path of its own; ``fields``: what its instance is made with."""
    return msgspec.structs.replace(declared, path=path, aliases=tuple(aliases)), functools.partial(cls, **fields)
