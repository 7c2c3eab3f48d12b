"""Robots, their components and the tasks of those as rows of a tree, for ``failover ps``. Pure: values in, rows out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

from msgspec import Struct
from msgspec.structs import asdict

from failover.cli.output.board_tree import ms, span
from failover.cli.output.team_tree import Mood, Row, mood_of, mood_of_robot, size, state_of
from failover.client.health import sight
from failover.client.process_use import Use
from failover.schedule.overview import Seen

COLUMNS: Final = (
    *("", "state", "cpu", "memory", "period", "phase", "misses"),
    *("late p50", "p99", "took p50", "p99", "overruns", "after"),
)
NARROWER: Final = (0, 1, 4, 5, 6, 7, 8, 12)
"""Of these, those that stand in a table of fewer columns than"""
WHOLE_WIDTH: Final = 140

OTHERS: Final = "other programs"
"""Those of this robot that are no components, or whose processes this user may not look at."""
T = TypeVar("T")

NO_USES: Final[Mapping[str, Use | None]] = {}
UNWELL: Final = frozenset({"failed", "restarting"})


class Component(Struct, frozen=True):
    """One component and what its program runs.

    Attributes:
        view: of the status; empty for `OTHERS`.
        use: of its processes; None where this machine does not tell.
    """

    name: str
    view: Mapping[str, Any]
    tasks: tuple[Seen, ...]
    use: Use | None = None


class Robot(Struct, frozen=True):
    """``state``: live, suspect, dead or unknown; "" where no agent says so. The tasks of other robots are not known here."""

    name: str
    state: str
    components: tuple[Component, ...]


def robots(
    here: str,
    seen: Sequence[Seen],
    status: Mapping[str, Any] | None,
    owners: Mapping[str, str],
    uses: Mapping[str, Use | None] = NO_USES,
) -> tuple[Robot, ...]:
    """This robot first.

    Args:
        here: the robot of the schedule.
        seen: all its tasks, in the order in which they are shown.
        status: see `failover.client.control.STATUS`; None: no agent answers.
        owners: task → component.
        uses: component of this robot → what its processes use.
    """
    if status is None:
        return (Robot(here, "", (Component(OTHERS, {}, tuple(seen)),)),)
    views = sorted((one for one in map(sight, status["components"]) if one.get("state") != "released"), key=_name)
    placed = {_name(view) for view in views if view.get("primary") == status["robot"]}
    others = Component(OTHERS, {}, tuple(one for one in seen if owners.get(one.task) not in placed))
    found = []
    for name, state in [(str(status["robot"]), "live"), *((str(peer["name"]), str(peer["state"])) for peer in status["peers"])]:
        own = [
            Component(
                _name(view),
                view,
                tuple(one for one in seen if name == status["robot"] and owners.get(one.task) == _name(view)),
                uses.get(_name(view)) if name == status["robot"] else None,
            )
            for view in views
            if view.get("primary") == name
        ]
        is_here = name == status["robot"]
        found.append(Robot(name, state, (*own, others) if is_here and others.tasks else tuple(own)))
    return tuple(found)


def fitting(tree: Sequence[Robot], width: int) -> tuple[tuple[str, ...], list[Row]]:
    """Columns and rows for a terminal of this width; one that is too narrow for those, too, gets them as a list."""
    kept = range(len(COLUMNS)) if width >= WHOLE_WIDTH else NARROWER
    narrowed = [Row(tuple(row.cells[place] for place in kept), row.mood) for row in rows(tree)]
    return tuple(COLUMNS[place] for place in kept), narrowed


def rows(tree: Sequence[Robot]) -> list[Row]:
    """A line for each robot, component and task; only the tasks where no agent answers."""
    found: list[Row] = []
    for robot in tree:
        if robot.state:
            found.append(Row((robot.name, robot.state, *[""] * (len(COLUMNS) - 2)), mood_of_robot(robot.state)))
        for component, branch, below in (
            _branches(robot.components) if robot.state else ((one, "", "") for one in robot.components)
        ):
            if robot.state:
                found.append(_component_row(component, branch, robot.name))
            for one, twig, _ in _branches(component.tasks) if robot.state else ((task, "", "") for task in component.tasks):
                found.append(_task_row(one, below + twig, component.name))
    return found


def told(here: str, seen: Sequence[Seen], tree: Sequence[Robot]) -> dict[str, Any]:
    """All of it for JSON: the tasks of this robot with their spans in milliseconds, and the tree by names."""
    owner = {one.task: component.name for robot in tree for component in robot.components for one in component.tasks}
    tasks = [{**_in_ms(one), "component": owner[one.task] if owner[one.task] != OTHERS else ""} for one in seen]
    return {"robot": here, "tasks": tasks, "robots": [_robot_told(robot) for robot in tree]}


def is_well(tree: Sequence[Robot]) -> bool:
    """Whether each task is run and within its deadline, and no component of this robot has failed."""
    tasks = [one for robot in tree for component in robot.components for one in component.tasks]
    failed = any(component.view.get("state") in UNWELL for component in tree[0].components)
    return not failed and not any(one.state == "idle" or one.past_deadline_ns for one in tasks)


def _robot_told(robot: Robot) -> dict[str, Any]:
    kept = ("state", "pid", "restarts", "exit_status")
    components = [
        {
            "name": one.name,
            **{key: one.view.get(key) for key in kept},
            "use": asdict(one.use) if one.use is not None else None,
            "tasks": [task.task for task in one.tasks],
        }
        for one in robot.components
    ]
    return {"robot": robot.name, "state": robot.state or None, "components": components}


def _name(view: Mapping[str, Any]) -> str:
    return str(view["name"])


def _branches(these: Sequence[T]) -> Iterator[tuple[T, str, str]]:
    """Each with the line that leads to it, and what stands before the lines below it."""
    for place, one in enumerate(these):
        is_last = place == len(these) - 1
        yield one, "└─ " if is_last else "├─ ", "   " if is_last else "│  "


def _component_row(component: Component, branch: str, robot: str) -> Row:
    if not component.view:
        return Row((branch + component.name, *[""] * (len(COLUMNS) - 1)), "quiet")
    state, restarts = state_of(component.view), component.view.get("restarts")
    state += f", started anew {restarts} times" if restarts and restarts > 1 else ", started anew once" if restarts else ""
    name = component.name.partition(f"/{robot}/")[2] or component.name
    used = (f"{component.use.cpu:.0%}", size(component.use.memory)) if component.use is not None else ("", "")
    return Row((branch + name, state, *used, *[""] * (len(COLUMNS) - 4)), mood_of(component.view))


def _task_row(one: Seen, branch: str, component: str) -> Row:
    mood: Mood = "bad" if one.past_deadline_ns else "warning" if one.state in ("idle", "held") or one.misses else "good"
    state = f"{one.state}, {span(one.past_deadline_ns)} past its deadline" if one.past_deadline_ns else one.state
    after = ", ".join(f"{name} (not declared)" if name in one.missing else name for name in one.after)
    name = one.task.rsplit("/", 1)[-1] if one.task == component else one.task  # the component's whole name stands above it
    cells = (
        *(branch + name, state, "", "", span(one.period_ns) if one.period_ns else one.kind),
        span(one.phase_ns) if one.phase_ns else "",
        *(f"{one.misses} ({one.blamed} was late)" if one.blamed else str(one.misses), span(one.late_p50_ns or None)),
        *(span(one.late_p99_ns or None), span(one.took_p50_ns or None), span(one.took_p99_ns or None), str(one.overruns), after),
    )
    return Row(cells, mood)


def _in_ms(one: Seen) -> dict[str, Any]:
    return {
        name.removesuffix("_ns") + "_ms" if name.endswith("_ns") else name: ms(value) if name.endswith("_ns") else value
        for name, value in asdict(one).items()
    }
