"""Merging tables of names has one outcome, whatever the order; pages bring a table anywhere, in any order, with losses."""

from __future__ import annotations

import random
from functools import reduce

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.core.naming.tables import Entry, Page, Table, newer, page_of, patched

paths = st.sampled_from(["a/1", "a/2", "a/3"])
entries = st.builds(Entry, paths, st.integers(1, 4), st.sampled_from([b"", b"x", b"y"]))
some = st.builds(
    lambda boot, serial, found: Table("o", boot, serial, "", {one.path: one for one in found}),
    st.integers(1, 2),
    st.integers(0, 3),
    st.lists(entries, max_size=3),
)


@given(some, some, some)
def test_merging_is_associative_commutative_and_idempotent_even_of_tables_of_liars(
    one: Table, other: Table, third: Table
) -> None:
    assert newer(one, one) == one
    assert newer(one, other) == newer(other, one)
    assert newer(newer(one, other), third) == newer(one, newer(other, third))
    assert newer(None, one) == newer(one, None) == one


Deeds = list[tuple[str, str, bytes]]
deeds: st.SearchStrategy[Deeds] = st.lists(
    st.tuples(st.sampled_from(["put", "remove", "again"]), paths, st.sampled_from([b"x", b"y", b"z" * 40])),
    min_size=1,
    max_size=12,
)


def history(acts: Deeds) -> list[Table]:
    """Every state of an origin that acts so."""
    found = [Table("o", 1)]
    for act, path, body in acts:
        now = found[-1]
        if act == "again":
            lives = [one for one in now.entries.values() if one.body]
            now = Table(
                "o", now.boot + 1, len(lives), "", {one.path: Entry(one.path, n, one.body) for n, one in enumerate(lives, 1)}
            )
        else:
            entry = Entry(path, now.serial + 1, body if act == "put" else b"")
            now = Table("o", now.boot, now.serial + 1, "", {**now.entries, path: entry})
        found.append(now)
    return found


@settings(max_examples=150, deadline=None)
@given(deeds, st.integers(0, 1 << 32), st.sampled_from([1, 100, 10_000]))
def test_pages_from_anyone_at_any_time_lead_to_the_newest_table_and_never_back(acts: Deeds, seed: int, room: int) -> None:
    rolled = random.Random(seed)
    states = history(acts)
    holders: list[Table | None] = [None, None, None]
    pages: list[Page] = []
    for _ in range(60):
        to = rolled.randrange(3)
        has = holders[to]
        source = rolled.choice([*states, *(one for one in holders if one is not None)])
        since = has.serial if has is not None and has.boot == source.boot else 0
        pages.append(page_of(source, since, room))
        take(holders, rolled.randrange(3), rolled.choice(pages))  # late, twice, at another one, or never
    for to in range(3):
        for _ in range(60):
            has, newest = holders[to], states[-1]
            if has is not None and has.version == newest.version:
                break
            take(holders, to, page_of(newest, has.serial if has is not None and has.boot == newest.boot else 0, room))
        assert holders[to] == states[-1]


def take(holders: list[Table | None], to: int, page: Page) -> None:
    old = holders[to]
    new = newer(old, patched(old, page))
    assert old is None or (new is not None and new.version >= old.version)
    holders[to] = new


def patched_gap(table: Table | None, page: Page) -> Table | None:
    """Takes a page that does not follow."""
    old = table if table is not None and table.boot == page.boot else Table(page.origin, page.boot)
    if page.upto <= old.serial:
        return None
    return Table(page.origin, page.boot, page.upto, page.address, {**old.entries, **{one.path: one for one in page.entries}})


def newer_of_any_life(one: Table | None, other: Table | None) -> Table | None:
    """The serial counts, and not in which life."""
    if one is None or other is None:
        return one or other
    return one if one.serial >= other.serial else other


@pytest.mark.parametrize(("name", "wrong"), [("patched", patched_gap), ("newer", newer_of_any_life)])
def test_a_mistake_in_taking_pages_is_seen(name: str, wrong: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), name, wrong)
    with pytest.raises(AssertionError):
        search()


def search() -> None:
    """The property, over drawn histories."""
    for seed in range(60):
        rolled = random.Random(seed)
        kinds = ["put", "put", "remove", "again"]
        acts = [(rolled.choice(kinds), rolled.choice(["a/1", "a/2", "a/3"]), rolled.choice([b"x", b"y"])) for _ in range(8)]
        test_pages_from_anyone_at_any_time_lead_to_the_newest_table_and_never_back.hypothesis.inner_test(acts, seed, 1)  # type: ignore[attr-defined]


def test_merging_is_the_fold_of_all_that_was_heard() -> None:
    states = history([("put", "a/1", b"x"), ("again", "a/1", b""), ("put", "a/2", b"y")])
    assert reduce(newer, random.Random(1).sample(states, len(states))) == states[-1]
