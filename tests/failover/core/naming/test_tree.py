"""Three kinds of names lead to one record; conflicts are shown, and every process prefers the same claim."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from failover.core.naming import names, records, tree
from failover.core.naming.names import Kind, Name
from failover.core.naming.records import Record
from failover.core.naming.scan import SECOND, Scan
from failover.core.naming.tree import Claims, Reach, Tree
from failover.core.wire.names import weight
from failover.errors import NameAmbiguousError, NameFormatError, NameUnknownError

PWM = "University/Lab/Robotino/Engines/3/PWM"


def tree_of(*records: tuple[str, Record], reach: dict[str, Reach] | None = None, claims: Claims = Claims()) -> Tree:  # noqa: B008
    scans: dict[str, Scan] = {}
    for origin, record in records:
        scans.setdefault(origin, Scan(origin, 1, 0)).put(record, 0)
    heard = {origin: (reach or {}).get(origin, Reach.LIVE) for origin in scans}
    return Tree([one.own for one in scans.values()], heard, claims)


ENGINE = Record(
    PWM, addresses=("ipc:///run/engine", "tcp://192.168.0.7:5555", "tcp://[fe80::1]:5555"), aliases=("engine", "left engine")
)


@pytest.mark.parametrize(
    "name",
    [
        *(PWM, f"/{PWM}", PWM.replace("/", " → "), "University→Lab→Robotino→Engines→3→PWM", PWM.replace("P", "\uff30", 1)),
        *("engine", "left  engine", " engine "),
        *("192.168.0.7:5555", "tcp://192.168.0.7:5555", "[fe80::1]:5555", "[fe80:0::0:1]:5555"),
    ],
)
def test_every_kind_of_name_leads_to_the_one_record(name: str) -> None:
    assert tree_of(("robotino", ENGINE)).resolve(name).record == records.checked(ENGINE)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("a/../b", "step is empty"),
        ("a//b", "step is empty"),
        ("a/b/", "step is empty"),
        ("/", "step is empty"),
        ("a\0b", "cannot be seen"),
        ("a/b\n", "cannot be seen"),
        ("", "empty"),
        ("   ", "empty"),
        ("x" * 300, "longer than 200"),
        ("/".join("a" * 20), "20 steps, 16 are the most"),
        ("a/\ud800", "longer than 200"),
        ("1.2.3.400:5", "no address"),
        ("1.2.3.4:70000", "1 to 65535"),
        ("a b/c", "holds a blank"),
    ],
)
def test_what_is_no_name_is_refused_with_a_sentence(name: str, why: str) -> None:
    with pytest.raises(NameFormatError, match=why):
        names.parse(name)


@given(st.text(max_size=60))
@example("/0")
def test_any_text_is_a_name_in_normal_form_or_is_refused(text: str) -> None:
    try:
        name = names.parse(text)
    except NameFormatError:
        return
    again = names.parse(name.text)
    assert again.text == name.text
    assert again.kind is name.kind or (name.kind is Kind.PATH and "/" not in name.text), "a path of one step reads as text"


def test_an_alias_of_several_things_lists_them() -> None:
    found = tree_of(("r1", Record("L/r1/a", aliases=("engine",))), ("r2", Record("L/r2/a", aliases=("engine",))))
    with pytest.raises(NameAmbiguousError, match="names 2 things: L/r1/a, L/r2/a") as raised:
        found.resolve("engine")
    assert raised.value.paths == ("L/r1/a", "L/r2/a")
    reach = {"r1": Reach.UNREACHABLE}
    alone = tree_of(("r1", Record("L/r1/a", aliases=("engine",))), ("r2", Record("L/r2/a", aliases=("engine",))), reach=reach)
    assert alone.resolve("engine").robot == "r2"


def test_two_claims_of_one_path_are_shown_and_the_robot_of_lesser_weight_is_preferred() -> None:
    found = tree_of(("robot10", Record(PWM, owner="ten")), ("robot2", Record(PWM, owner="two")))
    assert [(place.origin, place.rivals) for place in found.claimants(PWM)] == [
        ("robot2", ("robot10",)),
        ("robot10", ("robot2",)),
    ]
    assert found.resolve(PWM).record.owner == "two"
    assert len(found.under("University")) == 2


def test_the_primary_of_the_higher_epoch_wins_a_conflict_and_what_is_heard_wins_before_that() -> None:
    both = (("robot2", Record(PWM, epoch=3)), ("robot10", Record(PWM, epoch=4)))
    assert tree_of(*both).resolve(PWM).origin == "robot10"
    assert tree_of(*both, reach={"robot10": Reach.UNREACHABLE}).resolve(PWM).origin == "robot2"


def test_a_robot_claims_nothing_in_the_subtree_of_another_one() -> None:
    claims = Claims(frozenset({"r1", "r2"}), {"r2": ("Shared/r1",)})
    one = Scan("r2", 1, 0, claims=claims)
    with pytest.raises(NameFormatError, match="Lab/r1/x, which is in the subtree of r1"):
        one.put(Record("Lab/r1/x"), 0)
    for path in ("Lab/r2/x", "Shared/r1/x", "Hall/Door"):
        one.put(Record(path), 0)
    found = tree_of(("r1", Record("Lab/r1/x")), ("r2", Record("Lab/r1/x", epoch=9)), claims=claims)
    assert found.resolve("Lab/r1/x").origin == "r1"
    assert [place.refused != "" for place in found.claimants("Lab/r1/x")] == [False, True]
    lonely = tree_of(("r2", Record("Lab/r1/x")), claims=claims)
    with pytest.raises(NameUnknownError, match="in the subtree of r1"):
        lonely.resolve("Lab/r1/x")


def test_names_are_listed_below_a_prefix_in_natural_order() -> None:
    found = tree_of(*(("r1", Record(f"L/r1/{number}")) for number in (10, 2, 1)), ("r1", Record("L/r10/1")))
    assert [place.record.path for place in found.under("/L/r1")] == ["L/r1/1", "L/r1/2", "L/r1/10"]
    assert len(found.under()) == len(found) == 4
    with pytest.raises(NameUnknownError, match="no process that was heard"):
        found.resolve("nothing")
    with pytest.raises(NameUnknownError, match="did you mean 'L/r1"):
        found.resolve("L/r1O/1")


def test_a_record_of_a_later_version_passes_on_whole() -> None:
    body = msgspec.msgpack.encode({"path": "L/x", "colour": "red"})
    record = records.unpack(body)
    assert record is not None and record.path == "L/x"
    assert records.unpack(b"\xc1") is None
    assert records.unpack(msgspec.msgpack.encode({"path": "a/../b"})) is None


def test_a_record_that_is_too_large_is_refused_and_the_old_one_stays() -> None:
    one = Scan("r1", 1, 0)
    one.put(Record("L/x", owner="u"), 0)
    with pytest.raises(NameFormatError, match="more than 4096 bytes"):
        one.put(Record("L/x", labels={"x": "y" * 5_000}), 0)
    with pytest.raises(NameFormatError, match="reads as address"):
        one.put(Record("L/x", aliases=("1.2.3.4:5",)), 0)
    assert one.tree(SECOND).resolve("L/x").record.owner == "u"


def test_a_path_of_one_step_is_a_name_too() -> None:
    assert tree_of(("r1", Record("gate"))).resolve("gate").record.path == "gate"
    assert names.parse("gate") == Name(Kind.TEXT, "gate")


def test_a_mistake_in_the_preference_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree, "_preference", lambda place: place.origin)
    with pytest.raises(AssertionError):
        test_two_claims_of_one_path_are_shown_and_the_robot_of_lesser_weight_is_preferred()
    monkeypatch.setattr(tree, "_preference", lambda place: (place.reach is not Reach.LIVE, weight(place.robot)))
    with pytest.raises(AssertionError):
        test_the_primary_of_the_higher_epoch_wins_a_conflict_and_what_is_heard_wins_before_that()
