"""The process of one version: ``python -m failover.programs.version_process FD``, started by a host and told by `channel`.

It confines itself, loads the program, and waits warm. With `Begin` it makes the driver with its state; each `Call` is one
message, and its answer goes with the state that it left.
"""

from __future__ import annotations

import importlib.util
import os
import socket
import sys
from typing import Any

import msgspec

from failover.core.messaging import envelope as envelopes
from failover.drivers.actor import Actor
from failover.drivers.declare import Declaration, declaration_of
from failover.errors import FailoverError, ProgramError
from failover.kept_state.component import kept_of, on_resume_of, schema_of
from failover.programs import confine
from failover.programs.channel import (
    Begin,
    Call,
    Channel,
    ChannelClosedError,
    Done,
    Failed,
    Hello,
    Pause,
    Ready,
    Start,
    State,
    Verb,
)
from failover.state import Encoded, Region, Schema

_MODULE = "failover_program"


class Loaded:
    """A program whose imports are done, and perhaps its driver."""

    def __init__(self, start: Start) -> None:
        """Raises whatever the program raises."""
        self.confined = confine.confine(start.confinement, start.directory)
        self._class = _loaded(self.confined.directory, start.file, start.name)
        self.declaration: Declaration = declaration_of(self._class)
        self._kept = kept_of(self._class)
        self._schema: Schema | None = None
        if self._kept:
            self._schema = schema_of(self._class, self.declaration, self.declaration.path)
        self._actor: Actor | None = None
        self._instance: Any = None
        self._last: State | None = None

    def hello(self) -> Hello:
        """What it is."""
        said = self.declaration
        verbs = {name: Verb(one.marked.role, one.marked.coalesce, one.marked.rate_hz) for name, one in said.verbs.items()}
        words = (tuple(self._kept), tuple(self.confined.enforced), tuple(self.confined.not_enforced))
        return Hello(said.path, said.aliases, said.rate_hz, verbs, said.schemas(), dict(said.labels), *words)

    def begin(self, order: Begin) -> Ready:
        """Make the driver; with a state that is kept, call its ``on_resume``.

        Raises whatever the program raises, and FitError: it cannot read the state.
        """
        values: dict[str, Any] = {}
        resumed = order.resumed
        notes: tuple[str, ...] = ()
        if self._schema is not None and order.state is not None:
            regions = tuple(Region(name, memoryview(content)) for name, content in order.state.regions)
            decoded = self._schema.decode(Encoded(order.state.data, regions))
            values, notes = decoded.value, decoded.notes
            resumed = msgspec.structs.replace(resumed, notes=(*resumed.notes, *notes)) if resumed is not None else None
        elif self._schema is not None:
            values = {name: one.first(None) for name, one in self._kept.items()}
        instance: Any = object.__new__(self._class)
        vars(instance).update(values)
        instance.__init__()
        if order.state is not None:
            vars(instance).update(values)
        self._instance, self._last = instance, None
        self._actor = Actor(instance, self.declaration, "program")
        if order.state is not None and (called := on_resume_of(instance, resumed)) is not None:
            called()
        return Ready(self._state(), notes)

    def call(self, order: Call) -> Done:
        """Carry out one message."""
        assert self._actor is not None, "the host begins first"
        answer = envelopes.encode_answer(self._actor.carried_out([envelopes.decode(order.message)]), "msgpack")
        before = self._last
        try:
            state = self._state()
        except FailoverError as error:
            return Done(answer, None, str(error))
        return Done(answer, state if state != before else None)

    def pause(self) -> Ready:
        """The driver lets its device go: ``on_retire``, if it has that."""
        state = self._state()
        retire = getattr(self._instance, "on_retire", None)
        self._actor = self._instance = None
        if callable(retire):
            retire()
        return Ready(state)

    def _state(self) -> State | None:
        if self._schema is None:
            return None
        encoded = self._schema.encode({name: getattr(self._instance, name) for name in self._kept})
        self._last = State(encoded.data, tuple((one.name, bytes(one.memory)) for one in encoded.regions))
        return self._last


def _loaded(directory: str, file: str, name: str) -> type:
    """The class of a program. Raises whatever the program raises."""
    sys.path.insert(0, directory)
    spec = importlib.util.spec_from_file_location(_MODULE, os.path.join(directory, file))
    assert spec is not None and spec.loader is not None, "a .py file"
    module = importlib.util.module_from_spec(spec)
    sys.modules[_MODULE] = module
    spec.loader.exec_module(module)
    found = getattr(module, name, None)
    if not isinstance(found, type):
        raise ProgramError(f"{file} has no class {name}, which the entry of its manifest names")
    return found


def _serve(channel: Channel) -> None:
    start = channel.receive()
    assert isinstance(start, Start), "a host starts first"
    try:
        loaded = Loaded(start)
    except BaseException as error:
        channel.send(Failed(_said("it cannot be loaded", error)))
        raise SystemExit(1) from error
    channel.send(loaded.hello())
    while True:
        order = channel.receive()
        try:
            if isinstance(order, Begin):
                channel.send(loaded.begin(order))
            elif isinstance(order, Call):
                channel.send(loaded.call(order))
            elif isinstance(order, Pause):
                channel.send(loaded.pause())
        except ChannelClosedError:
            raise
        except Exception as error:  # noqa: BLE001  a program may raise anything
            channel.send(Failed(_said("it failed", error)))


def _said(what: str, error: BaseException) -> str:
    return f"{what}: {error}" if isinstance(error, FailoverError) else f"{what}: {type(error).__name__}: {error}"


def main(words: list[str]) -> None:
    """Serve one host."""
    confine.die_with_parent()
    try:
        _serve(Channel(socket.socket(fileno=int(words[0]))))
    except ChannelClosedError:
        return


if __name__ == "__main__":
    main(sys.argv[1:])
