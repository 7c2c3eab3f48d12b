"""Declarations of items and of the whole board."""

from __future__ import annotations

from typing import Any

import pytest

from failover.core.board.items import BLOCK_SIZE_MAX, ITEMS_MAX, Board, Item, bank_stride
from failover.errors import ItemError


def test_an_item_knows_its_type_and_its_size() -> None:
    assert Item("ball", {"x": "f4", "seen": "u8"}).size == 16
    assert Item("goal", size=64).as_words()["type"] == "bytes[64]"
    assert Item("plan", "msgpack", size=512) == Item("plan", "msgpack[512]")


@pytest.mark.parametrize(
    ("keys", "key", "said"),
    [
        ({"name": "a b", "size": 4}, "name", "cannot name an item"),
        ({"name": "a/b", "size": 4}, "name", "cannot name an item"),
        ({"name": "", "size": 4}, "name", "cannot name an item"),
        ({"name": "ä" * 32, "size": 4}, "name", "cannot name an item"),
        ({"name": "a"}, "type", "needs a size"),
        ({"name": "a", "type": "json"}, "type", "json needs a size"),
        ({"name": "a", "type": "f4", "size": 8}, "size", "contradicts the type: f4 has 4 bytes"),
        ({"name": "a", "size": 65537}, "size", "not from 1 to 65536"),
        ({"name": "a", "size": -1}, "size", "not from 1 to 65536"),
        ({"name": "a", "size": 4097}, "size", "at most 4096 bytes, this one 4097; say shared = false"),
        ({"name": "a", "type": "f8[600]"}, "type", "at most 4096 bytes"),
        ({"name": 4}, "name", "it is no text"),
        ({"name": "a", "size": "4"}, "size", "size '4' is no int"),
        ({"name": "a", "size": 4, "period": 1.5}, "period", "period 1.5 is no int"),
        ({"name": "a", "size": 4, "banks": True}, "banks", "banks True is no int"),
        ({"name": "a", "size": 4, "bound_ms": "x"}, "bound_ms", "bound_ms 'x' is no float"),
        ({"name": "a", "size": 4, "urgent": 1}, "urgent", "urgent 1 is no bool"),
        ({"name": "a", "size": 4, "shared": 1}, "shared", "no list"),
        ({"name": "a", "size": 4, "shared": None}, "shared", "no list"),
        ({"name": "a", "size": 4, "writer": 3}, "writer", "writer 3 is no str"),
        ({"name": "a", "size": 4, "period": 0}, "period", "period 0 is not from 1"),
        ({"name": "a", "size": 4, "period": 3, "phase": 3}, "phase", "below the period, 3"),
        ({"name": "a", "size": 4, "banks": 1}, "banks", "from 2 to 8"),
        ({"name": "a", "size": 4, "bound_ms": float("nan")}, "bound_ms", "bound_ms nan"),
        ({"name": "a", "size": 4, "bound_ms": -1}, "bound_ms", "bound_ms -1"),
        ({"name": "a", "size": 4, "robots": ("a/b",)}, "robots", "cannot name a robot"),
        ({"name": "a", "size": 4, "robots": "robot1"}, "robots", "no list"),
        ({"name": "a", "size": 4, "writer": "mapper"}, "writer", "cannot name a component"),
        ({"name": "a", "size": 4, "user": 3}, "user", "user 3 is no str"),
        ({"name": "a", "size": 4, "user": "1001"}, "user", "user '1001' is a number: name the user"),
        *[
            ({"name": "a", "size": 4, "user": user}, "user", "cannot be the name")
            for user in ("a b", "a/b", "a:b", "a\n", "u" * 65)
        ],
    ],
)
def test_a_mistaken_item_names_its_key(keys: dict[str, Any], key: str, said: str) -> None:
    with pytest.raises(ItemError) as caught:
        Item(**keys)
    assert said in str(caught.value)
    assert caught.value.key == key


def test_robots_are_named_by_patterns_and_may_share_what_others_keep() -> None:
    item = Item("coach", size=4, robots=("base", "robot*"), shared=("base",))
    assert [item.is_at(robot) for robot in ("base", "robot12", "rob")] == [True, True, False]
    assert [item.is_shared_by(robot) for robot in ("base", "robot12", "rob")] == [True, False, False]
    board = Board((Item("a", size=4), item, Item("c", size=70000 // 2, shared=False)))
    assert list(board.shared_by("base")) == [0, 1]
    assert list(board.private_of("robot1")) == [1, 2]
    assert board.number_of("c") == 2
    assert board.number_of("d") is None


def test_a_board_has_limits() -> None:
    with pytest.raises(ItemError, match="two items are called 'a'"):
        Board((Item("a", size=4), Item("a", size=8)))
    with pytest.raises(ItemError, match="1025 items are over the limit of 1024"):
        Board(tuple(Item(f"i{number}", size=4) for number in range(ITEMS_MAX + 1)))
    with pytest.raises(ItemError, match="401 items of 1 users are for one user each; 400 items of 64 users are possible"):
        Board(tuple(Item(f"i{number}", size=4, user="mapper") for number in range(401)))
    with pytest.raises(ItemError, match="65 items of 65 users are for one user each"):
        Board(tuple(Item(f"i{number}", size=4, user=f"u{number}") for number in range(65)))
    many = BLOCK_SIZE_MAX // (8 * bank_stride(65536)) + 1
    with pytest.raises(ItemError, match="over the limit of 16777216 for a block"):
        Board(tuple(Item(f"i{number}", size=65536, shared=False, banks=8) for number in range(many)))


CHANGES: list[dict[str, Any]] = [
    {"name": "b"},
    {"type": "{x:f4,y:f8}"},
    {"shared": False},
    {"shared": ("a",)},
    {"period": 2},
    {"robots": ("a",)},
    {"bound_ms": 4},
    {"banks": 3},
    {"writer": "/lab/a"},
    {"transmit": False},
    {"urgent": True},
    {"user": "mapper"},
]


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_of_an_item_changes_the_boards_digest(change: dict[str, Any]) -> None:
    said: dict[str, Any] = {"name": "a", "type": {"x": "f4", "y": "f4"}}
    assert Board((Item(**said),)).digest == Board((Item(**(said | {"type": "{x:f4, y:f4}", "bound_ms": 0.0})),)).digest
    assert Board((Item(**said),)).digest != Board((Item(**(said | change)),)).digest


def test_an_item_that_names_no_user_has_the_digest_that_older_robots_give_it() -> None:
    assert f"{Board((Item('a', size=4), Item('b', 'f8', writer='/lab/a'))).digest:016x}" == "4600590114ceffb1"
    assert list(Board((Item("a", size=4), Item("b", size=4, user="u", robots=("r1",)))).owned) == [1]


def test_the_order_of_items_is_part_of_the_digest_and_no_board_has_none() -> None:
    one, two = Item("a", size=4), Item("b", size=4)
    assert Board((one, two)).digest != Board((two, one)).digest
    assert Board().digest == 0


def test_the_digest_of_a_type_stays_as_it_was_published() -> None:
    """C programs are compiled with it: another value is another version of the board."""
    assert f"{Item('ball', {'x': 'f4', 'v': 'f4[3]', 'text': 'char[16]'}).type_digest:016x}" == "2aea77a2ab802479"
