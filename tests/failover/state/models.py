"""Classes as programs write them, one of each kind."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, NamedTuple, NotRequired, TypedDict, TypeVar

import msgspec
import numpy as np

Item = TypeVar("Item")


class Mode(enum.Enum):
    IDLE = 1
    DRIVE = 2
    HALT = 2.5


class Level(enum.IntEnum):
    LOW = 1
    HIGH = 2


class Word(str, enum.Enum):  # noqa: UP042 - as programs before 3.11 write it
    YES = "y"
    NO = "n"


class Faults(enum.Flag):
    HEAT = enum.auto()
    LOAD = enum.auto()
    LINK = enum.auto()


class Bits(enum.IntFlag):
    A = 1
    B = 4


@dataclass
class Pose:
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0


@dataclass(frozen=True)
class Cell:
    row: int
    column: int


@dataclass(slots=True)
class Slotted:
    pose: Pose
    seen: set[Cell] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class FrozenSlotted:
    cell: Cell
    tags: tuple[str, ...] = ()


@dataclass
class Derived:
    """Its constructor would refuse to run again."""

    side: float
    area: float = field(init=False)

    def __post_init__(self) -> None:
        if hasattr(self, "area"):
            raise AssertionError("a constructor ran")
        self.area = self.side**2

    @cached_property
    def root(self) -> float:
        return self.side**0.5


@dataclass
class Box(Generic[Item]):
    item: Item
    items: list[Item] = field(default_factory=list)


@dataclass
class Node:
    name: str
    next: Node | None = None
    children: list[Node] = field(default_factory=list)


class Reading(NamedTuple):
    when: float
    values: tuple[int, ...] = ()


class Settings(TypedDict):
    rate: float
    label: NotRequired[str]


class Track(msgspec.Struct):
    id: int
    points: list[tuple[float, float]] = []


class FrozenTrack(msgspec.Struct, frozen=True, array_like=True, tag="other", rename="camel"):
    id_number: int
    label: str | None = None


class CheckedTrack(msgspec.Struct):
    id: int
    double: int = 0

    def __post_init__(self) -> None:
        self.double = self.id * 2


@dataclass
class Mission:
    """A bit of everything."""

    pose: Pose = field(default_factory=Pose)
    mode: Mode = Mode.IDLE
    faults: Faults = Faults.HEAT
    plan: list[Pose | Cell] = field(default_factory=list)
    tiles: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    route: Sequence[int] = ()
    tracks: dict[str, Track] = field(default_factory=dict)
    current: Pose | None = None
