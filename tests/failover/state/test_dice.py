"""States damaged at random: refused or read, and reading them runs nothing."""

from __future__ import annotations

import os
import pickle
import random
import sys
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
import numpy as np
import pytest

from failover.errors import StateError
from failover.state import Encoded, Pickled, Schema
from tests.failover.state import models
from tests.failover.state.models import Cell, Mission, Mode, Pose, Track
from tests.failover.state.sameness import carried, forged

ROUNDS = int(os.environ.get("FAILOVER_TEST_FLIPS", "1500"))
"""Damaged states per seed and kind of damage."""


def mission() -> Mission:
    """Something of every kind, shared objects and regions included."""
    pose = Pose(1.0, 2.0, 3.0)
    return Mission(
        pose,
        Mode.DRIVE,
        models.Faults.HEAT,
        [pose, Cell(1, 2)],
        {(0, 0): np.zeros((30, 30)), (0, 1): np.zeros(2, [("a", "<i4"), ("b", "<f8", (2,))])},
        {"gain": 0.5, "set": {1, 2}, "big": 1 << 70, "bytes": b"abc", "mixed": {1: (None, 2j)}, "odd": "\udcff"},
        (1, 2, 3),
        {"a": Track(1, [(0.5, 0.5)])},
        pose,
    )


SCHEMA = Schema.of(Mission, name="kept")
MIGRATING = Schema.of(Mission, name="kept", version=2, migrations={1: lambda state: state})


def survives(encoded: Encoded) -> bool:
    """Whether a state is read; refusing it is as good. What was read can be stored again."""
    accepted = False
    for schema in (SCHEMA, MIGRATING):
        try:
            value = schema.decode(encoded).value
        except StateError:
            continue
        schema.encode(value)
        accepted = True
    return accepted


@pytest.mark.parametrize("seed", range(3))
def test_flipped_and_cut_bytes_are_refused_or_read(seed: int) -> None:
    dice = random.Random(seed)
    whole = carried(SCHEMA.encode(mission()))
    outcomes = set()
    for _ in range(ROUNDS):
        damaged = bytearray(whole.data)
        for _ in range(dice.choice([1, 1, 2, 8])):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        if not dice.randrange(4):
            start = dice.randrange(len(damaged))
            del damaged[start : start + dice.randrange(1, 20)]
        outcomes.add(survives(Encoded(bytes(damaged), whole.regions)))
    assert outcomes == {True, False}


NASTY: list[Any] = [
    *(None, True, -1, 0, 1 << 63, 0.5, float("nan"), "", "kept.tiles[#0]", "$array", "x" * 300, b"", bytes(100), [], {}, [[]]),
    *({"": 1}, {"$same": ""}, {"$same": ".pose"}, {"$same": ".plan"}, {"$array": []}, {"$as": ["Pose", {"x": 0.0}]}, {1: 2}),
    *(
        {"$dict": [[1, 2]]},
        {"$map": {}},
        {"$tuple": []},
        {"$set": [[]]},
        {"$int": b""},
        {"$bytes": [1, "kept"]},
        {"$pickled": b""},
    ),
    *({"$deque": [None, []]}, {"x": 1.0}, msgspec.msgpack.Ext(1, b""), {"$scalar": ["<f8", bytes(8)]}, {"$complex": [0.0, 0.0]}),
    {"$frozenset": [{"$tuple": []}]},
]


def places(wire: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every node of a wire value."""
    yield path
    if isinstance(wire, dict):
        for key, inner in wire.items():
            yield from places(inner, (*path, key))
    elif isinstance(wire, list):
        for index, inner in enumerate(wire):
            yield from places(inner, (*path, index))


def replaced(wire: Any, path: tuple[Any, ...], new: Any) -> Any:
    """A copy with another value at a path."""
    if not path:
        return new
    if isinstance(wire, dict):
        return {key: replaced(inner, path[1:], new) if key == path[0] else inner for key, inner in wire.items()}
    return [replaced(inner, path[1:], new) if index == path[0] else inner for index, inner in enumerate(wire)]


def found_at(wire: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        wire = wire[step]
    return wire


@pytest.mark.parametrize("seed", range(3))
def test_values_put_in_the_place_of_others_are_refused_or_read(seed: int) -> None:
    dice = random.Random(seed)
    whole = carried(SCHEMA.encode(mission()))
    wire = msgspec.msgpack.decode(whole.data)[3]
    outcomes = set()
    for _ in range(ROUNDS):
        damaged = wire
        for _ in range(dice.choice([1, 1, 1, 2, 3])):
            spots = list(places(damaged))
            new = dice.choice(NASTY) if dice.randrange(3) else found_at(damaged, dice.choice(spots))
            damaged = replaced(damaged, dice.choice(spots), new)
        outcomes.add(survives(forged(damaged, *whole.regions)))
    assert outcomes == {True, False}


RUNNING = frozenset(
    {"exec", "compile", "import", "open", "os.exec", "os.system", "subprocess.Popen", "pickle.find_class", "socket.connect"}
)
"""Audit events of code that runs, is loaded or reaches out (PEP 578)."""


class Watch:
    """Audit events of a while; the hook itself cannot be taken out again."""

    def __init__(self) -> None:
        self.seen: list[str] = []
        self._watching = False
        sys.addaudithook(self._look)

    def _look(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self._watching and event in RUNNING:
            self.seen.append(event)

    def __enter__(self) -> Watch:
        self._watching = True
        return self

    def __exit__(self, *_: object) -> None:
        self._watching = False


def test_reading_a_hostile_state_runs_and_opens_nothing() -> None:
    whole = carried(SCHEMA.encode(mission()))
    wire = msgspec.msgpack.decode(whole.data)[3]
    nasty = ({"$pickled": pickle.dumps(os.system)}, "os.system", {"$as": ["os.system", "true"]})
    states = [forged(replaced(wire, path, new), *whole.regions) for path in places(wire) for new in nasty]
    with Watch() as watch:
        accepted = sum(map(survives, states))
    assert watch.seen == []
    assert 0 < accepted < len(states)


def test_the_watch_sees_what_pickle_loads() -> None:
    """A check that cannot fail is worse than none."""
    state = forged({"$pickled": pickle.dumps(os.system)})
    with Watch() as watch:
        Schema.of(Annotated[Any, Pickled()], name="kept").decode(state)
    assert "pickle.find_class" in watch.seen
