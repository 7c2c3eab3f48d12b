"""Observations of a robot about its peers and itself, for ``failover why``: silent peers, peers heard again, stalls of its own.

Nothing is decided here: `failover.core.membership` judges, this module only reports.
"""

from __future__ import annotations

from msgspec import Struct, field

from failover.core.component import Turn
from failover.core.events import Event, Received
from failover.core.membership import Peer
from failover.core.types import MS

COUNTS_AS_DEAD = "it counts as dead"
"""Ends what is said of a peer that is silent."""

TOLD_SHARE = 2
"""An own stall is told from this part of the loyalty on: shorter ones come and go."""


class Watch(Struct):
    """The facts noticed so far.

    Attributes:
        late_ns: the most that our loop was late within the last loyalty.
    """

    late_ns: int = 0
    _late_at_ns: int = 0
    _stalled_ns: int = 0
    _dead: set[str] = field(default_factory=set)
    _awaited: set[str] = field(default_factory=set)

    def late(self, late_ns: int, loyalty_ns: int, now_ns: int) -> None:
        """A step came ``late_ns`` after the instant that was asked for (below 0: before it)."""
        if late_ns >= self.late_ns or now_ns - self._late_at_ns > loyalty_ns:
            self.late_ns, self._late_at_ns = max(late_ns, 0), now_ns
        self._stalled_ns = late_ns if late_ns * TOLD_SHARE >= loyalty_ns else 0

    def look(self, turn: Turn, event: Event) -> None:
        """Tell the news. Called in each step after lateness was forgiven, and before the event is taken in."""
        if self._stalled_ns:
            late_ms = self._stalled_ns // MS
            turn.say_of_robot(f"{turn.me} itself stood still for {late_ms} ms; that is not counted as its peers' silence")
        now_ns, dead = turn.now_ns, self._dead
        for robot, peer in turn.team.peers.items():
            if peer.awaited_until_ns or self._awaited:
                self._follow_restart(turn, peer)
            if peer.loyal_until_ns > now_ns or robot in dead or not turn.dead(robot):
                continue
            dead.add(robot)
            turn.say_of_robot(_farewell(turn, robot))
        if isinstance(event, Received) and event.beat.sender in turn.team.peers:
            self._greet(turn, event)

    def _follow_restart(self, turn: Turn, peer: Peer) -> None:
        robot, left_ns = peer.robot, peer.awaited_until_ns - turn.now_ns
        if left_ns > 0 and peer.awaited_ms and robot not in self._awaited:
            self._awaited.add(robot)
            why = (
                f"the agent of {robot} is to restart" if peer.is_asked else f"what runs at {robot} acts on the word of {turn.me}"
            )
            left_s = left_ns / (1_000 * MS)
            turn.say_of_robot(f"{why}: {turn.me} promises to wait {left_s:.1f} s for {'it' if peer.is_asked else robot}")
        elif left_ns <= 0 and robot in self._awaited:
            self._awaited.discard(robot)
            if turn.alive(robot) and peer.is_asked:
                turn.say_of_robot(f"the agent of {robot} is back: {turn.me} waits for it no longer than ever")

    def _greet(self, turn: Turn, event: Received) -> None:
        beat = event.beat
        peer = turn.team.peers[beat.sender]
        over = f" over {event.link}" if event.link else ""
        if peer.boot and beat.boot > peer.boot:
            turn.say_of_robot(f"the agent of {beat.sender} has started anew, life {beat.boot}")
        elif not peer.boot:
            turn.say_of_robot(f"{beat.sender} is heard{over}, life {beat.boot}")
        elif beat.sender in self._dead and beat.boot == peer.boot:
            silent_ms = (turn.now_ns - peer.heard_ns) // MS
            turn.say_of_robot(f"{beat.sender} is heard again{over} after {silent_ms} ms of silence")
        if beat.boot >= peer.boot:
            self._dead.discard(beat.sender)


def _farewell(turn: Turn, robot: str) -> str:
    peer = turn.team.peers[robot]
    limit_ms = (max(turn.team.loyal_until_ns(robot), peer.awaited_until_ns) - peer.heard_ns) // MS
    if not peer.boot:
        return f"{robot} has not been heard in the {limit_ms} ms since this agent started: {COUNTS_AS_DEAD}"
    links = ", ".join(link for link in sorted(peer.links) if link)
    return f"{robot} was silent for {limit_ms} ms on every link{f' ({links})' if links else ''}: {COUNTS_AS_DEAD}"
