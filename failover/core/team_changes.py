"""Changes of the team while it works: one member at a time, each granted by every member that the team has.

A robot that wants to change the team asks all members for a *grant*. A member gives one to one robot at a time, and only if both
have made the same number of changes. With all grants the robot writes the next change, and tells it to all; a member that cannot
be reached in between takes it when it is back. Only the grant of a member that is to leave, and that no member sees alive, is
not needed.

What follows: no member is ever two changes behind, for the next change needs its grant, and it grants one only if it has all
earlier ones. So two teams that are in use at a time differ by one member, and any majority of one has a member in common with any
majority of the other. That member's vote and that member's echo count once. Two different changes with one number cannot both be
granted, for each robot that asks needs the other one's grant. Source: Ongaro, Consensus: Bridging Theory and Practice, section
4.2 (changes by one server); a majority of grants, as there, would let a member fall behind by two.

An election is older than the teams after the next one, and may have no voter in their majorities. So each grant tells which
elections that member knows. A change waits until so many members know the newest one that none of the majorities after it lacks
it (`unaware`): else those others could elect a second primary with the same epoch.

With rule = etcd a robot that no member hears may act by etcd's vote, if its own and etcd's are a majority (two of three votes).
Such a robot is not taken out without its grant (`acts_unheard`): the next change would make a majority that knows neither.

Two robots that are alone (rule = pair) promise less: where each takes the other one for dead, each may take the other one out.

A robot replaces its key by two changes: the first puts a new key beside the old one, the second takes the old one out. As no
member is two changes behind, any two members have a key of that robot in common. The robot uses the new one from the moment at
which all have granted the second change: they have the first one then. It is the only one that may change its keys.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final, Literal

from msgspec import Struct

from failover.core.types import ENDED, MS, PEERS_MAX, VoteRecord

GRANT_NS: Final = 60_000 * MS
"""A grant holds for so long; no clock of a robot that was given one can be so far off that half of it seems longer."""

SEATS: Final = PEERS_MAX + 1
"""A generation has room for so many (`failover.core.types`)."""

USE_NS: Final = GRANT_NS // 2
"""So long after its question the robot may still write the change."""


class Grants(Struct):
    """The grant that one member has given last.

    Attributes:
        proposer: to whom; until_ns: of this member's clock; ``members``: digest of the team that was granted.
    """

    proposer: str = ""
    until_ns: int = 0
    members: int = 0

    def ask(self, have: int, wanted: int, proposer: str, now_ns: int, members: int = 0) -> str:
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
        self.proposer, self.until_ns, self.members = proposer, now_ns + GRANT_NS, members
        return ""

    def covers(self, proposer: str, members: int) -> bool:
        """Whether that robot was given the grant for that very team last; it may tell of it late, after a power cut."""
        return (self.proposer, self.members) == (proposer, members)

    def done(self, proposer: str) -> None:
        """That robot has made its change, or has given it up. A grant to another one stays."""
        if proposer == self.proposer:
            self.proposer, self.until_ns, self.members = "", 0, 0


def step(before: Mapping[str, object], after: Mapping[str, object]) -> str:
    """The one member by which two teams differ; "" if they differ by none, or by more."""
    changed = [name for name in {*before, *after} if before.get(name) != after.get(name)]
    return changed[0] if len(changed) == 1 else ""


TWO_KEYS: Final = "two keys of {robot} count, the old one still: failover team rotate {robot} goes on"
"""Said as long as a robot's key is not replaced yet."""

Rotation = Literal["begin", "switch", "finish", "undo", "unfit"]
"""What is next where a robot's key is replaced. ``begin``: a new key beside the one there is. ``switch``: use the new one, and
take the old one out. ``finish``: take the old one out; the new one is in use. ``undo``: take the new one out; its secret half is
lost. ``unfit``: the robot has the secret half of none."""


def rotation(keys: tuple[str, str], in_use: str, prepared: str) -> Rotation:
    """How a rotation that was perhaps broken off goes on.

    Args:
        keys: of that robot, as the team has them: the old one, and "" or the new one.
        in_use: the public half of what it uses; ``prepared``: of what it has put aside to use next, "" for nothing.
    """
    new = keys[1]
    if not in_use or in_use not in keys:
        return "unfit"
    if not new:
        return "begin"
    if in_use == new:
        return "finish"
    return "switch" if prepared == new else "undo"


def is_step_of_keys(before: tuple[str, str], after: tuple[str, str]) -> bool:
    """Whether a member's keys change as one change may: a second one comes, or one of two goes. Then both have one in common."""
    if "" in before:
        return before[0] != "" and after[0] == before[0] and after[1] not in ("", before[0])
    return after in ((before[0], ""), (before[1], ""))


def missing(team: Collection[str], granted: Collection[str], removed: str = "", *, lives: bool = True) -> list[str]:
    """Which members must grant a change still; none: it is granted.

    Args:
        team: all members before the change; ``granted``: those that grant it, the proposer among them.
        removed: the member that is to leave; ``lives``: a member sees it alive.
    """
    return sorted(member for member in team if member not in granted and (lives or member != removed))


class Elections(Struct, frozen=True):
    """What a member tells of elections, with its grant.

    Attributes:
        epochs: component → newest epoch that this member knows, as it stands on its disk.
        ended: components that have ended, as this member knows: nothing waits for their elections.
    """

    epochs: dict[str, int] = {}
    ended: frozenset[str] = frozenset()


def elections(vote_record: VoteRecord) -> Elections:
    """What a member with this vote record tells."""
    records = vote_record.records
    return Elections({one.name: one.epoch for one in records}, frozenset(one.name for one in records if one.state in ENDED))


def unaware(
    members: Collection[str], voters: Collection[str], told: Mapping[str, Elections | None], *, with_etcd: bool = False
) -> dict[str, tuple[int, list[str]]]:
    """Elections that a change must wait for: members that do not know of them could be a majority after it.

    An epoch that a majority of the members does not know was claimed in vain. Of etcd it is not known which epochs it knows: it
    counts as one that lacks them, but where a single member cannot have been elected without it.

    Args:
        members: all before the change, at one site; ``voters``: all after it.
        told: by each member that grants the change; None: its release does not tell that.
        with_etcd: etcd has a vote beside them.

    Returns:
        Component → its newest epoch of that kind, and the members that do not know it yet.
    """
    tellers = [one for one in told.values() if one is not None]
    begun = {item for one in tellers for item in one.epochs.items() if item[0] not in one.ended}
    waits = {}
    for component, epoch in sorted(begun):
        knowing = {name for name, one in told.items() if one is None or one.epochs.get(component, 0) >= epoch}
        lacking = sorted({*voters} - knowing)
        is_in_vain = len(told) - len(knowing) > (len(members) + with_etcd) // 2
        etcd_lacks_it = with_etcd and len(members) > 1
        if not is_in_vain and len(lacking) + etcd_lacks_it > (len(voters) + with_etcd) // 2:
            waits[component] = epoch, lacking
    return waits


def acts_unheard(members: int) -> bool:
    """Whether a robot that no member hears may act by etcd's vote, in a team of so many members beside etcd."""
    own_and_etcds = 2
    return own_and_etcds > (members + 1) // 2


def seats(members: Mapping[str, int], order: Collection[str], mark: int = 0) -> dict[str, int]:
    """A seat for each member: those that have one keep it, and the others get the next free ones, in that order.

    Args:
        members: name → seat, -1 for none yet.
        mark: the seat above the one that was given last. A seat that became free below it is given again only when all above are
            used up: snapshots of the robot that had it may still be there.
    """
    taken = {seat for seat in members.values() if seat >= 0}
    around = (*range(mark, SEATS), *range(min(mark, SEATS)))
    free = (seat for seat in around if seat not in taken)
    return {name: members[name] if members[name] >= 0 else next(free) for name in order}
