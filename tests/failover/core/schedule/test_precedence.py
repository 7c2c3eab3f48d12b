"""Which programs resume before others."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from failover.core.schedule.precedence import awaited

names = st.sampled_from("abcdef")
graphs = st.dictionaries(names, st.lists(names, max_size=3), max_size=6)


def test_predecessors_are_awaited_also_by_way_of_others() -> None:
    after = {"plan": ["map"], "map": ["odometry"]}
    assert awaited("map", after, {"odometry", "map", "plan"}) == {"odometry"}
    assert awaited("plan", after, {"odometry", "plan"}) == {"odometry"}
    assert awaited("plan", after, {"plan", "other"}) == frozenset()
    assert awaited("odometry", after, {"odometry", "map"}) == frozenset()


@given(graphs, st.sets(names))
def test_all_of_them_come_to_run(after: dict[str, list[str]], resuming: set[str]) -> None:
    waiting = set(resuming)
    while waiting:
        free = {one for one in waiting if not awaited(one, after, waiting)}
        assert free, f"{waiting} wait for one another"
        waiting -= free


@given(st.permutations("abcde"), st.sets(names))
def test_where_there_is_no_circle_each_predecessor_comes_first(order: list[str], resuming: set[str]) -> None:
    after = {later: [earlier] for earlier, later in itertools.pairwise(order)}
    for place, one in enumerate(order):
        assert awaited(one, after, resuming) == resuming & set(order[:place])
