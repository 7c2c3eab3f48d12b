"""Elects a component's primary under the rule ``majority``: the state arrows of `failover.core.election.pair`, drawn by votes.

`failover.core.election.majority` says which member is free and for which robot; this module claims, withdraws, follows, and
answers rivals.
"""

from __future__ import annotations

from checkpoint.model import Position
from failover.core.component import Cause, Component, Turn
from failover.core.election import majority
from failover.core.election.consent import state_of
from failover.core.election.pair import (
    accept,
    begin,
    claim,
    clear_away,
    drop,
    first_of_equals,
    follow,
    heard_end,
    living_entries,
    lose,
    may_start_afresh,
    refuse_request,
    renew,
    stronger,
    vacant,
)
from failover.core.replication import archived
from failover.core.types import ENDED, HOLDING, MS, State
from failover.core.wire.messages import ORDERED, Entry
from failover.core.wire.names import weight

WITHDRAWN_BEATS = 2
"""Beats for each place in the order of names that a robot waits after a claim in vain: the next one finds no rival."""


EQUALS_WAIT = 2
"""Loyalties that the first in that order leaves a component, which it could run as well, to another robot."""


def consider(component: Component, turn: Turn) -> None:
    """Claim the component if it is vacant, a majority would agree, and this robot is the one to run it."""
    if component.state not in (State.ABSENT, State.STANDBY) or turn.now_ns < component.retry_ns:
        return
    if component.is_exhausted or component.unable or not turn.config.runs(turn.me) or not vacant(component, turn):
        return
    mine = component.newest
    if archived.waits(component, turn):
        return
    if _chosen(component, turn, mine) and majority.may_claim(component, turn, mine):
        claim(component, turn, mine, "no robot runs it, and a majority is free to vote")


def _chosen(component: Component, turn: Turn, mine: Position | None) -> bool:
    entries = [one for one in living_entries(component, turn) if state_of(one[1]) not in HOLDING]
    if mine is None:
        first = all(_starts_before(component, turn.me, robot) for robot in majority.starters(component, turn))
        is_nowhere = _newest_of(entries) is None and not _is_untold(component, turn)
        return is_nowhere and first and may_start_afresh(component, turn)
    best = _newest_of([one for one in entries if turn.config.runs(one[0])])
    if (best is not None and mine < best) or _waits_for_a_server(component, turn, mine, _newest_of(entries)):
        return False
    if component.waits:
        return component.primary == turn.me
    return first_of_equals(component, turn, entries, mine) or _equals_differ(component, turn)


def _equals_differ(component: Component, turn: Turn) -> bool:
    """Whether equals leave it to each other: one whose copy came from the archive may not know whom the others prefer."""
    return component.freed_ns > 0 and turn.now_ns >= component.freed_ns + (EQUALS_WAIT + _place(turn)) * turn.config.loyalty_ns


def _newest_of(entries: list[tuple[str, Entry]]) -> Position | None:
    return max((position for _, entry in entries if (position := entry.position)), default=None)


def _is_untold(component: Component, turn: Turn) -> bool:
    """Whether a server that lives has not told its checkpoint of the component yet."""
    return any(
        peer.entry(component.name) is None and not peer.complete
        for peer in turn.team.living(turn.now_ns)
        if peer.robot in turn.config.servers
    )


def _waits_for_a_server(component: Component, turn: Turn, mine: Position, best: Position | None) -> bool:
    """Whether to wait for a server's newer checkpoint: a standby has all that it can have, and no robot waits for ever.

    A robot that has lost what it held, and has but an older copy, waits for silent ones, too.
    """
    if archived.may_be_outdated(component, turn):
        return True
    is_behind = (best is not None and mine < best) or _is_untold(component, turn)
    if not is_behind or (turn.me in component.entrusted and not component.bare):
        component.behind_ns = 0
        return False
    component.behind_ns = component.behind_ns or turn.now_ns
    limit_ms = max(turn.config.ship_ms, turn.config.patience_ms) if component.bare else turn.config.ship_ms
    return turn.now_ns < component.behind_ns + limit_ms * MS


def _starts_before(component: Component, one: str, other: str) -> bool:
    prefer = component.rules.prefer
    return (one != prefer, weight(one)) < (other != prefer, weight(other))


def advance(component: Component, turn: Turn) -> None:
    """A claim: go on once a majority has voted for it; withdraw it when that takes too long."""
    if majority.won(component, turn):
        _entrust_equal(component, turn)
        begin(component, turn)
    elif turn.now_ns >= component.until_ns:
        withdraw(component, turn, "a majority did not vote for it")


def _entrust_equal(component: Component, turn: Turn) -> None:
    """A robot that holds the very checkpoint to be resumed from may use it should this one die before the next."""
    for robot, entry in living_entries(component, turn):
        equal = entry.position is not None and entry.position == component.plan
        if equal and (entry.epoch, entry.primary) == (component.epoch, turn.me) and turn.config.runs(robot):
            component.standby, component.entrusted = robot, (robot,)
            return


def withdraw(component: Component, turn: Turn, why: str) -> None:
    """Give a claim up; our vote for ourselves in its epoch stands, and helps no robot."""
    component.move(Cause.YIELD_CLAIM)
    component.ordered = False
    component.retry_ns = turn.now_ns + _place(turn) * WITHDRAWN_BEATS * turn.config.beat_ns
    refuse_request(component, turn, f"cannot run {component.name}: {why}; failover status tells which robots {turn.me} hears")
    turn.say(component, f"{turn.me} withdraws its claim of epoch {component.epoch}: {why}")


def _place(turn: Turn) -> int:
    """This robot's in the order of names, from 1 on."""
    return sorted((turn.me, *turn.config.peers), key=weight).index(turn.me) + 1


def step_down(component: Component, turn: Turn) -> None:
    """A primary that has given way and was not relieved clears its copy away; its checkpoint is claimed anew."""
    component.handing = component.flight = None
    clear_away(component, turn, component.epoch)
    turn.say(component, f"{turn.me} gives its copy up: the component that it handed over is claimed anew")


# Hearing


def heard(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """Take in another member's word about this component."""
    theirs = state_of(entry)
    component.seen = max(component.seen, entry.epoch)
    if theirs in HOLDING and component.holding:
        _heard_rival(component, turn, sender, entry, theirs)
    elif theirs in HOLDING:
        _heard_holder(component, turn, sender, entry)
    elif theirs in ENDED and entry.epoch >= component.epoch:
        _heard_end(component, turn, sender, entry, theirs)
    elif entry.epoch > component.epoch:
        _heard_later_epoch(component, turn, sender, entry)
    elif entry.epoch == component.epoch:
        _heard_spent_vote(component, turn, entry)


def _heard_holder(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    if entry.epoch < component.epoch or (component.state in ENDED and entry.epoch == component.epoch):
        return
    if (entry.epoch, sender) == (component.epoch, component.primary):
        component.entrusted = (entry.standby,) if entry.standby else ()
    elif majority.may_follow(component, turn, sender, entry):
        _accept_word(component, turn, sender, entry)
    else:
        return
    follow(component, turn, sender, entry)


def _heard_rival(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> None:
    later = entry.epoch > component.epoch
    handing = component.handing
    if later and handing is not None and handing.yielded and handing.to == sender:
        lose(component, turn, sender, entry)
    elif component.state is State.CLAIMING:
        if stronger(component, turn, sender, entry, theirs):
            withdraw(component, turn, f"{sender} holds or claims epoch {entry.epoch}")
            _heard_holder(component, turn, sender, entry)
    elif majority.leased(component, turn):
        if later and component.is_settled:
            renew(component, turn, entry.epoch)
    elif _prevails(component, turn, sender, entry):
        lose(component, turn, sender, entry)
    elif theirs is not State.CLAIMING and component.is_settled:
        _contend(component, turn, sender, entry, theirs)


def _prevails(component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
    """Whether a rival was elected while we have no lease, or loses nothing that was acknowledged if we follow it.

    A later epoch alone says little: a robot that comes back with an old copy raises its epoch above all that it hears of.
    """
    if entry.epoch >= component.epoch and majority.elected(component, turn, sender, entry.epoch):
        return True
    if entry.epoch <= component.epoch:
        return False
    return bool(entry.flags & ORDERED) or not component.held or majority.eligible(component, turn, sender, entry.position)


def _contend(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> None:
    """Two copies stand still, neither was elected: go above the other's epoch, once a loyalty, so that voters are heard first."""
    if entry.epoch < component.epoch or (entry.epoch == component.epoch and stronger(component, turn, sender, entry, theirs)):
        return
    waited_ns = turn.now_ns - component.contested_ns
    if waited_ns >= turn.config.loyalty_ns:
        component.contested_ns = turn.now_ns
        if waited_ns < 2 * turn.config.loyalty_ns:
            renew(component, turn, entry.epoch)


def _heard_end(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> None:
    """A copy that acts, or stands still, gives up to an end as it would to the copy that ended: never to a word alone.

    A voter does not leave its primary for one either: else one stolen key ends what a healthy robot runs. A claim of the epoch in
    which it has ended is in vain.
    """
    if not component.holding or component.state is State.CLAIMING:
        if majority.may_record_end(component, turn, entry):
            if component.state is State.CLAIMING and entry.epoch == component.epoch:
                withdraw(component, turn, f"it is {theirs} in that epoch, as {sender} says")
            heard_end(component, turn, sender, entry, theirs)
    elif entry.epoch > component.epoch and majority.leased(component, turn):
        if component.is_settled and turn.config.runs(sender):
            renew(component, turn, entry.epoch)
    elif _is_decided(component, turn, sender, entry) or (sender == entry.primary and _prevails(component, turn, sender, entry)):
        lose(component, turn, entry.primary, entry)


def _is_decided(component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
    elsewhere = entry.primary not in ("", turn.me)
    implied = sender == turn.config.coordinator and _has_an_untold_vote(component, turn, entry)
    return elsewhere and entry.epoch > component.epoch and majority.elected(component, turn, entry.primary, entry.epoch, implied)


def _has_an_untold_vote(component: Component, turn: Turn, seat: Entry) -> bool:
    """Whether etcd's word tells of one vote more: the robot that has its seat asked for it, and is not heard here."""
    peer = turn.team.peers.get(seat.primary)
    if state_of(seat) in ENDED or peer is None or turn.alive(seat.primary):
        return False
    told = peer.entry(component.name)  # its last word counts among those that are told
    return told is None or (told.epoch, told.primary) != (seat.epoch, seat.primary)


def _heard_later_epoch(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """A member that does not hold it knows a later epoch than ours."""
    decided = _is_decided(component, turn, sender, entry)
    if component.state is State.CLAIMING:
        if turn.config.runs(sender):
            withdraw(component, turn, f"epoch {entry.epoch} is known already")
    elif component.is_settled and (majority.leased(component, turn) or not decided):
        if turn.config.runs(sender) or _needs_the_vote(component, turn):
            renew(component, turn, entry.epoch)
    elif component.holding and decided and not majority.leased(component, turn):
        lose(component, turn, entry.primary, entry)
    elif not component.holding and (decided or (not component.primary and turn.team.rested(turn.now_ns))):
        _adopt(component, turn, entry)


def _heard_spent_vote(component: Component, turn: Turn, entry: Entry) -> None:
    """The member has voted in our own epoch for another robot, whose claim came to nothing: a later one may have its vote."""
    claimant = turn.team.peers.get(entry.primary)
    if claimant is None or not component.is_settled:
        return
    told = claimant.entry(component.name)
    if turn.alive(entry.primary) and told is not None and state_of(told) in HOLDING:
        return
    if _needs_the_vote(component, turn):
        renew(component, turn, entry.epoch)


def _needs_the_vote(component: Component, turn: Turn) -> bool:
    """A server or a witness that knows a later epoch can agree to a later one only: where it must, but not again and again."""
    if majority.leased(component, turn) or turn.now_ns < component.contested_ns + turn.config.retry_ms * MS:
        return False
    component.contested_ns = turn.now_ns
    return True


def _adopt(component: Component, turn: Turn, entry: Entry) -> None:
    had_ended = component.state in ENDED
    if had_ended:
        drop(component, turn, "it runs anew")
    _accept_word(component, turn, entry.primary, entry)
    if had_ended:
        clear_away(component, turn, component.epoch)  # a copy that ended here, and whose end was not agreed, may be left
    elif component.state is State.ABSENT:
        component.move(Cause.FOLLOW)


def _accept_word(component: Component, turn: Turn, primary: str, entry: Entry) -> None:
    """Vote for that primary, and note the robot that it has entrusted, as the entry says."""
    archived.void(component)
    is_news = component.epoch == 0
    accept(component, turn, primary, entry.epoch)
    component.entrusted = (entry.standby,) if entry.standby else ()
    if is_news:
        archived.recall(component, turn)
