"""The promise that holds now, in one sentence: for the team as one robot sees it, and for each component.

``failover status`` shows the team's, and a component's where it differs from the team's; the journal has both at each change.
``tests/simulation/test_promises.py`` holds every sentence against what the rules do.
"""

from __future__ import annotations

from failover.core.component import Component, Turn
from failover.core.replication import archived
from failover.core.types import ENDED, MS, Protection
from failover.core.wire.messages import OTHER_SITES


def grounds(turn: Turn) -> tuple[tuple[str, ...], ...]:
    """The grounds of `team` that time changes: the peers that have another rule, or know other sites, and all that are heard."""
    living = turn.team.living(turn.now_ns)
    differ = tuple(peer.robot for peer in living if peer.at_odds not in (0, OTHER_SITES))
    elsewhere = tuple(peer.robot for peer in living if peer.at_odds == OTHER_SITES)
    return differ, elsewhere, tuple(peer.robot for peer in living)


ETCD_DELAY_S = 2
"""A lease at etcd lasts for whole seconds, and etcd looks twice a second which ones are over."""


def team(turn: Turn) -> str:
    """The promise of the rule in force, given the robots that are heard."""
    at_odds, elsewhere, living = grounds(turn)
    if elsewhere:
        return (
            f"{turn.me} and {' and '.join(elsewhere)} know other sites of the members: between them they start, take over, move "
            "and protect nothing until all have the same team.toml."
        )
    if at_odds:
        return (
            f"{turn.me} decides by rule = {turn.config.rule}, {' and '.join(at_odds)} by another: between them they start, "
            "take over, move and protect nothing until all have the same rule in agent.toml."
        )
    if turn.config.coordinator:
        return _coordinated(turn, living)
    if not turn.team.peers:
        return f"{turn.me} is alone in its team: a lost robot takes its programs with it."
    if turn.config.by_majority:
        return _elected(turn, 1 + len(living))
    if not living:
        return f"{turn.me} hears no other robot: its programs are not protected."
    return (
        f"{turn.me} and {', '.join(living)} protect each other: a robot that is silent for {_silence(turn)} is replaced; "
        "after a total cut two live robots can both run a component until they hear each other, "
        "and then the copy that never stopped continues; when_alone = freeze prevents that."
    )


def _elected(turn: Turn, heard: int) -> str:
    voters, quorum = len(turn.team.peers) + 1, turn.config.quorum
    if heard < quorum:
        return (
            f"{turn.me} hears {heard} of {voters} that vote, itself among them, and {quorum} are a majority: its programs "
            "stand still, and it takes nothing over, until it hears more."
        )
    return (
        f"{turn.me} hears {heard} of {voters} that vote, itself among them, and {quorum} are a majority: no component acts at "
        f"two robots at once; a robot that is silent for {_silence(turn)} is replaced when a majority agrees."
    )


def _coordinated(turn: Turn, living: tuple[str, ...]) -> str:
    """The promise where etcd has a vote: what it adds, or what is lost while it does not answer."""
    robots, quorum = [robot for robot in living if robot != turn.config.coordinator], turn.config.quorum
    others, heard = len(turn.config.peers) - 1, 1 + len(robots)
    hears = f"{turn.me} hears {len(robots)} of {others} other members"
    if turn.config.coordinator in living and 1 + len(living) >= quorum:
        after_s = turn.config.loyalty_ns / (1_000 * MS)
        return (
            f"{hears} and reaches etcd; {quorum} of {len(turn.config.peers) + 1} votes decide, one of them etcd's: no component "
            f"acts at two robots at once; a robot that is silent is replaced after {after_s:.1f} s to "
            f"{after_s + ETCD_DELAY_S:.1f} s."
        )
    if turn.config.coordinator in living:
        return f"{hears} and reaches etcd, and {quorum} votes decide: its programs stand still until it hears more."
    if heard < quorum:
        return f"{hears} and does not reach etcd, and {quorum} votes decide: its programs stand still until it hears more."
    lost = (
        "a lost robot is replaced all the same" if heard > quorum else "nobody is taken over, and who is left alone stands still"
    )
    return f"{hears} and does not reach etcd: programs run on while the members hear each other; {lost}, until etcd is back."


def one(component: Component, turn: Turn, protection: Protection) -> str:
    """The promise for a component if its robot is lost now."""
    if component.state in ENDED:
        return f"It is {component.state}; no robot runs it."
    if not component.holding:
        return _standing_by(component, turn)
    if component.unprotected:
        return f"If {turn.me} is lost now, so is its state: no robot keeps a checkpoint of it."
    if protection is not Protection.PROTECTED:
        return "If this robot is lost now, the component resumes from its last checkpoint, if there is one."
    if archived.is_alone(component, turn):
        if component.waits:
            return f"If {turn.me} is lost, its newest copy in the archive waits until {turn.me} is back: no other one resumes it."
        return (
            f"If {turn.me} is silent and etcd votes for another robot, that one resumes it from its newest copy in the archive; "
            "the work since then is lost; it stands still here first."
        )
    if component.waits:
        return f"If {turn.me} is lost, {component.standby} keeps its newest checkpoint until {turn.me} is back."
    if not turn.config.runs(component.standby):
        return f"If {turn.me} is lost, {component.standby} gives its newest checkpoint to the first robot that can run it."
    if component.elects:
        return (
            f"If {turn.me} is silent for {_silence(turn)} and a majority agrees, {component.standby} runs it; "
            "it stands still here first."
        )
    twice = "may run twice if both live on and cannot hear each other; then the copy that never stopped continues"
    alone = "stands still here first" if component.freezes else twice
    return f"If {turn.me} is silent for {_silence(turn)}, {component.standby} runs it; it {alone}."


def differs(component: Component, turn: Turn) -> bool:
    """Whether a component's own settings, or its standby, promise something else than the team's sentence says."""
    if not component.holding:
        return False
    if component.unprotected or component.waits or (component.freezes and not component.elects):
        return True
    return bool(component.named) and not turn.config.runs(component.named)


def exception(component: Component, turn: Turn) -> str:
    """For the journal: the component's promise where it differs and a robot stands by already; "" otherwise."""
    if not differs(component, turn) or not (component.named or component.unprotected):
        return ""
    return one(component, turn, Protection.PROTECTED)


def _standing_by(component: Component, turn: Turn) -> str:
    whose = component.primary or "the robot that runs it"
    if not turn.config.keeps(turn.me):
        return f"{turn.me} votes for the robot that runs it, now {whose}."
    return f"{turn.me} keeps its checkpoints for {whose}."


def _silence(turn: Turn) -> str:
    return f"{turn.config.loyalty_ns // MS} ms (up to {turn.config.loyalty_ns_max // MS} where beats come late)"
