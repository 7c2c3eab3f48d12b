"""One robot's rules as one object: events in, obligations out.

The agent feeds it one event at a time with the instant of its own clock and obeys ``Ready``: persist → send → act. The simulator
(``tests/simulation``) does the same with many of them. There is no socket, clock, thread, dice or file in here.
"""

from __future__ import annotations

from failover.core.acts import Ready
from failover.core.events import Event
from failover.core.types import Ballot, Config, Decision, Found, Held, StatusView


class Node:
    """The rules of one robot.

    Args:
        boot: count of this agent's starts, durable already; grows with every start.
        ballot: what the last ``Ready.persist`` made durable.
        held: what this robot's snapshot store can restore.
        found: components whose guards outlived the last agent.
    """

    def __init__(
        self,
        config: Config,
        boot: int,
        ballot: Ballot,
        now_ns: int,
        held: tuple[Held, ...] = (),
        found: tuple[Found, ...] = (),
    ) -> None:
        raise NotImplementedError

    def step(self, event: Event, now_ns: int) -> Ready:
        """Take in one event at ``now_ns`` (this machine's monotonic clock) and say what must be done about it. Never raises."""
        raise NotImplementedError

    def next_deadline_ns(self) -> int:
        """The instant at which a Tick is due."""
        raise NotImplementedError

    def status(self, now_ns: int) -> StatusView:
        """The team as this robot sees it."""
        raise NotImplementedError

    def why(self, component: str = "") -> tuple[Decision, ...]:
        """The last decisions, oldest first; of one component, or all."""
        raise NotImplementedError
