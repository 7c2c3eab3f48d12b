"""A team with one member more, one less, or another key of one: the next change of its team file."""

from __future__ import annotations

from dataclasses import replace

from failover.config.addresses import check_addresses
from failover.config.team import FORMER_LIMIT, ROBOT_LIMIT, Robot, Team, enrol
from failover.core.frames.roster import roster
from failover.core.team_changes import is_step_of_keys, seats
from failover.errors import TeamFileError


def joined(team: Team, name: str, member: Robot) -> Team:
    """The team with one member more.

    Raises:
        TeamFileError: it belongs to the team already, or its name, address or key cannot be right.
    """
    if name in team.robots:
        raise TeamFileError(f"{name} belongs to team {team.team} already; failover team remove {name} takes it out")
    check_addresses(name, member, team.robots)
    seated = _seated(team)
    return replace(enrol(seated, name, replace(member, seat=-1)), change=team.change + 1)


def left(team: Team, name: str, me: str) -> Team:
    """The team with one member less.

    Args:
        me: this robot, which cannot be the one.

    Raises:
        TeamFileError: there is no such member, or it is this robot.
    """
    if name not in team.robots:
        raise TeamFileError(f"{name} is no member of team {team.team}, which knows {', '.join(sorted(team.robots))}")
    if name == me:
        raise TeamFileError(f"{me} cannot take itself out of its team; give the command at another robot of the team")
    seated = _seated(team)
    robots = {other: robot for other, robot in seated.robots.items() if other != name}
    former = {other: robot for other, robot in seated.former.items() if other != name} | {name: seated.robots[name]}
    newest = dict(list(former.items())[-FORMER_LIMIT:])
    return replace(seated, robots=robots, change=team.change + 1, former=newest)


def with_next_key(team: Team, name: str, key: str) -> Team:
    """The team with a second key of a member beside the one that it has: both count.

    Raises:
        TeamFileError: it is no key, or another member has it.
    """
    return _with_keys(team, name, team.robots[name].public_key, key)


def with_one_key(team: Team, name: str, key: str) -> Team:
    """The team with this key of a member alone: from now on its other one is refused."""
    return _with_keys(team, name, key, "")


def _with_keys(team: Team, name: str, key: str, following: str) -> Team:
    seated = _seated(team)
    member = replace(seated.robots[name], public_key=key, next_key=following)
    return replace(enrol(seated, name, member), change=team.change + 1)


def is_rotation(before: Robot, after: Robot) -> bool:
    """Whether a member's entry differs by one step of its keys, and by nothing else (but a first seat)."""
    is_same = replace(before.keyless, seat=after.seat) == after.keyless and before.seat in (-1, after.seat)
    return is_same and is_step_of_keys((before.public_key, before.next_key), (after.public_key, after.next_key))


def _seated(team: Team) -> Team:
    """Each member with a seat: as long as members had none, their places were those of the order of names."""
    if all(robot.seat >= 0 for robot in team.robots.values()):
        return team if team.next_seat or not team.robots else replace(team, next_seat=_above(team))
    given = seats({name: robot.seat for name, robot in team.robots.items()}, roster(team.robots).names)
    seated = replace(team, robots={name: replace(robot, seat=given[name]) for name, robot in team.robots.items()})
    return replace(seated, next_seat=_above(seated))


def _above(team: Team) -> int:
    return (max(robot.seat for robot in team.robots.values()) + 1) % ROBOT_LIMIT
