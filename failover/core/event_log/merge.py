"""Merges the event logs of several robots into one, in the order in which things happened.

No two robots' clocks agree, so certain knowledge comes first: a robot's own lines are in order, and a robot that had heard a
heartbeat sent after some decision decided later than that. Where neither is known, the instants decide, as well as they can be
read on one common clock. Where those are too close to tell, the lower epoch comes first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec import Struct

from failover.core.event_log.decisions import Line


class Timed(Struct, frozen=True):
    """A line, and when it was by the clock of the robot that kept it; that may be wrong by ``doubt_ns`` either way."""

    line: Line
    at_ns: int
    doubt_ns: int = 0


def precedes(first: Line, later: Line) -> bool:
    """Whether it is certain, by no clock, that one line came before the other."""
    if first.robot == later.robot:
        return (first.life, first.number) < (later.life, later.number)
    heard = (one for one in later.decision.facts.seen if one.robot == first.robot and one.boot)
    return any((one.boot, one.counter) >= (first.life, first.decision.facts.counter) for one in heard)


def merged(logs: Mapping[str, Sequence[Timed]]) -> list[Timed]:
    """All lines in one order. Each robot's own must be in order already."""
    waiting = {robot: list(reversed(log)) for robot, log in logs.items() if log}
    told: list[Timed] = []
    while waiting:
        robot = _next(waiting)
        told.append(waiting[robot].pop())
        if not waiting[robot]:
            del waiting[robot]
    return told


def _next(waiting: Mapping[str, Sequence[Timed]]) -> str:
    """The robot whose first line that is left comes next."""
    heads = {robot: log[-1] for robot, log in waiting.items()}
    free = {robot: head for robot, head in heads.items() if not _is_preceded(head, heads)} or heads  # a circle: clocks alone
    earliest = min(free, key=lambda robot: (free[robot].at_ns, robot))
    same = [robot for robot, head in free.items() if _cannot_tell(head, free[earliest])]
    return min(same, key=lambda robot: (free[robot].line.decision.facts.epoch, free[robot].at_ns, robot))


def _is_preceded(line: Timed, heads: Mapping[str, Timed]) -> bool:
    """A robot's later lines cannot come before this one where its first does not."""
    return any(precedes(head.line, line.line) for head in heads.values() if head is not line)


def _cannot_tell(one: Timed, other: Timed) -> bool:
    same_component = one.line.decision.component == other.line.decision.component
    return one is other or (same_component and abs(one.at_ns - other.at_ns) <= one.doubt_ns + other.doubt_ns)
