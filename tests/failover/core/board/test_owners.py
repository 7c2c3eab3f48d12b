"""The agent's table of items that one user alone may put: its text, and what may stand in which file."""

from __future__ import annotations

import pytest

from failover.core.board.item_types import ITEM_SIZE_MAX
from failover.core.board.items import NAME_SIZE_MAX, OWNED_MAX, USER_SIZE_MAX
from failover.core.board.owners import Owner, decode, encode, is_rightful
from failover.errors import BoardError

OWNERS = {"map": Owner(0, "mapper", 1000), "plan": Owner(3, "planner", None), "größe": Owner(4, "lab\\mapper", 1000)}


def test_the_table_comes_back_and_has_room_for_as_many_items_as_a_board_may_have() -> None:
    assert decode(encode(OWNERS)) == OWNERS
    assert encode(OWNERS).startswith(b"map 0 1000 mapper\nplan 3 - planner\n")
    assert decode(b"") == {}
    most = {f"{number:0{NAME_SIZE_MAX}}": Owner(number, "u" * USER_SIZE_MAX, 2**32 - 2) for number in range(OWNED_MAX)}
    assert len(encode(most)) <= ITEM_SIZE_MAX


@pytest.mark.parametrize("content", [b"\xff", b"map 0 1000\n", b"map x 1000 mapper\n", b"map 0 y mapper\n", b"a 0 1 u more\n"])
def test_a_damaged_table_is_refused(content: bytes) -> None:
    with pytest.raises(BoardError, match="damaged: the agent's table of items of one user"):
        decode(content)


@pytest.mark.parametrize(
    ("name", "uid", "may"),
    [
        ("ball", None, True),  # nobody's: in the files of the group alone
        ("ball", 1000, False),
        ("map", 1000, True),
        ("map", 1001, False),
        ("map", None, False),
        ("plan", None, False),  # its user is not on this robot: nowhere
        ("plan", 1000, False),
    ],
)
def test_an_item_stands_in_its_users_file_and_in_no_other(name: str, uid: int | None, may: bool) -> None:
    assert is_rightful(OWNERS, name, uid) is may
