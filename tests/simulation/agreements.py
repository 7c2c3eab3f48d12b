"""How long a team needs to agree on who shares the round: after a start of all, a crash, a join. One run, in virtual time."""

from __future__ import annotations

from random import Random
from typing import Final

from failover.core.frames.terms import Terms
from failover.core.types import MS
from tests.simulation.slotted import Robot, Team

COUNT: Final = 8
SETTLES_NS: Final = 600 * MS
"""Eight robots agree long before, as `start` shows."""

PATIENCE_NS: Final = 2_000 * MS


def start(seed: int) -> int:
    """Eight robots start at one instant; ns until all use the set of eight."""
    team = Team(seed, COUNT)
    team.on(*range(COUNT))
    return _agreed_after_ns(team)


def crash(seed: int) -> int:
    """One of eight loses its power at a random instant; ns until all others use the set of seven."""
    team = _settled(seed)
    team.off(team.random.randrange(COUNT))
    return _agreed_after_ns(team)


def join(seed: int) -> int:
    """One more robot, of a random rank, starts beside seven at a random instant; ns until all use the set of eight."""
    absent = Random(seed).randrange(COUNT)
    team = _settled(seed, absent)
    team.on(absent)
    return _agreed_after_ns(team)


def _settled(seed: int, absent: int | None = None) -> Team:
    """A team that agrees, at a random instant of its round."""
    team = Team(seed, COUNT)
    team.on(*(rank for rank in range(COUNT) if rank != absent))
    team.run(SETTLES_NS + round(team.random.random() * 2 * Terms().t_tup_ns))
    assert team.agreed()
    return team


def _agreed_after_ns(team: Team) -> int:
    """From now until all agree, for the first time."""
    began_ns = team.now_ns
    found: list[int] = []

    def look(_robot: Robot) -> None:
        if not found and team.agreed():
            found.append(team.now_ns - began_ns)

    team.watch = look
    while not found and team.now_ns < began_ns + PATIENCE_NS:
        team.run(team.now_ns + 10 * MS)
    return found[0] if found else PATIENCE_NS
