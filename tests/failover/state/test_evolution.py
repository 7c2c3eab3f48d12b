"""A state outlives its declaration: fields are added, removed and renamed; those that no longer fit are refused by name."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, NamedTuple, TypedDict

import msgspec
import numpy as np
import pytest

from failover.errors import FitError, SchemaError
from failover.state import Encoded, Field, Formerly, Labelled, Pickled, Schema
from tests.failover.state import models
from tests.failover.state.models import Cell, Mode, Pose, Track
from tests.failover.state.sameness import carried, moved, same


@dataclass
class Before:
    theta: float = 0.5
    count: int = 3
    gone: str = "old"


@dataclass
class After:
    count: int
    heading: Annotated[float, Formerly("angle", "theta")] = 0.0
    added: list[int] = field(default_factory=lambda: [7])


class AfterStruct(msgspec.Struct):
    count: int
    heading: Annotated[float, Formerly("theta")] = 0.0


class AfterTuple(NamedTuple):
    count: int
    theta: float
    added: str = "x"


class AfterDict(TypedDict):
    count: int
    theta: float


@dataclass
class Demanding:
    count: int
    needed: str


@dataclass
class Wrong:
    count: int
    theta: str


def test_fields_are_added_dropped_and_renamed() -> None:
    value, notes = moved(Before, Before(), After)
    assert value == After(3, 0.5, [7])
    assert notes == ("kept.gone: stored but not declared any more: dropped", "kept.added: not stored: takes its default")


@pytest.mark.parametrize(
    ("new", "value"),
    [(AfterStruct, AfterStruct(3, 0.5)), (AfterTuple, AfterTuple(3, 0.5, "x")), (AfterDict, {"theta": 0.5, "count": 3})],
)
def test_a_record_moves_to_another_library(new: Any, value: Any) -> None:
    assert moved(Before, Before(), new)[0] == value


def test_many_records_give_one_note() -> None:
    _, notes = moved(list[Before], [Before()] * 3 + [Before() for _ in range(100)], list[After])
    assert notes == ("kept[0].gone: stored but not declared any more: dropped", "kept[0].added: not stored: takes its default")


@pytest.mark.parametrize(
    ("new", "sentence"),
    [
        (
            Demanding,
            r"^kept\.needed: not stored, and declared without a default; give it one, or",
        ),
        (Wrong, r"^kept\.theta: stored as float 0\.5, wanted str; give the schema a higher version and a migration"),
        (
            Cell,
            r"^kept: stored as a record \(theta, count, gone\), wanted Cell \(none of its fields is declared",
        ),
        (list[int], r"^kept: stored as a record \(theta, count, gone\), wanted list\[int\]"),
        (Any, r"^kept: stored as a record \(theta, count, gone\), wanted Any"),
    ],
)
def test_what_no_longer_fits_is_refused_by_name(new: Any, sentence: str) -> None:
    with pytest.raises(FitError, match=sentence):
        moved(Before, Before(), new)


def test_a_refusal_says_where_it_was() -> None:
    with pytest.raises(FitError) as caught:
        moved(dict[str, Any], {"a": [1, {"heading": "north"}]}, dict[str, list[int | dict[str, float]]])
    assert caught.value.place == "kept['a'][1]['heading']"
    assert str(caught.value).startswith("kept['a'][1]['heading']: stored as str 'north', wanted float;")


@pytest.mark.parametrize(
    ("old", "stored", "new", "value"),
    [
        (int, 3, float, 3),
        (int, 3, int | str, 3),
        (int | str, "a", str, "a"),
        (Pose, Pose(1, 2, 3), Pose | None, Pose(1, 2, 3)),
        (Pose, Pose(1, 2, 3), Pose | int, Pose(1, 2, 3)),
        (list[int], [1, 2], tuple[int, ...], (1, 2)),
        (tuple[int, int], (1, 2), list[int], [1, 2]),
        (set[int], {1}, frozenset[int], frozenset({1})),
        (dict[str, float], {"x": 1.0, "y": 2.0}, Pose, Pose(1.0, 2.0, 0.0)),
        (Pose, Pose(1.0, 2.0, 3.0), dict[str, float], {"x": 1.0, "y": 2.0, "heading": 3.0}),
        (list[int], [1], Any, [1]),
        (Any, [1], list[int], [1]),
        (dict[str, int], {"a": 1}, Mapping[str, int], {"a": 1}),
        (np.ndarray, np.zeros(3), np.ndarray | None, np.zeros(3)),
    ],
)
def test_a_declaration_may_widen(old: Any, stored: Any, new: Any, value: Any) -> None:
    assert same(moved(old, stored, new)[0], value)


def test_what_could_now_be_either_of_two_is_refused() -> None:
    with pytest.raises(FitError, match=r"kept: stored as a record \(x, y, heading\), wanted Pose \| Track"):
        moved(Pose, Pose(), Pose | Track)


def test_an_enum_may_number_its_members_anew_but_not_lose_one() -> None:
    renumbered = enum.Enum("Mode", {"DRIVE": 7, "HALT": 8})
    assert moved(Mode, Mode.DRIVE, renumbered)[0] is renumbered["DRIVE"]
    with pytest.raises(FitError, match=r"kept: stored as str 'IDLE', wanted Mode .its members are DRIVE, HALT"):
        moved(Mode, Mode.IDLE, renumbered)


def test_a_fixed_array_refuses_another_form() -> None:
    old = Schema.of_fields({"grid": Field(np.ndarray, shape=(8, 8), dtype="u1")}, name="mapper")
    new = Schema.of_fields({"grid": Field(np.ndarray, shape=(9, 8), dtype="u1")}, name="mapper")
    with pytest.raises(
        FitError, match=r"mapper\.grid: stored as an array, wanted array of uint8 \(9, 8\) \(it is of uint8 \(8, 8\)\)"
    ):
        new.decode(old.encode(old.fresh()))


def test_a_state_may_get_another_name() -> None:
    plan = [Pose()]
    stored = Schema.of(list[list[Pose]], name="old").encode([plan, plan])
    found = Schema.of(list[list[Pose]], name="quite.another").decode(stored).value
    assert found[0] is found[1]


# --- Migrations ------------------------------------------------------------------------------------------------------


@dataclass
class Old:
    degrees: float
    mode: Mode
    image: np.ndarray
    targets: list[Pose | Cell]
    shared: list[int]
    again: list[int]
    faults: models.Faults = models.Faults.LINK
    at: tuple[int, int] = (1, 2)


@dataclass
class New:
    radians: float
    mode: Mode
    image: np.ndarray
    targets: list[Pose | Cell]
    shared: list[int]
    again: list[int]
    faults: models.Faults
    at: tuple[int, int]


def _to_radians(state: dict[str, Any]) -> dict[str, Any]:
    state["radians"] = round(np.deg2rad(state.pop("degrees")).item(), 3)
    state["image"] = state["image"] * 2
    state["targets"] = [Labelled("Cell", {"row": 9, "column": 9}), *state["targets"]]
    return state


def _old() -> Encoded:
    shared = [1]
    old = Old(180.0, Mode.HALT, np.ones((30, 30)), [Pose(1.0), Cell(1, 2)], shared, shared)
    return carried(Schema.of(Old, name="kept").encode(old))


def test_a_migration_makes_the_next_version_of_plain_values() -> None:
    schema = Schema.of(New, name="kept", version=2, migrations={1: _to_radians})
    decoded = schema.decode(_old())
    value = decoded.value
    assert (value.radians, value.mode, value.targets) == (3.142, Mode.HALT, [Cell(9, 9), Pose(1.0), Cell(1, 2)])
    assert value.image.sum() == 1800 and value.shared is value.again and value.faults is models.Faults.LINK and value.at == (1, 2)
    assert decoded.version == 1 and decoded.notes == ("kept: migrated from version 1 to 2",)


def test_migrations_are_done_one_after_the_other() -> None:
    def append(letter: str) -> Any:
        return lambda state: [*state, letter]

    old = Schema.of(list[str], name="kept", version=2).encode(["a"])
    new = Schema.of(list[str], name="kept", version=5, migrations={1: append("x"), 2: append("b"), 4: append("c")})
    assert new.decode(old).value == ["a", "b", "c"]
    assert new.decode(new.encode(["z"])).value == ["z"]


@pytest.mark.parametrize(
    ("migration", "sentence"),
    [
        (lambda state: state["nothing"], r"kept: its migration from version 1 failed: KeyError: 'nothing'; mend it"),
        (lambda state: {"radians": object()}, r"kept: cannot store the result of its migration: cannot keep kept\['radians'\]"),
        (lambda state: {**state, "radians": "x"}, r"kept\['radians'\]: stored as str 'x', wanted float"),
    ],
)
def test_a_migration_that_fails_is_refused_and_loses_nothing(migration: Any, sentence: str) -> None:
    stored = _old()
    with pytest.raises(FitError, match=sentence):
        Schema.of(New, name="kept", version=2, migrations={1: migration}).decode(stored)
    assert Schema.of(Old, name="kept").decode(stored).value.degrees == 180.0


def test_a_newer_state_is_refused() -> None:
    with pytest.raises(FitError, match="kept: stored by version 3 of its declaration, this program has 2; run the newer program"):
        Schema.of(int, name="kept", version=2).decode(Schema.of(int, name="kept", version=3).encode(1))


def test_a_migration_leaves_pickled_values_unread() -> None:
    def migration(state: dict[str, Any]) -> dict[str, Any]:
        return {**state, "count": 2}

    old_class = make_dataclass("Keeps", [("odd", Annotated[Any, Pickled()])])
    new_class = make_dataclass("Keeps", [("odd", Annotated[Any, Pickled()]), ("count", int)])
    stored = Schema.of(old_class, name="kept").encode(old_class({"a": slice(1, 2)}))
    found = Schema.of(new_class, name="kept", version=2, migrations={1: migration}).decode(stored).value
    assert (found.odd, found.count) == ({"a": slice(1, 2)}, 2)


@pytest.mark.parametrize(("version", "migrations"), [(0, {}), (1, {1: str}), (3, {0: str}), (1 << 31, {})])
def test_versions_that_cannot_be_are_refused_at_declaration(version: int, migrations: Any) -> None:
    with pytest.raises(SchemaError, match=r"kept: (version|migrations)"):
        Schema.of(int, name="kept", version=version, migrations=migrations)


def test_a_fingerprint_tells_declarations_apart() -> None:
    declarations = [Pose, Before, After, list[Pose], Pose | None, Mode, dict[str, int], dict[int, str]]
    assert len({Schema.of(declared).fingerprint for declared in declarations}) == len(declarations)
    assert Schema.of(Pose, version=2).fingerprint != Schema.of(Pose).fingerprint
