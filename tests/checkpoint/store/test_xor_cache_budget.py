"""One bound for all pages that a robot remembers, shared by need: counted in bytes."""

from __future__ import annotations

from typing import Final

from checkpoint.store.xor_cache import HotPages, Sender
from checkpoint.store.xor_cache_budget import PageBudget, shares
from tests.checkpoint.pages.test_xor_delta import ROOM, busy

MB: Final = 1 << 20


def test_who_needs_little_has_it_and_the_others_share_what_is_left() -> None:
    assert shares(60, {"small": 10, "large": 100, "larger": 1_000}) == {"small": 10, "large": 25, "larger": 25}
    assert shares(60, {"one": 20, "other": 30}) == {"one": 20, "other": 30}
    assert shares(60, {}) == {}


def test_all_together_never_have_more_than_the_bound() -> None:
    budget = PageBudget(64 * MB)
    granted: dict[str, int] = {}
    for turn in range(6):
        for number in range(10):
            name = f"component {number}"
            granted[name] = budget.share(name, (number + 1) * 4 * MB if turn else 0, granted.get(name, 0))
            assert sum(granted.values()) <= 64 * MB
    assert granted["component 0"] == 4 * MB, "the small one has all that it needs"
    assert granted["component 9"] >= 6 * MB, "the large ones have equal shares"
    assert budget.held <= 64 * MB
    for number in range(9):
        budget.leave(f"component {number}")
    assert budget.share("component 9", 40 * MB, granted["component 9"]) == 64 * MB, "of those that left nothing is kept"


def test_a_cache_that_is_to_hold_less_keeps_what_was_told_last() -> None:
    whole = busy(6)
    sender = Sender()
    for one in whole:
        sender.told(one, ROOM)
        sender.acknowledge(one.position)
    page_size = whole[0].machine.page_size
    assert sender.held > 2 * page_size
    assert sender.wanted >= sender.held
    sender.limit(2 * page_size)
    assert sender.held == 2 * page_size
    sender.limit(0)
    assert sender.held == 0


def test_a_bound_of_nothing_remembers_nothing() -> None:
    pages = HotPages(4096, 0)
    assert pages.size == 0
    assert PageBudget(0).share("any", MB, 0) == 0
