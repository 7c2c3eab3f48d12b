"""Writes the sample of a kept state: ``python -m tests.samples.state`` (only when the wire format changes).

Python 3.12 with numpy 1.26 wrote the sample in this folder.
"""

from __future__ import annotations

import collections
import datetime as dt
import pathlib
import uuid
import zoneinfo
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from failover.state import Encoded, Region, Schema
from tests.failover.state.models import Bits, Cell, Faults, FrozenTrack, Mode, Node, Pose, Reading, Track

SAMPLE = Path(__file__).parent / "version-1.state"
"""msgpack: [data, {name of a region: its bytes}]."""


@dataclass
class Sampled:
    """One field of every kind; what it holds is written down here, so that the sample can be compared with it."""

    numbers: list[float | int | complex] = field(
        default_factory=lambda: [1, -0.0, float("inf"), 1 << 200, 2 + 1j, np.float32(0.1)]
    )
    texts: tuple[str, ...] = ("", "grün", "bad\udcff")
    content: bytes = b"\0\xff" * 4000
    buffer: bytearray = field(default_factory=lambda: bytearray(b"abc"))
    moments: list[Any] = field(
        default_factory=lambda: [
            dt.datetime(2026, 10, 25, 2, 30, tzinfo=zoneinfo.ZoneInfo("Europe/Berlin"), fold=1),
            dt.datetime(2026, 1, 2, 3, 4, 5, 6, tzinfo=dt.timezone(dt.timedelta(hours=1), "CET")),
            dt.date(2026, 2, 28),
            dt.time(23, 59, tzinfo=dt.UTC),
            dt.timedelta(-1, 2, 3),
        ]
    )
    exact: list[Any] = field(default_factory=lambda: [Decimal("1.10"), Fraction(1, 3), uuid.UUID(int=7), range(0, 9, 2)])
    path: pathlib.Path = pathlib.Path("/a/b")
    mode: Mode = Mode.HALT
    faults: Faults = Faults.HEAT | Faults.LINK
    bits: Bits = Bits.A | Bits.B
    cells: dict[Cell, set[str]] = field(default_factory=lambda: {Cell(1, 2): {"a"}, Cell(2, 1): set()})
    plan: list[Pose | Cell | None] = field(default_factory=lambda: [Pose(1.0, 2.0, 3.0), Cell(3, 4), None])
    ring: Node | None = None
    reading: Reading = field(default_factory=lambda: Reading(0.5, (1, 2)))
    tracks: dict[str, Track | FrozenTrack] = field(
        default_factory=lambda: {"a": Track(1, [(0.5, 1.5)]), "b": FrozenTrack(2, "x")}
    )
    recent: collections.deque[int] = field(default_factory=lambda: collections.deque([1, 2], 5))
    settings: dict[str, Any] = field(default_factory=lambda: {"gain": 0.5, "odd": {1: (None, True), (2, "b"): frozenset({3})}})
    grid: np.ndarray = field(default_factory=lambda: np.arange(1200, dtype=">f4").reshape(30, 40))
    small: np.ndarray = field(default_factory=lambda: np.asfortranarray(np.arange(6, dtype="<i2").reshape(2, 3)))
    table: np.ndarray = field(
        default_factory=lambda: np.array([(1, "ab", [[1, 2], [3, 4]])], [("id", "<u4"), ("name", "<U3"), ("cov", "<f8", (2, 2))])
    )
    stamps: np.ndarray = field(default_factory=lambda: np.array(["2026-11-21T08:00:00", "NaT"], "<M8[ms]"))
    flags: np.ndarray = field(default_factory=lambda: np.array([True, False]))


def sampled() -> Sampled:
    """The value, with an object at two places and a cycle."""
    value = Sampled()
    value.ring = Node("a", Node("b"))
    assert value.ring.next is not None
    value.ring.next.next = value.ring
    value.plan.append(value.plan[0])
    return value


def schema() -> Schema:
    """The declaration that the sample was written by."""
    return Schema.of(Sampled, name="sample")


def packed(encoded: Encoded) -> bytes:
    """The content of a sample file."""
    return msgspec.msgpack.encode([encoded.data, {region.name: bytes(region.memory) for region in encoded.regions}])


def unpacked(content: bytes) -> Encoded:
    """The state in a sample file."""
    data, regions = msgspec.msgpack.decode(content)
    return Encoded(data, tuple(Region(name, memoryview(held)) for name, held in regions.items()))


if __name__ == "__main__":
    SAMPLE.write_bytes(packed(schema().encode(sampled())))
