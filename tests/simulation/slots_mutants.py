"""Deliberate mistakes in the slots, each with a scenario that it spoils (see `mutants`)."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

from failover.core.frames import slots
from failover.core.frames.roster import place_in
from failover.core.frames.slots import Peer, Slots
from failover.core.frames.terms import US, Seen
from tests.simulation.mutants import Mutant


def follows_everything() -> Any:
    """The reference follows any delay, however long."""
    return patch.object(Slots, "_is_worth", lambda self, delay_ns, _slot_ns: delay_ns > self.terms.delta_min_us * US)


def no_delta_min() -> Any:
    """The reference follows the smallest delay."""
    return patch.object(Slots, "_is_worth", lambda self, delay_ns, slot_ns: 0 < delay_ns < self.terms.epsilon * slot_ns)


def followers_ignore_the_set() -> Any:
    """A follower computes its slot from what it sees itself."""
    honest = Slots._follow

    def stubborn(self: Slots, lead: Peer) -> None:
        said, lead.set = lead.set, self._own_view()
        honest(self, lead)
        lead.set = said

    def choose(self: Slots) -> None:
        self._use(self._own_view())

    return patch.object(Slots, "_follow", stubborn), patch.object(Slots, "_choose_set", choose)


def void_agreement() -> Any:
    """Nobody else is asked before a robot is let in or given up, as in CAMBADA's code, whose loop leaves too early."""
    return _table(
        {
            Seen.INSERT: ((slots._is_missed_twice, Seen.NOT), (slots._is_heard, Seen.RUN)),
            Seen.REMOVE: ((slots._is_heard, Seen.RUN), (lambda terms, peer, _: peer.missed >= terms.remove_after, Seen.NOT)),
        }
    )


def _table(arrows: dict[Seen, Any]) -> Any:
    return patch.dict(slots.TABLE, arrows)


def no_adaptation() -> Any:
    """Robots spread out at the start, and then each keeps its own time."""
    return patch.object(Slots, "_adapt", lambda *_: None), patch.object(Slots, "_follow", lambda *_: None)


def one_miss_is_the_end() -> Any:
    """A robot that was not heard in one round has left."""
    return _table({Seen.RUN: ((slots._is_missed, Seen.NOT),)})


def old_slot_again() -> Any:
    """A new life goes on in the old one's slot, before anybody has agreed to it."""

    def reborn(self: Slots, peer: Peer, boot: int) -> None:
        peer.boot = boot

    return patch.object(Slots, "_reborn", reborn)


def accuses_in_its_own_lateness() -> Any:
    """Peers are judged also after a round that this robot itself has cut short."""
    return patch.object(slots, "WHOLE_ROUND", 0)


def all_begin_together() -> Any:
    """Robots that start at one instant send at one instant."""
    return patch.object(Slots, "_spread_ns", lambda *_: 0)


def speaks_into_slots() -> Any:
    """A late-comer begins right after the reference, where another one's slot is."""
    return patch.object(Slots, "_widest_gap", lambda self, first: first.left_ns + self._t_ns // first.set.bit_count())


def asks_the_deaf() -> Any:
    """Also a robot that a newcomer does not hear must see it."""
    return _table(
        {
            Seen.INSERT: (
                (slots._is_missed_twice, Seen.NOT),
                (lambda _terms, peer, running: all(one.sees(peer.rank) != Seen.NOT for one in running), Seen.RUN),
            )
        }
    )


def believes_its_ears_only() -> Any:
    """Who is not heard has no slot, though others hear it."""
    return patch.object(Slots, "_vouched", lambda _: []), patch.object(Slots, "_is_run_by_one", lambda *_: False)


def speaks_at_once_after_sleep() -> Any:
    """After a suspend a robot speaks before it has listened."""
    honest = Slots.due

    def hasty(self: Slots, now_ns: int) -> bool:
        self._next_ns = max(self._next_ns, now_ns - self._t_ns)
        return honest(self, now_ns)

    return patch.object(Slots, "due", hasty)


def speaks_in_any_round() -> Any:
    """A robot whose t_tup_ms is another one speaks all the same."""
    return patch.object(Slots, "_refusal", lambda _: "")


def two_frames_for_one() -> Any:
    """A late frame is followed by one in the slot that it has missed."""
    honest = Slots._follow

    def twice(self: Slots, lead: Peer) -> None:
        honest(self, lead)
        if self._is_in(lead) and self._sent_ns is not None:
            slot_ns = self._slot_ns()
            place = (place_in(self.set, self.me) - place_in(self.set, lead.rank)) % self.set.bit_count()
            self._next_ns = max(lead.left_ns + place * slot_ns, lead.came_ns)

    return patch.object(Slots, "_follow", twice)


SLOTS_SPOILERS: tuple[tuple[Mutant, str], ...] = (
    (follows_everything, "a_robot_that_follows_nobody_drags_nobody"),
    (no_delta_min, "two_robots_on_a_quiet_radio_keep_their_round"),
    (followers_ignore_the_set, "a_follower_crashes"),
    (void_agreement, "one_way_deafness"),
    (no_adaptation, "clocks_differ_by_years_and_drift"),
    (one_miss_is_the_end, "two_robots_lose_one_frame_in_a_hundred"),
    (accuses_in_its_own_lateness, "a_loop_is_late"),
    (all_begin_together, "all_start_at_once"),
    (speaks_into_slots, "a_latecomer_gets_a_slot"),
    (asks_the_deaf, "a_hidden_pair"),
    (believes_its_ears_only, "the_second_robot_does_not_hear_the_reference"),
    (believes_its_ears_only, "the_reference_is_deaf_for_one"),
    (speaks_at_once_after_sleep, "a_machine_sleeps"),
    (speaks_in_any_round, "a_robot_with_another_round_is_not_let_in"),
    (two_frames_for_one, "a_loop_is_late"),
)
"""A mistake, and the scenario that it spoils."""
