"""Items that one user alone may put: which of this robot's items, and whose. The agent tells it in a table; this is its text.

A member of the board's group may write anything into `own`, and a user into his own file, also the names and numbers of items
of others. So no reader goes by what such a file says of itself: the table is in the file that the agent alone writes.
"""

from __future__ import annotations

from msgspec import Struct

from failover.errors import BoardError


class Owner(Struct, frozen=True):
    """Whose an item is.

    Attributes:
        number: of the item.
        user: name of the one user who may put it.
        uid: that user's on this robot; None: no program of this robot can put it. The agent's status says why, or the
            item's robots leave this one out.
    """

    number: int
    user: str
    uid: int | None


Owners = dict[str, Owner]
"""By the items' names."""


def encode(owners: Owners) -> bytes:
    """One line an item: name, number, uid or "-", user; BOARD.md, *Files of one user*."""
    lines = [f"{name} {one.number} {'-' if one.uid is None else one.uid} {one.user}\n" for name, one in owners.items()]
    return "".join(lines).encode()


def decode(content: bytes) -> Owners:
    """The table.

    Raises:
        BoardError: it is none.
    """
    try:
        rows = [line.split(" ") for line in content.decode().splitlines()]
        return {name: Owner(int(number), user, None if uid == "-" else int(uid)) for name, number, uid, user in rows}
    except ValueError as error:
        raise BoardError(f"damaged: the agent's table of items of one user: {error}") from None


def is_rightful(owners: Owners, name: str, uid: int | None) -> bool:
    """Whether an item may stand in a file.

    Args:
        uid: of the one user who may write the file; None: the whole group may.
    """
    owner = owners.get(name)
    return uid is None if owner is None else owner.uid is not None and owner.uid == uid
