"""The table of ``failover top``: robots, their components, the tasks of those. Pure: values in, lines out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, Literal

from msgspec import Struct

from failover.cli.output.board_tree import span
from failover.cli.output.task_tree import Component, Robot
from failover.cli.output.team_tree import (
    Mood,
    links_of,
    microseconds,
    milliseconds,
    mood_of,
    mood_of_robot,
    size,
    standby_of,
    state_of,
)
from failover.client.health import is_unwell
from failover.schedule.overview import Seen

COLUMNS: Final = ("", "state", "age", "standby, link", "epoch", "freeze", "cpu", "memory", "misses")
"""The most wanted first: a narrow terminal shows these, and the rest by moving to the right."""

Order = Literal["name", "trouble", "age", "freeze", "cpu", "memory"]
ORDERS: Final[tuple[Order, ...]] = ("name", "trouble", "age", "freeze", "cpu", "memory")


class Line(Struct, frozen=True):
    """One line. ``component``: its whole name, and of a task the name of the component that runs it; "" of a robot."""

    key: str
    cells: tuple[str, ...]
    mood: Mood
    component: str = ""


def lines(robots: Sequence[Robot], status: Mapping[str, Any] | None, order: Order = "name", wanted: str = "") -> list[Line]:
    """All that fits the words of a filter, each robot with what runs there in this order.

    Args:
        status: see `failover.client.control.STATUS`, which says more of robots; None: no agent answers.
        wanted: part of a name or a state; a robot stays while something of it fits.
    """
    peers = {peer["name"]: peer for peer in status["peers"]} if status is not None else {}
    found: list[Line] = []
    for robot in robots:
        head = _robot_line(robot, peers.get(robot.name))
        below = [line for one in sorted(robot.components, key=_KEYS[order]) for line in _component_lines(one, robot.name)]
        fitting = [line for line in below if _fits(line, wanted)]
        if fitting or _fits(head, wanted):
            found += [head, *(fitting if wanted and not _fits(head, wanted) else below)]
    return found


def _fits(line: Line, wanted: str) -> bool:
    return not wanted or wanted.lower() in " ".join((line.key, *line.cells[:2])).lower()


def _robot_line(robot: Robot, peer: Mapping[str, Any] | None) -> Line:
    if peer is None:
        return Line(f"robot {robot.name}", _cells(f"{robot.name} (here)", robot.state), "good")
    heard = milliseconds(peer.get("last_heard_ms"))
    cells = _cells(robot.name, robot.state, heard, links_of(peer))
    return Line(f"robot {robot.name}", cells, mood_of_robot(robot.state))


def _component_lines(component: Component, robot: str) -> Iterator[Line]:
    view, use = component.view, component.use
    short = component.name.partition(f"/{robot}/")[2] or component.name
    if view:
        freeze = microseconds(view.get("freeze_us")) if view.get("engine") != "cooperative" else "never"
        used = (f"{use.cpu:.0%}", size(use.memory)) if use is not None else ("", "")
        first = (f"  {short}", state_of(view), milliseconds(view.get("lag_ms")), standby_of(view))
        cells = _cells(*first, str(view.get("epoch") or ""), freeze, *used)
        yield Line(f"component {component.name}", cells, mood_of(view), component.name)
    else:
        yield Line(f"others {robot}", _cells(f"  {component.name}"), "quiet")
    for task in component.tasks:
        yield _task_line(task, component.name if view else "")


def _task_line(task: Seen, component: str) -> Line:
    late = f"{span(task.past_deadline_ns)} past its deadline"
    mood: Mood = "bad" if task.past_deadline_ns else "warning" if task.misses or task.state == "idle" else "good"
    every = f"every {span(task.period_ns)}" if task.period_ns else task.kind
    state = f"{task.state}, {late}" if task.past_deadline_ns else task.state
    cells = _cells(f"    {task.task}", state, "", every, misses=str(task.misses))
    return Line(f"task {task.task}", cells, mood, component)


def _cells(*first: str, misses: str = "") -> tuple[str, ...]:
    return (*first, *[""] * (len(COLUMNS) - len(first) - 1), misses)


_KEYS: Final[dict[Order, Callable[[Component], Any]]] = {
    "name": lambda one: one.name,
    "trouble": lambda one: (not (one.view and is_unwell(one.view)), one.name),
    "age": lambda one: (-(one.view.get("lag_ms") or 0), one.name),
    "freeze": lambda one: (-(one.view.get("freeze_us") or 0), one.name),
    "cpu": lambda one: (-one.use.cpu if one.use else 0, one.name),
    "memory": lambda one: (-one.use.memory if one.use else 0, one.name),
}
"""The largest first, of all but names."""
