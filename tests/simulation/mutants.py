"""Deliberate mistakes in the rules. Each must be caught by some seed: a simulator that finds nothing proves nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from failover.core import acts, election, endings, lease, node, replication, warmth
from failover.core.component import Component, Turn
from failover.core.membership import Membership
from failover.core.messages import Entry
from failover.core.types import Config

Mutant = Callable[[], Any]


def impatient_standby() -> Any:
    """A peer is replaced after half of the lease that it may still act on."""
    return patch.object(Config, "loyalty_ns", property(lambda self: self.lease_ns // 2))


def lease_from_the_answer() -> Any:
    """The lease counts from hearing the answer, not from the asking."""

    def counted(self: Membership, robot: str) -> int:
        peer = self.peers.get(robot)
        return peer.heard_ns + self._config.lease_ns if peer and peer.boot else 0

    return patch.object(Membership, "lease_ns", counted)


def forgetful_ballot() -> Any:
    """Epochs are not made durable."""
    return patch.object(node.Node, "_persist", lambda self: None)


def deaf_to_stale() -> Any:
    """A primary does not give up to a higher epoch."""
    return patch.object(election, "_stronger", lambda *_: False)


def everybody_yields() -> Any:
    """Of two claims both give up: nobody decides."""
    return patch.object(election, "_stronger", lambda *_: True)


def no_consent() -> Any:
    """A claim goes on without waiting for anybody."""
    return patch.object(election, "_consented", lambda *_: True)


def nobody_needs_the_right() -> Any:
    """Under freeze anybody thinks that it may act alone."""
    return patch.object(election, "_right_to_act_alone", lambda *_: True)


def secret_trust() -> Any:
    """Checkpoints are shipped to a robot that is not counted among those who may take over."""
    return patch.object(lease, "entrust", lambda *_: True)


def oldest_checkpoint() -> Any:
    """A standby resumes from the oldest position it holds."""
    return patch.object(Component, "newest", property(lambda self: self.held[0] if self.held else None))


def early_acknowledgement() -> Any:
    """The keeper is told of a checkpoint when it is sent, not when it is stored."""
    honest = replication.captured

    def hasty(component: Component, turn: Turn, event: Any) -> None:
        honest(component, turn, event)
        if component.flight is not None and component.flight.position == event.position:
            turn.order(acts.Acknowledge(component.name, component.epoch, event.position, True))

    return patch.object(replication, "captured", hasty)


def no_base_for_the_lost() -> Any:
    """A delta is sent although the standby does not have its parent."""
    honest = replication._standby_entry

    def blind(component: Component, turn: Turn) -> Entry | None:
        entry = honest(component, turn)
        if entry is None or component.parent is None:
            return entry
        parent = component.parent
        return Entry(entry.name, entry.state, entry.epoch, entry.primary, parent.generation, parent.sequence, parent.digest)

    return patch.object(replication, "_standby_entry", blind)


def guard_unaware() -> Any:
    """The lease in the guard is not watched: after a pause nobody lets the program go on."""
    return patch.object(lease, "_may_thaw", lambda *_: False)


def same_epoch_again() -> Any:
    """A takeover does not open a new epoch."""
    honest = election.claim

    def claim(component: Component, turn: Turn, plan: Any, why: str) -> None:
        if component.epoch:
            component.epoch -= 1
        honest(component, turn, plan, why)

    return patch.object(election, "claim", claim)


def runs_the_finished() -> Any:
    """The standby does not take the record of an end."""
    return patch.object(election, "_heard_end", lambda *_: None)


def crash_is_the_end() -> Any:
    """After a crash nobody resumes the program, and nobody says that it failed."""
    return patch.object(endings, "_recover", lambda *_: None)


def no_grace() -> Any:
    """A robot that has just started takes everybody it has not heard for dead."""
    return patch.object(Config, "grace_ns", property(lambda _: 0))


def blind_to_the_better() -> Any:
    """Whoever holds a checkpoint claims, although another robot holds a newer one."""
    return patch.object(election, "_living_entries", lambda *_: [])


def loyal_to_the_lost() -> Any:
    """A standby that died is not replaced by another one."""
    honest = replication.choose_standby

    def loyal(component: Component, turn: Turn) -> None:
        if not component.standby:
            honest(component, turn)

    return patch.object(replication, "choose_standby", loyal)


def tireless_giver() -> Any:
    """A checkpoint that was not taken is offered again at once, and again."""
    honest = replication.ship_ended

    def hasty(component: Component, turn: Turn, event: Any) -> None:
        honest(component, turn, event)
        component.due_ns = turn.now_ns

    return patch.object(replication, "ship_ended", hasty)


def waits_for_ever() -> Any:
    """What waits at a robot is not ended when the component has ended, or has another standby."""

    def stubborn(component: Component, turn: Turn) -> None:
        if component.waiting is None:
            honest(component, turn)

    honest = warmth.review
    return patch.object(warmth, "review", stubborn)


def waits_where_it_may_not_run() -> Any:
    """A program waits also where it was told to be held only, or where somebody else is entrusted."""
    return patch.object(warmth, "_wanted", lambda component: component.spec if component.keeps_state else None)


SPOILERS: tuple[tuple[Mutant, str], ...] = (
    (blind_to_the_better, "the_newest_checkpoint_wins_over_the_lesser_name"),
    (loyal_to_the_lost, "three_robots_stand_in_for_one_another"),
    (tireless_giver, "a_chain_that_is_not_taken_is_offered_again_after_a_pause"),
)
"""Mistakes that a pair survives, or that cost no promise but the peace: each spoils a scenario."""

MUTANTS: tuple[Mutant, ...] = (
    impatient_standby,
    lease_from_the_answer,
    forgetful_ballot,
    deaf_to_stale,
    everybody_yields,
    no_consent,
    nobody_needs_the_right,
    secret_trust,
    oldest_checkpoint,
    early_acknowledgement,
    no_base_for_the_lost,
    guard_unaware,
    same_epoch_again,
    runs_the_finished,
    crash_is_the_end,
    no_grace,
    waits_for_ever,
    waits_where_it_may_not_run,
)


@contextmanager
def mistaken(mutant: Mutant) -> Iterator[None]:
    """The rules with this mistake in them, for the body."""
    with mutant():
        yield
