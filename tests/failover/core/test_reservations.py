"""Who has reserved what, for how long, and what robots tell each other of it."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.reservations import (
    OF_USER_MAX,
    RESERVATIONS_MAX,
    Reservation,
    Table,
    Told,
    covering,
    id_of,
    reserved_path,
    telling,
)
from failover.core.rights.paths import steps_of
from failover.core.types import MS
from failover.errors import RightsError

ANNA, BEN = 1001, 1002
NOW_NS = 10**18
MAPPER = "/lab/r1/mapper"


def wanted(path: str = MAPPER, uid: int = ANNA, begun_ns: int = NOW_NS, span_ms: int = 600_000) -> Reservation:
    user = {ANNA: "anna", BEN: "ben"}.get(uid, str(uid))
    return Reservation(id_of(begun_ns, f"{uid}{path}"), path, uid, user, "why", begun_ns + span_ms * MS)


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
    assert full.why_not(wanted(), NOW_NS) == "" and full.hear(telling(wanted(), NOW_NS), NOW_NS)
    assert len(full.all(NOW_NS)) == RESERVATIONS_MAX + 1, "one of them is over"


def test_root_reserves_also_where_users_have_filled_the_table_and_only_so_much() -> None:
    table = Table([wanted(f"/lab/x{number}", uid=number) for number in range(1, RESERVATIONS_MAX + 1)], frozenset({0}))
    assert "64 reservations" in str(table.why_not(wanted(), NOW_NS)), "says so, and begins nothing"
    for number in range(OF_USER_MAX):
        assert table.why_not(wanted(f"/lab/y{number}", 0), NOW_NS) == ""
        table.begin(wanted(f"/lab/y{number}", 0), NOW_NS)
        assert table.hinders(BEN, f"/lab/y{number}", NOW_NS) is not None
    assert "root" not in str(table.why_not(wanted("/lab/y", 0), NOW_NS)) and table.why_not(wanted("/lab/y", 0), NOW_NS) != ""


def test_one_that_another_robot_hides_takes_a_place_and_a_full_table_says_so() -> None:
    hidden = wanted("/lab/x1", BEN, NOW_NS + MS)
    table = Table([wanted(f"/lab/x{number}", uid=number) for number in range(1, RESERVATIONS_MAX)] + [hidden])
    assert hidden not in table.standing(NOW_NS)
    assert "64 reservations" in str(table.why_not(wanted(), NOW_NS))


def test_a_user_who_ends_again_and_again_brings_no_other_users_back() -> None:
    table = Table()
    bens = wanted("/lab/r2", BEN)
    table.end(table.begin(bens, NOW_NS)[-1])
    for number in range(2 * RESERVATIONS_MAX):
        table.end(table.begin(wanted(begun_ns=NOW_NS + number), NOW_NS)[-1])
    assert not table.hear(telling(bens, NOW_NS), NOW_NS) and table.hinders(ANNA, "/lab/r2", NOW_NS) is None


def test_a_telling_that_comes_late_makes_none_longer() -> None:
    here, one = Table(), wanted(span_ms=1_000)
    told = telling(one, NOW_NS)
    assert here.hear(told, NOW_NS) and not here.hear(told, NOW_NS + 900 * MS)
    assert here.standing(NOW_NS + 1_000 * MS) == ()
    late = Table()
    late.hear(told, NOW_NS + 900 * MS)
    late.hear(telling(one, NOW_NS + 950 * MS), NOW_NS + 950 * MS)
    assert late.standing(NOW_NS + 1_000 * MS) == (), "a later telling mends it"


def test_of_a_users_two_the_deepest_is_the_one_that_is_meant() -> None:
    above, own = wanted("/lab"), wanted(begun_ns=NOW_NS + MS)
    assert covering([above, own], MAPPER) == own and covering([above, own], "/lab/r2") == above


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
    assert theirs.until_ns == later_ns + 540_000 * MS
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


def test_of_two_that_robots_granted_that_did_not_hear_each_other_the_older_one_counts_at_both_until_it_is_over() -> None:
    older, newer = wanted(begun_ns=NOW_NS), wanted("/lab/r1", BEN, begun_ns=NOW_NS + 5 * MS)
    table = Table([newer, older])
    assert table.standing(NOW_NS + 9 * MS) == (older,)
    table.end(older)
    assert table.standing(NOW_NS + 9 * MS) == (newer,)


ACTS = st.tuples(st.sampled_from(["begin", "end", "tell", "wait"]), st.integers(0, 3), st.integers(1001, 1003))


@given(st.lists(ACTS, max_size=40), st.integers(0, 12))
def test_whatever_robots_tell_each_other_late_no_two_users_hold_a_path_and_all_agree_at_last(
    steps: list[tuple[str, int, int]], latency: int
) -> None:
    paths, tables, now_ns = ("/a", "/a/b", "/a/b/c", "/d"), (Table(), Table()), NOW_NS
    under_way: list[tuple[int, Table, Told]] = []  # the step at which it arrives, where, what
    for number, (act, place, uid) in enumerate(steps):
        for arrives, listener, told in under_way:
            if arrives == number:
                listener.hear(told, now_ns)
        table = tables[number % 2]
        one = wanted(paths[place], uid, now_ns, 30_000)
        if act == "begin" and table.why_not(one, now_ns) == "":
            table.begin(one, now_ns)
        elif act == "end" and (held := table.over_path(paths[place], now_ns)):
            table.end(held)
        elif act == "tell":
            under_way += ((number + 1 + latency, tables[1 - number % 2], telling(each, now_ns)) for each in table.all(now_ns))
        now_ns += 1_000 * MS * (20 if act == "wait" else 1)
        for each in tables:
            for path in paths:
                assert len({one.uid for one in each.standing(now_ns) if covering([one], path)}) <= 1
    for _, listener, told in under_way:
        listener.hear(told, now_ns)
    tell(tables[0], tables[1], now_ns)
    tell(tables[1], tables[0], now_ns)
    tell(tables[0], tables[1], now_ns)
    assert [one.id for one in tables[0].standing(now_ns)] == [one.id for one in tables[1].standing(now_ns)]


def tell(speaker: Table, listener: Table, now_ns: int) -> None:
    for known in speaker.all(now_ns):
        listener.hear(telling(known, now_ns), now_ns)


@pytest.mark.parametrize("field", [{"left_ms": 10**9}, {"left_ms": -1}, {"why": "a\nb"}, {"path": ""}, {"id": ""}, {"uid": "x"}])
def test_what_another_robot_tells_is_checked(field: dict[str, object]) -> None:
    told = msgspec.to_builtins(telling(wanted(), NOW_NS))
    assert msgspec.convert(told, Told)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(told | field, Told)
