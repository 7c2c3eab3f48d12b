"""Records from which member's address unauthenticated heartbeats came; the rules do not take them for silence.

A refusal on the replication link says more: whose key it was and whose team file lacks it.
`agent.worker.network.replication_link` reports that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from agent.system.connection_quota import plain
from failover.config.team import split_address
from failover.core.events import Unread
from failover.core.frames.frame import Reason, Refused

TOLD_EVERY_NS: Final = 1_000_000_000
"""Between two signs of one robot: a flood of them costs the rules nothing."""

OF_OUR_TEAM: Final = frozenset({Reason.UNKNOWN_KEY, Reason.FORGED, Reason.MALFORMED, Reason.SENDER, Reason.PART, Reason.ROSTER})
"""Refusals of frames that name our team: also from an address that is no member's they may be those of one."""

OF_A_MEMBER: Final = {
    Reason.VERSION: "its beats are of another version; install the same release on both",
    Reason.TEAM: "its beats are of another team; see the name of the team in team.toml on both",
    Reason.MALFORMED: "its beats are not understood; install the same release on both",
    Reason.SENDER: "its beats say that another robot sent them; see robot in agent.toml there",
    Reason.UNKNOWN_KEY: "",
    Reason.PART: "",
    Reason.ROSTER: "its team.toml is another; copy the same file to both, and start their agents again",
    Reason.FORGED: "",
}
"""What a refusal says of the member from whose address the frame came; others prove that it was authentic once."""


class UnreadBeats:
    """Signs of life that prove nothing but themselves. Costs a flood of them a look into a table each."""

    def __init__(self, beats: Mapping[str, Sequence[str]]) -> None:
        """
        Args:
            beats: "host:port" for each link, by name of the member; a host that is a name is not looked up.
        """
        ways = [(name, split_address(address, "beat address")) for name, addresses in beats.items() for address in addresses]
        self._members = {(plain(host), port): name for name, (host, port) in ways}
        hosts = Counter(host for host, _ in self._members)
        self._alone = {host: name for (host, _), name in self._members.items() if hosts[host] == 1}
        self._next_ns: dict[str, int] = {}

    def of_beat(self, refused: Refused, sender: tuple[str, int, *tuple[int, ...]], now_ns: int) -> Unread | None:
        """What a beat from that address, which was not believed, tells the rules; None for nothing, or nothing new."""
        why = OF_A_MEMBER.get(refused.reason)
        if why is None:
            return None
        host = plain(sender[0])
        robot = refused.sender or self._members.get((host, sender[1])) or self._alone.get(host, "")
        if (not robot and refused.reason not in OF_OUR_TEAM) or now_ns < self._next_ns.get(robot, 0):
            return None
        self._next_ns[robot] = now_ns + TOLD_EVERY_NS
        return Unread(robot, why)
