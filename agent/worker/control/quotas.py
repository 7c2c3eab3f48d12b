"""Limits per user on connections of the control socket, bytes of requests, and components: no user shuts another out.

Root and the agent's own user have places of their own, which no other user can take. All other users share a number of places and
of bytes; each gets a part of them.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from typing import Final

from agent.errors import RefusedError
from agent.system.permissions import ROOT
from failover.core.types import ENDED, ComponentView, State

TRUSTED_CONNECTIONS_MAX: Final = 128
"""Of root, and of the agent's own user: a script that forgets to close them is told."""

USER_CONNECTIONS_MAX: Final = 32
"""Of any other user: each `failover run` that waits, `logs -f` and `status --watch` holds one."""

OTHERS_CONNECTIONS_MAX: Final = 128
"""Of all those users together: the agent keeps its descriptors for the components that it protects."""

USER_BYTES_MAX: Final = 8 << 20
"""Of requests of one user that have arrived and are not answered, without the first 32 KB of each: a small one is heard."""

NAMES_FOR_EACH: Final = 2
"""Names of components that a user may have used, those that were released included, for each component that he may have."""

OTHERS_BYTES_MAX: Final = 32 << 20
"""The same of all users together except root and the agent's own."""


class Admission:
    """How much of the control socket each user holds. Lives in one asyncio loop."""

    def __init__(self, page_uid: int = -1) -> None:
        """
        Args:
            page_uid: the user of the operators' page: it holds connections for many users, and gets as many as root.
        """
        self._page_uid = page_uid
        self._connections: Counter[int] = Counter()
        self._bytes: Counter[int] = Counter()

    def enter(self, uid: int) -> None:
        """Count one connection of a user.

        Raises:
            RefusedError: the user, or all of them together, hold too many; then it is not counted.
        """
        has_own_places = is_trusted(uid) or uid == self._page_uid
        most = TRUSTED_CONNECTIONS_MAX if has_own_places else USER_CONNECTIONS_MAX
        if self._connections[uid] >= most:
            raise RefusedError(
                f"uid {uid} holds {self._connections[uid]} connections to the agent, the most for one user; end some of its "
                "failover commands that wait, or close connections that are not used"
            )
        others = _others(self._connections) - self._connections[self._page_uid]
        if not has_own_places and others >= OTHERS_CONNECTIONS_MAX:
            raise RefusedError(
                f"users other than root hold {OTHERS_CONNECTIONS_MAX} connections to the agent, the most for all of them; end "
                "some of their failover commands that wait, or ask as root"
            )
        self._connections[uid] += 1

    def leave(self, uid: int) -> None:
        """A connection that was counted has ended."""
        _take(self._connections, uid, 1)

    def hold(self, uid: int, size: int) -> None:
        """Count bytes of a request that have arrived.

        Raises:
            RefusedError: the user's requests, or those of all users, take too much; then they are not counted.
        """
        if self._bytes[uid] + size > USER_BYTES_MAX:
            raise RefusedError(
                f"requests of uid {uid} that wait for their end or their answer take {self._bytes[uid]} bytes of "
                f"{USER_BYTES_MAX}, the most for one user; wait for their answers, or end some"
            )
        if not is_trusted(uid) and _others(self._bytes) + size > OTHERS_BYTES_MAX:
            raise RefusedError(
                f"requests of users other than root take {_others(self._bytes)} bytes of {OTHERS_BYTES_MAX}, the most for all of "
                "them; try again when some are answered, or ask as root"
            )
        self._bytes[uid] += size

    def let_go(self, uid: int, size: int) -> None:
        """The request is answered, or has come to nothing."""
        _take(self._bytes, uid, size)


def check_components(uid: int, name: str, known: Iterable[ComponentView], most: int) -> None:
    """Let a user begin a component of this name.

    The team follows a number of names (`failover.core.types.COMPONENTS_MAX`), and a name that was used and released keeps its
    place: its epochs must not be forgotten. So names count as well, `NAMES_FOR_EACH` for each component that a user may have.

    Args:
        known: all components that this robot knows.
        most: that a user may have, whether they run or have ended.

    Raises:
        RefusedError: the user has as many, or has used as many names.
    """
    if is_trusted(uid):
        return
    theirs = [one for one in known if one.owner == uid and one.name != name]
    held = [one for one in theirs if one.state not in (State.RELEASED, State.ABSENT)]
    if len(held) >= most:
        over = sum(one.state in ENDED for one in held)
        raise RefusedError(
            f"uid {uid} has {len(held)} components, the most for one user (components_per_user); {over} of them have ended: "
            "failover release NAME forgets one"
        )
    if len(theirs) >= NAMES_FOR_EACH * most:
        released = min(one.name for one in theirs if one not in held)
        raise RefusedError(
            f"uid {uid} has used {len(theirs)} names for components, the most for one user; take one of them again that was "
            f"released, {released} for one (--name)"
        )


def is_trusted(uid: int) -> bool:
    """Whether this user has places that no other can take."""
    return uid in (ROOT, os.geteuid())


def _others(held: Counter[int]) -> int:
    return sum(count for uid, count in held.items() if not is_trusted(uid))


def _take(held: Counter[int], uid: int, count: int) -> None:
    held[uid] -= count
    if not held[uid]:
        del held[uid]
