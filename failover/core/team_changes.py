"""Changes of the team while it works: one member at a time, each taken by a majority before the next one is begun.

A robot that wants to change the team asks all members that it reaches for a *grant*. A member gives one to one robot at a time,
and only if both have made the same number of changes. With the grants of a majority of the present team the robot writes the
next change, and tells it to all; a member that was away takes it when it is back.

What follows: two teams that are in use at a time differ by one member, so any majority of one has a member in common with any
majority of the other. That member's vote and that member's echo count once. Two different changes with one number cannot both be
granted by a majority. Source: Ongaro, Consensus: Bridging Theory and Practice, section 4.2 (changes by one server).

Two robots that are alone (rule = pair) promise less: there is no majority without both. So one of them may take the other one,
which is lost, out by itself.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from msgspec import Struct

from failover.core.types import MS

GRANT_NS: Final = 60_000 * MS
"""A grant holds for so long; no clock of a robot that was given one can be so far off that half of it seems longer."""

USE_NS: Final = GRANT_NS // 2
"""So long after its question the robot may still write the change."""


class Grants(Struct):
    """The grant that one member has given last.

    Attributes:
        proposer: to whom; until_ns: of this member's clock.
    """

    proposer: str = ""
    until_ns: int = 0

    def ask(self, have: int, wanted: int, proposer: str, now_ns: int) -> str:
        """Give the grant for one change more than ``wanted``, or say why not.

        Args:
            have: changes that this member knows of; ``wanted``: that the proposer knows of.

        Returns:
            "" if it is given; else a sentence's end.
        """
        if wanted != have:
            return f"it has change {have} of the team, and {proposer} has {wanted}: try again when both have the same"
        if self.proposer not in ("", proposer) and now_ns < self.until_ns:
            return f"{self.proposer} changes the team now: try again in {(self.until_ns - now_ns) / (1_000 * MS):.0f} s"
        self.proposer, self.until_ns = proposer, now_ns + GRANT_NS
        return ""

    def done(self) -> None:
        """The change has come, or the proposer has given it up."""
        self.proposer, self.until_ns = "", 0


def step(before: Mapping[str, object], after: Mapping[str, object]) -> str:
    """The one member by which two teams differ; "" if they differ by none, or by more."""
    changed = [name for name in {*before, *after} if before.get(name) != after.get(name)]
    return changed[0] if len(changed) == 1 else ""


def missing(team: Collection[str], granted: Collection[str], removed: str = "") -> int:
    """How many more members must grant a change; 0: it is granted.

    Args:
        team: all members before the change; ``granted``: those that grant it, the proposer among them.
        removed: the member that is to leave: its word does not count.
    """
    if len(team) == 2 and removed:
        return 0  # by rule = pair there is no majority to ask: the other one is to leave
    given = sum(member in granted for member in team if member != removed)
    return max(len(team) // 2 + 1 - given, 0)


def seats(members: Mapping[str, int], order: Collection[str]) -> dict[str, int]:
    """A seat for each member: those that have one keep it, and the others get the lowest ones left, in that order.

    Args:
        members: name → seat, -1 for none yet.
    """
    taken = {seat for seat in members.values() if seat >= 0}
    free = (seat for seat in range(len(members) + len(taken)) if seat not in taken)
    return {name: members[name] if members[name] >= 0 else next(free) for name in order}
