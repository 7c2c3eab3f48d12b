"""Components that an operator recovered at another site (``failover-agent recover``): one site runs each, by that order.

Sites hear no heartbeats of each other, and no vote of one counts at another. A person alone decides that a site is lost. So the
order opens a *span* of epochs of its own: the first epoch of the next span, above all that the lost site can have claimed. Robots
tell each other over the replication link which components were recovered at their site. Invariants:

* The later span stays. A robot that hears of one gives its copy up, keeps its state aside, and names the robot of the other site
  as the primary. While that is on record, no robot claims the component, and no order but ``recover`` brings it back.
* Two sites in the same span, for two persons recovered it: the site whose name sorts first opens the next span while it runs it,
  and so the other one gives its copy up. Both can tell by the names alone, without a clock and without an answer.
* A robot that has just started claims nothing before each other site has told what was recovered there, or ``boot_patience_ms``
  are over: its site may be the one that was lost. Nor does it begin anew what agent.toml declares: its disk may be a new one.
* The word comes from the other site itself. What a robot of this site says of it counts for nothing: one stolen key would end
  what runs.
"""

from __future__ import annotations

from failover.core.component import Cause, Component, Turn
from failover.core.election.pair import accept, admit, lose, renew
from failover.core.events import Recovered
from failover.core.peer_claims import epoch_max
from failover.core.types import ENDED, MS, SPAN, State
from failover.core.wire.messages import Entry

CURE = "to bring it back: failover-agent recover {} at a robot of this site, while its agent is stopped"


def recovered(component: Component, turn: Turn, event: Recovered) -> bool:
    """A robot of another site runs it there, or did, by the order of an operator. Returns whether that is news.

    What is said again changes nothing; nor does an epoch that nobody can have opened yet.
    """
    span = event.epoch // SPAN
    if event.robot not in turn.config.far or event.epoch > epoch_max(component, turn) or span < max(component.span, 1):
        return False
    if span == component.span:
        return (_contend if is_ours(component, turn) else _moved_there)(component, turn, event)
    turn.say(component, f"an operator recovered it at {event.robot}, of another site, in epoch {event.epoch}")
    if component.holding:
        lose(component, turn, event.robot, Entry(component.name, 0, event.epoch, event.robot))
    else:
        accept(component, turn, event.robot, event.epoch)
        if component.state is State.ABSENT or component.state in ENDED:
            component.move(Cause.FOLLOW)
    component.elsewhere = span
    admit(component, turn, "")
    return True


def _moved_there(component: Component, turn: Turn, event: Recovered) -> bool:
    """The same recovery: another robot of that site runs it, or this record names one that has left the team."""
    is_theirs = component.elsewhere != -component.span  # else begun anew here, after a release
    is_news = event.epoch > component.epoch or not component.is_elsewhere or component.primary not in turn.config.far
    if not (is_theirs and is_news) or component.holding or component.state in ENDED:
        return False
    component.epoch, component.primary = max(component.epoch, event.epoch), event.robot
    component.elsewhere = component.span
    return True


def _contend(component: Component, turn: Turn, event: Recovered) -> bool:
    rival, span = component.contender
    if span == component.span and turn.config.far.get(rival) == turn.config.far[event.robot]:
        return False
    component.contender = event.robot, component.span
    turn.say(component, contention(component, turn))
    return True


def contention(component: Component, turn: Turn) -> str:
    """That operators recovered it at two sites, and which one goes on; "" if they did not."""
    rival, span = component.contender
    site = turn.config.far.get(rival)
    if site is None or span != component.span:
        return ""
    first = turn.me if turn.config.site < site else rival
    return (
        f"operators recovered it here and at {rival}, of another site: two copies may act; the site of {first}, whose name sorts "
        f"first, goes on"
    )


def settle(component: Component, turn: Turn) -> None:
    """The copy here goes on above that of a site whose name sorts after ours; a capture under way is waited for."""
    rival, span = component.contender
    if span == component.span > 0 and component.is_settled and turn.config.site < turn.config.far.get(rival, ""):
        renew(component, turn, (span + 1) * SPAN)


def is_ours(component: Component, turn: Turn) -> bool:
    """Whether an operator recovered it at this site, as far as is known here; what began anew after a release is another one."""
    return component.span > 0 and abs(component.elsewhere) != component.span and _is_near(component.primary, turn)


def is_hearsay(component: Component | None, turn: Turn, entry: Entry) -> bool:
    """Whether a member of this site speaks of another one, which tells by itself; also by a robot that has left the team."""
    is_same = component is not None and component.is_elsewhere and entry.epoch // SPAN == component.span
    return entry.primary in turn.config.far or (is_same and not _is_near(entry.primary, turn))


def _is_near(primary: str, turn: Turn) -> bool:
    return primary in ("", turn.me, *turn.config.peers)


def waits_ns(component: Component, turn: Turn) -> int:
    """For how long this robot waits still for the word of the other sites before it claims the component; 0: not any more.

    What an operator has just recovered here waits for nobody: no robot of it is on record yet.
    """
    is_recovered = component.epoch > 0 and not component.primary
    if not turn.config.far or turn.team.sites_heard or is_recovered:
        return 0
    return max(turn.config.boot_patience_ms * MS - turn.team.lived_ns(turn.now_ns), 0)
