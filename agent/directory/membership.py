"""Groups of groups: followed step by step, because a server tells direct groups only (OpenLDAP's memberOf)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from agent.errors import DirectoryError

DEPTH_MAX: Final = 8
"""Groups within groups."""

GROUPS_MAX: Final = 20_000
"""Of one user; more are refused and not cut, for a rule that denies may be about one of those left out."""

ASKED_AT_ONCE: Final = 64
"""Names in one search."""


def groups_of(direct: Mapping[str, str], holding: Callable[[Sequence[str]], Mapping[str, str]]) -> frozenset[str]:
    """The names of all groups: the direct ones, and those that hold them, to `DEPTH_MAX`.

    Args:
        direct: DN → name of the groups that hold the user.
        holding: DNs of groups → DN → name of the groups that hold one of them.

    Raises:
        DirectoryError: there are too many.
    """
    names, seen, fringe = set(direct.values()), {dn.lower() for dn in direct}, list(direct)
    for _ in range(DEPTH_MAX - 1):
        found: dict[str, str] = {}
        for at in range(0, len(fringe), ASKED_AT_ONCE):
            found |= holding(fringe[at : at + ASKED_AT_ONCE])
        fringe = [dn for dn in found if dn.lower() not in seen]
        seen |= {dn.lower() for dn in fringe}
        names |= set(found.values())
        if len(seen) > GROUPS_MAX:
            raise DirectoryError(
                f"the directory tells more than {GROUPS_MAX} groups of one user; the agent gives no right by a part of them"
            )
        if not fringe:
            break
    return frozenset(names)
