"""A host's process: the sockets and names of a driver, and behind them the versions of one program."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import msgspec

from failover.core.naming.records import Record
from failover.core.programs import states
from failover.core.programs.states import State
from failover.drivers.actor import Actor
from failover.drivers.declare import DRIVER, Declaration
from failover.drivers.here import Here, refuse_second
from failover.drivers.here import here as drivers_here
from failover.drivers.keeping import Keeping
from failover.drivers.server import Serving
from failover.errors import FailoverError
from failover.kept_state.api import RESTARTED, Resumed
from failover.programs.carried import Carried, kept_in, open_carried, unpack
from failover.programs.host import HostActor, declared
from failover.programs.running import Running
from failover.programs.sources import Place, before, end_trial, source_of_directory, source_of_store, version_of
from failover.programs.store import Kept


class Hosting(Serving):
    """A host with open sockets; a context manager as `Serving`."""

    def __init__(self, place: Place, version: str = "", here: Here | None = None) -> None:
        """
        Args:
            version: of the store, to begin with; "": the active one, else the newest staged one.

        Raises:
            ProgramError: it cannot be started; nothing was changed.
            DriverError: another process is the driver of its path.
        """
        place.store.open()
        with contextlib.ExitStack() as stack:
            self._carrying = open_carried(place)
            if self._carrying is not None:
                stack.callback(self._carrying.close)
                if self._carrying.came_from is not None and self._carrying.instance.shelf:
                    unpack(self._carrying.instance, place)
                    version = ""  # the one that was active where it ran last
            if place.directory is None and not place.beside:
                shelf = place.store.shelf(place.name)
                refuse_second(here or drivers_here(), shelf.path)  # before anything of a living host is changed
                end_trial(place)
            source = source_of_directory(place.directory) if place.directory is not None else source_of_store(place, version)
            self._source = source
            first = Running(source, lambda: self.wake())
            stack.callback(first.end)
            first.load()
            path = f"{first.hello.path}@{source.manifest.version}" if place.beside else ""
            declaration = declared(first.hello, path)
            self._host = place, first
            super().__init__(type(place.name, (), {DRIVER: declaration}), here)
            stack.pop_all()

    def _begin(self, cls: type, declaration: Declaration, stack: contextlib.ExitStack) -> Keeping | None:
        """What the agent keeps, if there is one."""
        if self._carrying is not None:
            stack.callback(self._carrying.close)
        return self._carrying

    def _made(self, cls: type, declaration: Declaration, who: str) -> tuple[Any, Actor]:
        place, first = self._host
        kept, switched = self._kept(place, declaration.path)
        try:
            first.begin(kept.state if kept is not None else None, self._resumed(kept))
        except FailoverError:
            if switched is None or switched.version != first.source.manifest.version:
                raise
            first.begin(switched.state, self._resumed(switched))
            place.store.log(place.name, "it goes on with its state at the switch; what came after is lost")
        actor = HostActor(place, first, declaration, who, kept, self._carrying)
        actor.wake, actor.renew = self.wake, self._renew
        self.actor = actor
        self._began(place, first)
        return None, actor

    def _kept(self, place: Place, path: str) -> tuple[Kept | None, Kept | None]:
        """State and mailbox as they were last, and those at the last switch."""
        if self._carrying is None:
            return place.store.kept(path), place.store.kept(before(path))
        carried: Carried = self._carrying.instance
        return kept_in(carried.newest), kept_in(carried.switched)

    def _resumed(self, kept: Kept | None) -> Resumed:
        """Where the first version's state comes from."""
        if self._carrying is not None and self._carrying.came_from is not None:
            return self._carrying.came_from
        if kept is None:
            return Resumed(self.here.robot, 0, 0, RESTARTED, 0.0)
        return Resumed(self.here.robot, 0, kept.number, RESTARTED, max(time.time() - kept.at_s, 0.0))

    def _began(self, place: Place, first: Running) -> None:
        version = first.source.manifest.version
        if place.directory is None and not place.beside:
            with place.store.locked():
                shelf = place.store.shelf(place.name)
                one = version_of(shelf, version)
                if one.state is not State.ACTIVE:
                    shelf = states.succeed(shelf, states.warm(one), "started")
                    shelf = states.put(shelf, states.commit(version_of(shelf, version), "started by a person"))
                    place.store.put(shelf)
        told = "; ".join((*first.hello.enforced, *first.hello.not_enforced))
        place.store.log(place.name, f"{version} runs as pid {first.pid}; {told}")

    def _renew(self, declaration: Declaration) -> None:
        self.service.replace(self.record_of(declaration))

    def record_of(self, declaration: Declaration) -> Record:
        """With the version that is active."""
        record = super().record_of(declaration)
        found = self.actor.version if hasattr(self, "actor") else self._source.manifest.version
        return msgspec.structs.replace(record, versions=(found,) if found else ())

    def confinement_told(self) -> list[str]:
        """For the person who started it: what the program cannot do, and what keeps it from nothing."""
        hello = self._host[1].hello
        kept = [f"kept: {', '.join(hello.kept) or 'nothing'}"]
        return [
            *kept,
            f"enforced: {', '.join(hello.enforced) or 'nothing'}",
            f"not enforced: {'; '.join(hello.not_enforced) or 'nothing'}",
        ]

    def __exit__(self, *what: object) -> None:
        self.actor.close()
        super().__exit__(*what)
