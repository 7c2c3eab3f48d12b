"""Who has reserved what, for how long, and what robots tell each other of it."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.reservations import OF_USER_MAX, RESERVATIONS_MAX, Reservation, Table, Told, covering, reserved_path, telling
from failover.core.rights.paths import steps_of
from failover.core.types import MS
from failover.errors import RightsError

ANNA, BEN = 1001, 1002
NOW_NS = 10**18
MAPPER = "/lab/r1/mapper"


def wanted(path: str = MAPPER, uid: int = ANNA, begun_ns: int = NOW_NS, span_ms: int = 600_000, id_: str = "") -> Reservation:
    name = id_ or f"{uid}{path}{begun_ns}"
    return Reservation(name, path, uid, {ANNA: "anna", BEN: "ben"}.get(uid, str(uid)), "why", begun_ns, begun_ns + span_ms * MS)


@pytest.mark.parametrize(
    ("reserved", "path", "hinders"),
    [
        (MAPPER, MAPPER, True),
        ("/lab/r1", MAPPER, True),
        ("lab", MAPPER, True),
        ("/lab/r1/map", MAPPER, False),
        (MAPPER, "/lab/r1", False),
        ("/lab/r2", MAPPER, False),
    ],
)
def test_other_users_may_give_no_order_about_what_is_below_the_path(reserved: str, path: str, hinders: bool) -> None:
    table = Table()
    table.begin(wanted(reserved), NOW_NS)
    assert (table.hinders(BEN, path, NOW_NS) is not None) is hinders
    assert table.hinders(ANNA, path, NOW_NS) is None


def test_a_reservation_ends_by_itself() -> None:
    table = Table([wanted(span_ms=1_000)])
    assert table.hinders(BEN, MAPPER, NOW_NS + 999 * MS) is not None
    assert table.hinders(BEN, MAPPER, NOW_NS + 1_000 * MS) is None and table.all(NOW_NS + 1_000 * MS) == ()


@pytest.mark.parametrize("path", ["/lab", MAPPER, f"{MAPPER}/part"])
def test_no_user_reserves_what_is_above_or_below_another_users(path: str) -> None:
    mine = wanted()
    table = Table([mine])
    assert table.why_not(wanted(path, BEN), NOW_NS) == mine
    assert table.why_not(wanted(path, ANNA), NOW_NS) == ""
    assert table.why_not(wanted("/lab/r2", BEN), NOW_NS) == ""


def test_a_user_who_reserves_again_has_one_reservation_with_the_new_span() -> None:
    table = Table()
    table.begin(wanted(span_ms=60_000), NOW_NS)
    changed = table.begin(wanted(begun_ns=NOW_NS + MS, span_ms=1_000), NOW_NS + MS)
    assert [one.over for one in changed] == [True, False]
    assert table.hinders(BEN, MAPPER, NOW_NS + 2_000 * MS) is None


def test_no_user_reserves_without_end_and_no_table_grows_without_end() -> None:
    table = Table([wanted(f"/lab/r1/c{number}") for number in range(OF_USER_MAX)])
    assert "8 reservations already" in str(table.why_not(wanted("/lab/r1/more"), NOW_NS))
    assert table.why_not(wanted("/lab/r1/c3"), NOW_NS) == "", "again the same"
    full = Table([wanted(f"/lab/x{number}", uid=number) for number in range(RESERVATIONS_MAX)])
    assert "64 reservations" in str(full.why_not(wanted(), NOW_NS))
    assert not full.hear(telling(wanted(), NOW_NS), NOW_NS)
    full.end(full.standing(NOW_NS)[5])
    assert full.hear(telling(wanted(), NOW_NS), NOW_NS) and len(full.all(NOW_NS)) == RESERVATIONS_MAX


def test_a_user_who_begins_and_ends_again_and_again_shuts_no_other_user_out() -> None:
    table = Table()
    for number in range(2 * RESERVATIONS_MAX):
        table.end(table.begin(wanted(begun_ns=NOW_NS + number), NOW_NS)[-1])
    assert len(table.all(NOW_NS)) == RESERVATIONS_MAX and table.why_not(wanted("/lab/r2", BEN), NOW_NS) == ""
    table.begin(wanted("/lab/r2", BEN), NOW_NS)
    assert table.hinders(ANNA, "/lab/r2", NOW_NS) is not None


def test_another_robot_learns_it_with_its_own_clock_and_learns_its_end() -> None:
    here, there, later_ns = Table(), Table(), 77 * MS
    (mine,) = here.begin(wanted(), NOW_NS)
    told = telling(mine, NOW_NS + 60_000 * MS)
    assert there.hear(told, later_ns) and not there.hear(told, later_ns)
    (theirs,) = there.standing(later_ns)
    assert (theirs.begun_ns, theirs.until_ns) == (later_ns - 60_000 * MS, later_ns + 540_000 * MS)
    assert there.hear(telling(here.end(mine), NOW_NS), later_ns) and there.standing(later_ns) == ()
    assert not there.hear(told, later_ns) and there.standing(later_ns) == (), "no robot that was away brings it back"
    away = Table()
    away.hear(telling(here.all(NOW_NS)[0], NOW_NS), NOW_NS)
    assert not away.hear(told, NOW_NS) and away.standing(NOW_NS) == ()


def test_a_path_that_is_none_is_not_taken() -> None:
    table = Table()
    assert not table.hear(telling(wanted("/lab/../x"), NOW_NS), NOW_NS) and table.hinders(BEN, MAPPER, NOW_NS) is None


@pytest.mark.parametrize("path", ["/demo/robot1/" + 60 * "\ufdfa", "/demo/robot1/a\uffebb"])
def test_a_path_that_is_none_or_another_one_in_its_normal_form_is_refused(path: str) -> None:
    assert steps_of(path), "as it is written it is one"
    with pytest.raises(RightsError, match="is no path"):
        reserved_path(path)


@pytest.mark.parametrize("path", ["/a" * 17, "/demo/" + 300 * "x"])
def test_what_is_no_path_in_an_older_file_is_left_out(path: str) -> None:
    table = Table([wanted(path), wanted()])
    assert [one.path for one in table.standing(NOW_NS)] == [MAPPER]


def test_of_two_that_robots_granted_that_did_not_hear_each_other_the_older_one_counts_until_it_is_over() -> None:
    older, newer = wanted(begun_ns=NOW_NS), wanted("/lab/r1", BEN, begun_ns=NOW_NS + 5 * MS)
    table = Table([newer, older])
    assert table.standing(NOW_NS + 9 * MS) == (older,)
    table.end(older)
    assert table.standing(NOW_NS + 9 * MS) == (newer,)


ACTS = st.tuples(st.sampled_from(["begin", "end", "tell", "wait"]), st.integers(0, 3), st.integers(1001, 1003))


@given(st.lists(ACTS, max_size=40))
def test_whatever_robots_tell_each_other_no_two_users_hold_a_path_and_all_agree_at_last(
    steps: list[tuple[str, int, int]],
) -> None:
    paths, tables, now_ns = ("/a", "/a/b", "/a/b/c", "/d"), (Table(), Table()), NOW_NS
    for number, (act, place, uid) in enumerate(steps):
        table = tables[number % 2]
        one = wanted(paths[place], uid, now_ns, 30_000, f"id{number}")
        if act == "begin" and table.why_not(one, now_ns) == "":
            table.begin(one, now_ns)
        elif act == "end" and (held := table.over_path(paths[place], now_ns)):
            table.end(held)
        elif act == "tell":
            tell(table, tables[1 - number % 2], now_ns)
        now_ns += 1_000 * MS * (20 if act == "wait" else 1)
        for each in tables:
            for path in paths:
                assert len({one.uid for one in each.standing(now_ns) if covering([one], path)}) <= 1
    tell(tables[0], tables[1], now_ns)
    tell(tables[1], tables[0], now_ns)
    assert [one.id for one in tables[0].standing(now_ns)] == [one.id for one in tables[1].standing(now_ns)]


def tell(speaker: Table, listener: Table, now_ns: int) -> None:
    for known in speaker.all(now_ns):
        listener.hear(telling(known, now_ns), now_ns)


@pytest.mark.parametrize("field", [{"left_ms": 10**9}, {"stood_ms": -1}, {"why": "a\nb"}, {"path": ""}, {"id": ""}, {"uid": "x"}])
def test_what_another_robot_tells_is_checked(field: dict[str, object]) -> None:
    told = msgspec.to_builtins(telling(wanted(), NOW_NS))
    assert msgspec.convert(told, Told)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(told | field, Told)
