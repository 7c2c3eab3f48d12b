"""Deliberate mistakes in the rules. Some seed must catch each: a simulator that finds nothing proves nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from msgspec.structs import replace

from failover.core import acts, beat_builder, node, peer_claims
from failover.core.component import Component, Turn
from failover.core.election import lease, majority, pair, votes
from failover.core.election.coordinator import Arbiter
from failover.core.events import Fetched, Looked
from failover.core.membership import UNREAD_NS, Membership, Peer
from failover.core.replication import archived, servers, standby, warm_standby
from failover.core.transitions import drain, exits, handover, restarts
from failover.core.types import MS, Config, Restart, State
from failover.core.wire.messages import Entry

Mutant = Callable[[], Any]


def impatient_standby() -> Any:
    """A peer is replaced after half of the lease that it may still act on."""
    return _loyal_for(lambda self: self.lease_ns // 2)


def _loyal_for(how_long: Callable[[Config], int]) -> Any:
    """Exactly so long, however late beats come."""
    return patch.object(Config, "loyalty_ns", property(how_long)), patch.object(Membership, "_wider_ns", lambda *_: 0)


def lease_from_the_answer() -> Any:
    """The lease counts from hearing the answer, not from the asking."""

    def counted(self: Membership, robot: str) -> int:
        peer = self.peers.get(robot)
        return peer.heard_ns + self._config.lease_ns if peer and peer.boot else 0

    return patch.object(Membership, "lease_ns", counted)


def forgetful_vote_record() -> Any:
    """Epochs are not made durable."""
    return patch.object(node.Node, "_persist", lambda self: None)


def deaf_to_stale() -> Any:
    """A primary does not give up to a higher epoch."""
    return patch.object(pair, "stronger", lambda *_: False)


def everybody_yields() -> Any:
    """Of two claims both give up: neither robot decides."""
    return patch.object(pair, "stronger", lambda *_: True)


def no_consent() -> Any:
    """A claim goes on without the consent of any robot."""
    return patch.object(pair, "_consented", lambda *_: True)


def nobody_needs_the_right() -> Any:
    """Under freeze every robot thinks that it may act alone."""
    return patch.object(pair, "_right_to_act_alone", lambda *_: True)


def secret_trust() -> Any:
    """Checkpoints are shipped to a robot that is not counted among those who may take over."""
    return patch.object(lease, "entrust", lambda *_: True)


def oldest_checkpoint() -> Any:
    """A standby resumes from the oldest position it holds."""
    return patch.object(Component, "newest", property(lambda self: self.held[0] if self.held else None))


def early_acknowledgement() -> Any:
    """The keeper is told of a checkpoint when it is sent, not when it is stored."""
    honest = standby.captured

    def hasty(component: Component, turn: Turn, event: Any) -> None:
        honest(component, turn, event)
        if component.flight is not None and component.flight.position == event.position:
            turn.order(acts.Acknowledge(component.name, component.epoch, event.position, True))

    return patch.object(standby, "captured", hasty)


def shown_when_stored() -> Any:
    """Readers see the output of a snapshot as soon as it is stored, whether or not the rules have accepted it."""
    honest = standby.stored

    def hasty(component: Component, turn: Turn, event: Any) -> None:
        turn.order(acts.Show(component.name, component.epoch, event.position))
        honest(component, turn, event)

    return patch.object(standby, "stored", hasty)


def shown_when_accepted() -> Any:
    """Under majority readers see what their robot has accepted, though the primary has not acknowledged it."""
    honest = standby.stored

    def hasty(component: Component, turn: Turn, event: Any) -> None:
        honest(component, turn, event)
        if event.position in component.held:
            component.vouched = event.position

    return patch.object(standby, "stored", hasty)


def no_base_for_the_lost() -> Any:
    """A delta is sent although the standby does not have its parent."""
    honest = standby._standby_entry

    def blind(component: Component, turn: Turn) -> Entry | None:
        entry = honest(component, turn)
        if entry is None or component.parent is None:
            return entry
        parent = component.parent
        return Entry(entry.name, entry.state, entry.epoch, entry.primary, parent.generation, parent.sequence, parent.digest)

    return patch.object(standby, "_standby_entry", blind)


def guard_unaware() -> Any:
    """The lease in the guard is not watched: after a pause no robot thaws the program."""
    return patch.object(lease, "_may_thaw", lambda *_: False)


def same_epoch_again() -> Any:
    """A takeover does not open a new epoch."""
    honest = pair.claim

    def claim(component: Component, turn: Turn, plan: Any, why: str, *, is_planned: bool = False) -> None:
        if component.epoch:
            component.epoch, component.seen = component.epoch - 1, 0
        honest(component, turn, plan, why, is_planned=is_planned)

    return patch.object(pair, "claim", claim), patch.object(votes, "claim", claim)


def runs_the_finished() -> Any:
    """The standby does not take the record of an end."""
    return patch.object(pair, "heard_end", lambda *_: None), patch.object(votes, "heard_end", lambda *_: None)


def crash_is_the_end() -> Any:
    """After a crash no robot resumes the program, and none says that it failed."""
    return patch.object(exits, "_recover", lambda *_: None)


def rewinds_at_reunion() -> Any:
    """Of two copies that met again the one with the higher epoch stays, also where the other one never stopped acting."""
    return patch.object(pair, "_never_stopped", lambda *_: False)


def impatient_at_reunion() -> Any:
    """The copy that never stopped gives up to a robot that has just started, and has no key of it yet."""
    return patch.object(Membership, "patience_ns", lambda team, _robot: team._loyalty_ns)


def never_stopped_though_it_stood() -> Any:
    """A copy that stood still meanwhile claims that it never stopped."""
    return patch.object(lease, "_all_agree", lambda *_: True)


def claims_at_boot() -> Any:
    """A robot that has just started claims what another one ran, though it has not heard that robot yet."""
    return patch.object(pair, "waits_after_boot_ns", lambda *_: 0)


def takes_the_unreadable_for_silence() -> Any:
    """A message of a robot that cannot be authenticated counts as silence."""
    return patch.object(Membership, "unreadable", lambda *_: "")


def believes_garbage() -> Any:
    """A message that cannot be authenticated proves that its robot lives, also where that robot was heard before."""

    def unreadable(self: Membership, robot: str, _why: str, now_ns: int) -> str:
        peer = self.peers[robot]
        peer.loyal_until_ns = max(peer.loyal_until_ns, now_ns + UNREAD_NS)
        return ""

    return patch.object(Membership, "unreadable", unreadable)


def waits_in_spite_of_the_order() -> Any:
    """An operator's order does not help against what cannot be authenticated."""
    return patch.object(Membership, "keeps_waiting", lambda *_: False)


def forgets_the_order() -> Any:
    """Where two copies meet again, that one of them was promoted counts for nothing."""
    return patch.object(pair, "_outlasts", pair._never_stopped)


def remembers_the_order_for_ever() -> Any:
    """A copy that was promoted once is not protected by having acted all the time."""
    return patch.object(
        pair, "_outlasts", lambda component, entry: not component.ordered and pair._never_stopped(component, entry)
    )


def believes_its_team_file() -> Any:
    """A robot that the team file does not know is dead, though one knocks that may be it."""
    return patch.object(Membership, "strangers_until_ns", lambda _: 0)


def no_grace() -> Any:
    """A robot that has just started takes every robot that it has not heard for dead."""
    return patch.object(Config, "grace_ns", property(lambda _: 0))


def blind_to_the_better() -> Any:
    """Every robot that holds a checkpoint claims, although another one holds a newer checkpoint."""
    return patch.object(pair, "living_entries", lambda *_: [])


def loyal_to_the_lost() -> Any:
    """A standby that died is not replaced by another one."""
    honest = standby.choose_standby

    def loyal(component: Component, turn: Turn) -> None:
        if not component.standby:
            honest(component, turn)

    return patch.object(standby, "choose_standby", loyal)


def tireless_giver() -> Any:
    """A checkpoint that was not taken is offered again at once, and again."""
    honest = standby.ship_ended

    def hasty(component: Component, turn: Turn, event: Any) -> None:
        honest(component, turn, event)
        component.due_ns = turn.now_ns

    return patch.object(standby, "ship_ended", hasty)


def forgets_what_it_ran() -> Any:
    """A robot consents to another's claim of an epoch under which it has run the component, and the other does not notice."""
    honest = pair._may_switch

    def generous(component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
        return component.primary == turn.me or honest(component, turn, sender, entry)

    return patch.object(pair, "_may_switch", generous), patch.object(pair, "_is_taken", lambda *_: False)


def waits_for_ever() -> Any:
    """A robot does not end its waiting program when the component has ended, or has another standby."""

    def stubborn(component: Component, turn: Turn) -> None:
        if component.waiting is None:
            honest(component, turn)

    honest = warm_standby.review
    return patch.object(warm_standby, "review", stubborn)


def waits_where_it_may_not_run() -> Any:
    """A program waits also on a robot that shall only hold it, or where another robot is entrusted."""
    return patch.object(warm_standby, "_wanted", lambda component: component.spec)


# Mistakes in the rule ``majority``


def double_voting() -> Any:
    """A member votes for every robot that asks, also twice in one epoch."""
    honest = majority.may_follow

    def generous(component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
        again = entry.epoch == component.epoch and component.primary != turn.me
        return again or honest(component, turn, sender, entry)

    return patch.object(majority, "may_follow", generous)


def no_margin() -> Any:
    """The drift margin is removed: loyal for exactly a lease."""
    return _loyal_for(lambda self: self.lease_ns)


def disloyal_voter() -> Any:
    """A member votes for another although it hears the primary that it follows."""
    honest = majority.is_free

    def free(component: Component, turn: Turn) -> bool:
        return component.state is State.STANDBY or honest(component, turn)

    return patch.object(majority, "is_free", free)


def minority_rules() -> Any:
    """One vote less than a majority is enough."""
    return patch.object(Config, "quorum", property(lambda self: (len(self.peers) + 1) // 2))


def anybody_may_have_it() -> Any:
    """Votes go to robots with older checkpoints, too."""
    return patch.object(majority, "eligible", lambda *_: True), patch.object(majority, "_covers", lambda *_: True)


def named_in_advance() -> Any:
    """A standby is named before it holds what was acknowledged."""
    honest = standby.choose_standby

    def hasty(component: Component, turn: Turn) -> None:
        honest(component, turn)
        if component.standby:
            component.entrusted = (component.standby,)

    return patch.object(standby, "choose_standby", hasty)


def best_lease_counts() -> Any:
    """The lease is the longest that any member grants, not the one that a majority grants."""

    def longest(component: Component, turn: Turn) -> int:
        return max((turn.team.lease_ns(peer.robot) for peer in turn.team.peers.values()), default=0)

    return patch.object(majority, "granted_ns", longest)


def lease_from_strangers() -> Any:
    """Every member that hears us lengthens our lease, also one that votes for another."""

    def granted(component: Component, turn: Turn) -> int:
        leases = sorted((turn.team.lease_ns(peer.robot) for peer in turn.team.peers.values()), reverse=True)
        return leases[turn.config.quorum - 2]

    return patch.object(majority, "granted_ns", granted)


def deafness_at_once() -> Any:
    """A peer that seems deaf is replaced at once, while what it was told still lets it act."""

    def gone(self: Membership, robot: str, now_ns: int) -> bool:
        return self.dead(robot, now_ns) or now_ns - self.peers[robot].heard_us_ns > self._config.lease_ns // 4

    return patch.object(Membership, "gone", gone)


def votes_with_a_copy() -> Any:
    """A robot whose copy is still being stopped counts as one that agrees."""

    def agrees(component: Component, peer: Peer, me: str) -> bool:
        entry = peer.entry(component.name)
        return entry is not None and (entry.epoch, entry.primary) == (component.epoch, me)

    return patch.object(majority, "grants", agrees), patch.object(majority, "_BOUND", frozenset())


def generous_lease() -> Any:
    """A lease is longer than was granted."""
    honest = majority.granted_ns

    def longer(component: Component, turn: Turn) -> int:
        return honest(component, turn) + turn.config.lease_ns // 4

    return patch.object(majority, "granted_ns", longer)


def proud_primary() -> Any:
    """A primary without a lease never gives up."""
    return patch.object(votes, "lose", lambda *_: None)


def humble_primary() -> Any:
    """A primary without a lease gives up to every later epoch, also to an old copy that was not elected."""
    return patch.object(votes, "_prevails", lambda component, turn, sender, entry: entry.epoch > component.epoch)


def claims_for_ever() -> Any:
    """A claim that was split is never withdrawn."""
    return patch.object(votes, "withdraw", lambda *_: None)


def forgotten_votes() -> Any:
    """Epochs are durable, votes are not."""
    honest = Component.record
    return patch.object(Component, "record", lambda self: replace(honest(self), primary=""))


def never_deaf() -> Any:
    """A peer that is heard counts as one that hears."""
    return patch.object(Membership, "_deaf", lambda *_: False)


def no_pre_vote() -> Any:
    """A robot claims without asking whether others would vote for it."""
    return patch.object(majority, "may_claim", lambda *_: True), patch.object(votes, "vacant", lambda *_: True)


def unfinished_business() -> Any:
    """A handover that was not taken up is never called off."""
    return patch.object(handover, "step_down", lambda *_: None)


def miserly_server() -> Any:
    """A server gives nothing back."""
    honest = servers._heir
    return patch.object(servers, "_heir", lambda component, turn: honest(component, turn) if turn.config.runs(turn.me) else "")


# Mistakes in whom to believe


def no_roles() -> Any:
    """A witness and a server are believed like a robot."""
    return patch.object(Config, "runs", lambda *_: True), patch.object(Config, "keeps", lambda *_: True)


def believes_every_word() -> Any:
    """No entry is looked at before the rules see it."""
    return patch.object(peer_claims.Testimony, "take", lambda _, beat, *__: (beat, frozenset()))


def believes_any_epoch() -> Any:
    """The words of others raise an epoch without bound."""
    return patch.object(peer_claims, "epoch_max", lambda *_: 1 << 62)


def deaf_to_denial() -> Any:
    """A message about a robot counts, although that robot lives and says otherwise."""
    return patch.object(peer_claims, "_denier", lambda *_: "")


def gives_up_to_any_end() -> Any:
    """A copy that acts is stopped when any robot tells of an end."""
    return patch.object(votes, "_heard_end", pair.heard_end), patch.object(pair, "_acted_all_along", lambda *_: False)


def leaves_its_primary_for_an_end() -> Any:
    """A voter records an end that any robot tells of, although its primary runs the component."""
    return patch.object(majority, "may_record_end", lambda *_: True)


def asks_the_dead_for_their_vote() -> Any:
    """The vote of the robot that ended it counts only while that robot tells it."""
    found = majority.elected
    return patch.object(majority, "elected", lambda component, turn, robot, epoch, _=0: found(component, turn, robot, epoch))


def waits_for_every_server() -> Any:
    """A standby waits for what a server says to have, however long."""
    return patch.object(votes, "_waits_for_a_server", lambda component, turn, mine, best: best is not None and mine < best)


def never_mind_who_repeats() -> Any:
    """The word of a witness that something has ended keeps a majority from running it."""
    return patch.object(pair, "_is_not_ended", lambda *_: False)


def forgets_weeks() -> Any:
    """A robot that was away believes no more epochs than can have passed since it is back."""
    return patch.object(peer_claims, "EPOCHS_AWAY_MAX", 0)


# Mistakes in the starts of declared programs


def restarts_for_ever() -> Any:
    """No limit is looked at."""
    return patch.object(restarts, "_may_once_more", lambda *_: True)


def restarts_what_was_stopped() -> Any:
    """An end counts as the program's own, also where an operator ordered it."""
    honest = restarts.begin

    def begin(component: Component, turn: Turn, cause: Any, status: int, why: str) -> bool:
        component.ending = False
        return honest(component, turn, cause, status, why)

    return patch.object(restarts, "begin", begin)


def restarts_after_every_end() -> Any:
    """restart = on-failure is taken for always."""
    return patch.dict(restarts.CAUSES, {Restart.ON_FAILURE: restarts.CAUSES[Restart.ALWAYS]})


def gives_its_primacy_up_for_the_pause() -> Any:
    """The end is a record, which all follow, and the robot where it ended is alone in knowing of the start to come."""
    return patch.object(restarts, "begin", lambda *_: False)


def resumes_what_has_ended() -> Any:
    """The checkpoints of a program that has ended count as those of the next one."""
    honest = restarts.begin

    def begin(component: Component, turn: Turn, cause: Any, status: int, why: str) -> bool:
        held = list(component.held)
        begun = honest(component, turn, cause, status, why)
        component.held = held
        return begun

    return patch.object(restarts, "begin", begin)


def lease_beyond_the_promise() -> Any:
    """The guard of a robot whose agent restarts gets a longer lease than its peers have promised to wait."""
    honest = Membership._take_promises

    def generous(self: Membership, peer: Peer, beat: Any) -> None:
        before_ns = peer.promised_ns
        honest(self, peer, beat)
        if peer.promised_ns > before_ns:
            peer.promised_ns += self._config.restart_grace_ms * MS // 2

    return patch.object(Membership, "_take_promises", generous)


def forgets_its_promise() -> Any:
    """An agent that begins does not know what the one before it has promised."""
    honest = Membership.__init__

    def begin(self: Membership, config: Config, boot: int, now_ns: int, awaited: Any = ()) -> None:
        honest(self, config, boot, now_ns)

    return patch.object(Membership, "__init__", begin)


def promise_of_a_minority() -> Any:
    """An agent that restarts is content with the promise of one member."""
    honest = majority.granted_ns

    def granted(component: Component, turn: Turn) -> int:
        promised = [peer.promised_ns for peer in turn.team.peers.values()] if turn.leaving else []
        return max(honest(component, turn), *promised, 0)

    return patch.object(majority, "granted_ns", granted)


def breaks_its_promise() -> Any:
    """A robot replaces one that it has promised to wait for, as soon as that is silent for a lease and a margin."""
    honest = Membership.dead

    def dead(self: Membership, robot: str, now_ns: int) -> bool:
        return now_ns >= self.peers[robot].loyal_until_ns if robot in self.peers else honest(self, robot, now_ns)

    return patch.object(Membership, "dead", dead)


def leaves_while_its_peer_is_away() -> Any:
    """An agent that restarts does not wait for a peer whose agent restarts, too."""
    return patch.object(node.Node, "_wait_for_those_that_restart", lambda *_: None)


def leaves_without_a_word() -> Any:
    """An agent that restarts promises nothing to a primary that acts on its echoes."""
    return patch.object(node.Node, "_depend_on_us", lambda *_: {})


def freezes_what_ran_on() -> Any:
    """An agent that is back holds its programs still until it is heard, though they have a lease."""
    return patch.object(lease, "inherit", lambda *_: False)


def waits_though_it_is_back() -> Any:
    """A promise lasts to its end, though the robot is back and needs it no more."""
    return patch.object(node.Node, "_returned", lambda *_: 0)


def back_too_soon() -> Any:
    """An agent says at once that it is back, while its guards still have the long lease."""
    return patch.object(lease, "borrows", lambda *_: False)


def forgets_that_it_is_drained() -> Any:
    """A robot is drained until its agent restarts."""
    honest = node.Node._persist

    def persist(self: node.Node) -> Any:
        drained, self._drained = self._drained, False
        try:
            return honest(self)
        finally:
            self._drained = drained

    return patch.object(node.Node, "_persist", persist), patch.object(node.Node, "_is_undurable", lambda *_: False)


def drained_all_the_same() -> Any:
    """What runs at a drained robot stays there."""
    return patch.object(drain, "review", lambda *_: None)


def waits_for_every_restart() -> Any:
    """No component is taken over while the agent of any member restarts."""
    return patch.object(pair, "_is_passed_over", lambda *_: False)


# Mistakes in the rule ``etcd``; tests/failover/core/election/test_coordinator.py catches those that need an instant of bad luck


def no_fence_at_the_end() -> Any:
    """A primary that was granted a lease once goes on when that is over."""
    honest = majority.granted_ns

    def endless(component: Component, turn: Turn) -> int:
        until_ns = honest(component, turn)
        return until_ns and max(until_ns, turn.now_ns + turn.config.lease_ns)

    return patch.object(majority, "granted_ns", endless)


def trusts_etcds_clock() -> Any:
    """A robot counts as silent as soon as its lease at etcd is over."""
    return patch.object(Arbiter, "_silent_ns", lambda self, robot: 0 if robot in self._leased else 1 << 60)


ETCD_MUTANTS: tuple[tuple[Mutant, int], ...] = (
    (lease_from_the_answer, 40),
    (no_fence_at_the_end, 37),
    (trusts_etcds_clock, 94),
)
"""Mistakes that lives with etcd catch, and the seed that caught each last."""


# Mistakes about the archive


def no_last_look() -> Any:
    """A robot takes over from the copy that it has, and does not look into the archive once more."""
    honest = archived.review

    def hasty(component: Component, turn: Turn) -> None:
        honest(component, turn)
        if component.freed_ns and component.held:
            component.looked_ns, component.fresh = max(component.looked_ns, component.freed_ns), True

    return patch.object(archived, "review", hasty)


def content_with_less() -> Any:
    """A look counts, though the archive has a newer copy, which has not come."""

    def content(component: Component, event: Looked) -> None:
        component.lags, component.looked_ns = False, max(component.looked_ns, event.begun_ns)

    return patch.object(archived, "looked", content)


APART_MUTANTS: tuple[tuple[Mutant, int], ...] = ((no_last_look, 11), (content_with_less, 11))
"""Mistakes that lives of robots which never hear each other catch, and the seed that caught each last."""


def as_good_as_before() -> Any:
    """A robot that lost its disk counts as one that holds all again, as soon as it has a copy."""
    honest = archived.fetched

    def proud(component: Component, turn: Turn, event: Fetched) -> None:
        honest(component, turn, event)
        component.bare = False

    return patch.object(archived, "fetched", proud)


def keeps_its_loss_to_itself() -> Any:
    """A robot that lost its disk does not say that its position is that of a copy."""
    return patch.object(beat_builder, "BARE", 0)


def waits_for_no_server() -> Any:
    """A robot with but a copy does not wait for silent servers and witnesses, nor for their word of an end."""
    return patch.object(archived, "may_be_outdated", lambda *_: False)


ARCHIVE_MUTANTS: tuple[tuple[Mutant, int], ...] = ((as_good_as_before, 53), (waits_for_no_server, 284))
"""Mistakes that lives of voters with an archive catch, and the seed that caught each last."""


def hides_what_it_could_not_resume() -> Any:
    """A robot does not tell of a checkpoint that it could not resume: as if it were lost."""
    honest = beat_builder.entry_of

    def told(component: Component) -> Entry:
        entry = honest(component)
        return replace(entry, generation=0, sequence=0, digest=b"") if component.unable else entry

    return patch.object(node, "entry_of", told)


FAILING_MUTANTS: tuple[tuple[Mutant, int], ...] = ((hides_what_it_could_not_resume, 15),)
"""Mistakes that lives in which restores fail catch, and the seed that caught each last."""


SPOILERS: tuple[tuple[Mutant, str], ...] = (
    (as_good_as_before, "a_copy_of_the_archive_waits_for_the_standby_that_holds_more"),
    (keeps_its_loss_to_itself, "a_copy_of_the_archive_waits_for_the_standby_that_holds_more"),
    (waits_for_no_server, "a_copy_of_the_archive_waits_for_the_server_that_holds_more"),
    (blind_to_the_better, "the_newest_checkpoint_wins_over_the_lesser_name"),
    (loyal_to_the_lost, "three_robots_stand_in_for_one_another"),
    (no_pre_vote, "whoever_is_cut_off_raises_no_epoch"),
    (never_deaf, "a_deaf_primary_is_replaced"),
    (miserly_server, "both_robots_dead_one_is_back_empty_the_server_returns_it"),
    (anybody_may_have_it, "an_older_checkpoint_waits_for_the_newest"),
    (forgets_what_it_ran, "an_epoch_that_was_used_is_not_consented_to"),
    (humble_primary, "an_old_copy_that_raises_its_epoch_is_not_believed"),
    (minority_rules, "without_a_majority_nothing_acts"),
    (rewinds_at_reunion, "after_a_total_cut_the_copy_that_never_stopped_stays"),
    (rewinds_at_reunion, "a_claim_in_the_dark_gives_up_to_the_copy_that_never_stopped"),
    (impatient_at_reunion, "the_copy_that_never_stopped_waits_until_the_other_robot_has_its_key"),
    (never_stopped_though_it_stood, "a_primary_that_stood_still_gives_up_to_the_copy_that_acted"),
    (claims_at_boot, "a_standby_that_boots_before_its_network_rewinds_nothing"),
    (claims_at_boot, "a_robot_that_was_taken_out_of_the_team_is_replaced_after_the_patience"),
    (takes_the_unreadable_for_silence, "a_robot_that_cannot_authenticate_its_neighbour_takes_nothing_over"),
    (takes_the_unreadable_for_silence, "a_primary_whose_agent_is_back_with_a_wrong_key_stands_still"),
    (takes_the_unreadable_for_silence, "a_robot_whose_team_file_is_old_rewinds_nothing"),
    (takes_the_unreadable_for_silence, "a_robot_that_was_never_authenticated_and_falls_silent_is_replaced"),
    (believes_garbage, "what_anybody_sends_from_a_lost_robots_address_keeps_nobody_from_replacing_it"),
    (waits_in_spite_of_the_order, "an_operator_need_not_wait_for_what_cannot_be_authenticated"),
    (waits_in_spite_of_the_order, "a_standby_is_promoted_past_what_cannot_be_authenticated"),
    (forgets_the_order, "an_operator_need_not_wait_for_what_cannot_be_authenticated"),
    (remembers_the_order_for_ever, "an_operator_need_not_wait_for_what_cannot_be_authenticated"),
    (believes_its_team_file, "a_robot_whose_team_file_is_old_rewinds_nothing"),
    (no_roles, "a_lying_witness_ends_nothing"),
    (no_roles, "a_lying_server_ends_and_runs_nothing"),
    (believes_every_word, "a_lying_witness_runs_and_keeps_nothing"),
    (believes_any_epoch, "a_lying_witness_raises_no_epoch"),
    (deaf_to_denial, "a_lying_witness_ends_nothing"),
    (gives_up_to_any_end, "a_lying_robot_ends_nothing_of_a_majority"),
    (gives_up_to_any_end, "a_lying_robot_of_a_pair_ends_nothing"),
    (leaves_its_primary_for_an_end, "a_lying_robot_ends_nothing_of_a_majority"),
    (asks_the_dead_for_their_vote, "an_end_is_learned_although_the_robot_that_tells_of_it_first_is_gone"),
    (waits_for_every_server, "a_robot_is_replaced_although_a_server_lies"),
    (never_mind_who_repeats, "a_robot_is_replaced_although_a_witness_lies"),
    (forgets_weeks, "a_robot_that_was_away_while_epochs_passed_takes_them_over"),
    (shown_when_stored, "what_is_stored_after_the_claim_is_not_shown"),
    (restarts_for_ever, "a_declared_program_that_fails_is_started_anew_but_not_for_ever"),
    (restarts_what_was_stopped, "a_declared_program_that_an_operator_stops_stays_stopped"),
    (restarts_after_every_end, "an_end_of_a_declared_program_is_an_end_where_its_rule_says_so"),
    (gives_its_primacy_up_for_the_pause, "a_robot_lost_in_the_pause_before_a_start_is_replaced"),
    (resumes_what_has_ended, "a_program_that_crashes_right_after_its_start_resumes_nothing_older"),
    (tireless_giver, "a_chain_that_is_not_taken_is_offered_again_after_a_pause"),
    (drained_all_the_same, "a_drained_robot_gives_away_what_it_runs_and_takes_nothing"),
    (drained_all_the_same, "a_drained_robot_is_the_last_to_take_a_component_over"),
    (forgets_that_it_is_drained, "a_drained_robot_gives_away_what_it_runs_and_takes_nothing"),
    (lease_beyond_the_promise, "an_agent_that_does_not_come_back_is_replaced_after_the_grace"),
    (breaks_its_promise, "an_agent_that_does_not_come_back_is_replaced_after_the_grace"),
    (forgets_its_promise, "peers_that_restart_keep_their_promise"),
    (promise_of_a_minority, "a_promise_of_a_minority_lets_nothing_act"),
    (leaves_while_its_peer_is_away, "two_agents_restart_one_after_the_other"),
    (leaves_without_a_word, "the_peer_of_a_program_that_chose_safety_restarts"),
    (freezes_what_ran_on, "an_agent_restarts_as_announced_and_nothing_moves"),
    (waits_though_it_is_back, "a_robot_that_is_lost_soon_after_its_restart_is_replaced_at_once"),
    (waits_for_every_restart, "an_agent_that_restarts_and_runs_nothing_delays_no_takeover"),
    (back_too_soon, "an_agent_that_is_back_and_not_heard_by_all_is_waited_for"),
)
"""Mistakes that a pair survives, or that cost no promise but the peace: each spoils a scenario."""


MUTANTS: tuple[Mutant, ...] = (
    impatient_standby,
    lease_from_the_answer,
    forgetful_vote_record,
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
    takes_the_unreadable_for_silence,
    waits_for_ever,
    waits_where_it_may_not_run,
)


ELECTIVE_MUTANTS: tuple[Mutant, ...] = (
    double_voting,
    no_margin,
    impatient_standby,
    lease_from_the_answer,
    forgetful_vote_record,
    forgotten_votes,
    disloyal_voter,
    minority_rules,
    anybody_may_have_it,
    named_in_advance,
    best_lease_counts,
    lease_from_strangers,
    deafness_at_once,
    votes_with_a_copy,
    generous_lease,
    proud_primary,
    claims_for_ever,
    oldest_checkpoint,
    same_epoch_again,
    runs_the_finished,
    shown_when_accepted,
)
"""Mistakes that lives of voting teams catch."""


PAIRS, VOTES, AS_THE_SEED_SAYS, LONG_LIFE = True, False, 0, 150

CAUGHT_BY: dict[tuple[str, bool], tuple[int, int]] = {
    ("everybody_yields", PAIRS): (AS_THE_SEED_SAYS, 35),
    ("nobody_needs_the_right", PAIRS): (AS_THE_SEED_SAYS, 53),
    ("takes_the_unreadable_for_silence", PAIRS): (LONG_LIFE, 0),
    ("double_voting", VOTES): (AS_THE_SEED_SAYS, 22),
    ("no_margin", VOTES): (AS_THE_SEED_SAYS, 435),
    ("disloyal_voter", VOTES): (AS_THE_SEED_SAYS, 26),
    ("anybody_may_have_it", VOTES): (AS_THE_SEED_SAYS, 89),
    ("named_in_advance", VOTES): (LONG_LIFE, 37),
    ("best_lease_counts", VOTES): (AS_THE_SEED_SAYS, 32),
    ("lease_from_strangers", VOTES): (AS_THE_SEED_SAYS, 52),
    ("votes_with_a_copy", VOTES): (AS_THE_SEED_SAYS, 22),
    ("generous_lease", VOTES): (AS_THE_SEED_SAYS, 57),
    ("claims_for_ever", VOTES): (AS_THE_SEED_SAYS, 15),
    ("runs_the_finished", VOTES): (AS_THE_SEED_SAYS, 52),
    ("shown_when_accepted", VOTES): (LONG_LIFE, 17),
}
"""Of a mistake that the first seeds do not catch, in pairs or voting teams: faults of a life, and the seed that caught it last.

That seed is tried first. Any change of the rules can turn a life around, so the other seeds are tried after it.
"""


@contextmanager
def mistaken(mutant: Mutant) -> Iterator[None]:
    """The rules with this mistake in them, for the body."""
    patches = mutant()
    with ExitStack() as stack:
        for one in patches if isinstance(patches, tuple) else (patches,):
            stack.enter_context(one)
        yield
