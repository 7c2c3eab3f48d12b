"""ps, task add, set, remove, histogram: the tasks of this robot's schedule, and orders by hand."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from msgspec.structs import replace

from failover.boards import boottime
from failover.boards.schedule_file import Order, ScheduleFile
from failover.cli.output import render, task_tree
from failover.cli.output.board_tree import span
from failover.client.control import Control
from failover.client.process_use import Meter, Use
from failover.core.schedule import layout, orders
from failover.core.schedule.course import Overrun
from failover.core.schedule.orders import Change
from failover.core.schedule.terms import CPUS_MAX, Declaration, Kind, Terms, nanoseconds
from failover.errors import AgentRefusedError, LostAgentError, NoAgentError, ScheduleError
from failover.schedule.overview import Seen, is_none_there, judged, open_schedule, overview, owners

SPANS: Final = {
    "period_ms": "period_ns",
    "phase_ms": "phase_ns",
    "deadline_ms": "deadline_ns",
    "budget_ms": "budget_ns",
    "distance_ms": "distance_ns",
}
OVERRUNS: Final = {one.name.lower(): one for one in Overrun}
BAR_WIDTH: Final = 50


@contextlib.contextmanager
def opened(arguments: argparse.Namespace) -> Iterator[ScheduleFile]:
    """The schedule of this robot, as ``--board`` or the environment says."""
    file = open_schedule(Path(arguments.board) if arguments.board else None)
    try:
        yield file
    finally:
        file.close()


def show(arguments: argparse.Namespace) -> int:
    """Robots, components, tasks; with --watch again and again until Ctrl-C.

    Exit status 1: a task is idle, or past its deadline, or a component has failed.
    """
    meter = Meter()
    with render.live_table() if arguments.watch else contextlib.nullcontext(render.painted) as draw:
        while True:
            here, seen, tree = _looked_at(arguments, meter)
            if arguments.json:
                render.as_json(task_tree.told(here, seen, tree))
            else:
                draw(*task_tree.fitting(tree, render.room()), f"tasks of {here}")
            if not arguments.watch:
                return 0 if task_tree.is_well(tree) else 1
            time.sleep(arguments.every_ms / 1000)
    return 0  # Ctrl-C ended the watch


def _looked_at(arguments: argparse.Namespace, meter: Meter) -> tuple[str, list[Seen], tuple[task_tree.Robot, ...]]:
    """This robot, its tasks and the tree; of a robot whose agent answers, also where no program has run a task yet.

    Raises:
        ScheduleError: there is no schedule, and no agent.
    """
    status, uses = _team(meter)
    try:
        with opened(arguments) as file:
            seen, here = overview(file), file.header.robot
            return here, seen, task_tree.robots(here, seen, status, owners(file, seen, status), uses)
    except ScheduleError:
        if status is None or arguments.board or not is_none_there():
            raise
        here = str(status["robot"])
        return here, [], task_tree.robots(here, [], status, {}, uses)


def _team(meter: Meter) -> tuple[dict[str, Any] | None, dict[str, Use | None]]:
    """What the agent of this robot says of the team, and what its components use; None where no agent answers."""
    try:
        with Control.open() as agent:
            status = agent.ask("status", team=True)
            return status, uses_of(agent.peer_pid, status, meter)
    except (NoAgentError, LostAgentError, AgentRefusedError):
        return None, {}


def uses_of(agent_pid: int, status: Mapping[str, Any], meter: Meter) -> dict[str, Use | None]:
    """What the components of the robot that answered use; nothing where its agent counts PIDs in a namespace of its own.

    Args:
        agent_pid: of the process that answered, as we see it.
    """
    if agent_pid != status.get("lanes_pid"):
        return {}
    here = [one for one in status["components"] if one.get("primary") == status["robot"] and one.get("pid")]
    return {one["name"]: meter.of(one["pid"]) for one in here}


# --- Orders ----------------------------------------------------------------------------------------------------------


def parsed(words: Sequence[str]) -> tuple[dict[str, object], tuple[str, ...] | None, str]:
    """Fields of terms, predecessors and mode, of words such as ``period_ms=10``.

    Raises:
        ScheduleError: a word is none of them; names it.
    """
    fields: dict[str, object] = {}
    after, mode = None, ""
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            raise ScheduleError(f"{word!r} is no KEY=VALUE; {_known()}")
        if key in SPANS:
            fields[SPANS[key]] = nanoseconds(_number(key, value) / 1000, key.removesuffix("_ms"))
        elif key == "priority":
            fields[key] = _whole(key, value)
        elif key == "overrun" and value in OVERRUNS:
            fields[key] = OVERRUNS[value]
        elif key == "strict" and value in ("true", "false"):
            fields[key] = value == "true"
        elif key == "cpus":
            fields[key] = sum(1 << place for place in {_processor(place) for place in value.split(",") if place})
        elif key == "after":
            after = tuple(name for name in value.split(",") if name)
        elif key == "mode":
            mode = value
        else:
            raise ScheduleError(f"{word!r} is no setting of a task; {_known()}")
    return fields, after, mode


def terms_of(fields: Mapping[str, object]) -> Terms:
    """The terms of a new task: periodic, sporadic with a distance, else due once, now."""
    terms = replace(Terms(), **fields)
    if terms.period_ns:
        return terms
    kind = Kind.SPORADIC if terms.distance_ns else Kind.ONE_SHOT
    return replace(terms, kind=kind, at_ns=0 if kind is Kind.SPORADIC else boottime.machine_ns())


def _known() -> str:
    return f"there are {', '.join(SPANS)}, priority, cpus=0,1, after=A,B, overrun={'|'.join(OVERRUNS)}, strict=true|false, mode"


def _number(key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ScheduleError(f"{key}={text}: {text!r} is no number") from None


def _whole(key: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ScheduleError(f"{key}={text}: {text!r} is no whole number") from None


def _processor(text: str) -> int:
    number = _whole("cpus", text)
    if not 0 <= number < CPUS_MAX:
        raise ScheduleError(f"cpus={text}: processors have the numbers 0 to {CPUS_MAX - 1}")
    return number


def given(arguments: argparse.Namespace, order: Order, told: str = "") -> int:
    """Give an order that a person wants; what is to be told of it is said."""
    with opened(arguments) as file:
        outcome = file.give(judged(file, order, getattr(arguments, "force", True)))
        if arguments.json:
            render.as_json({"changed": [row.name for row in outcome.written.values()], "notes": list(outcome.notes)})
        else:
            for note in (*outcome.notes, *([told] if told else [])):
                print(note)
    return 0


def add(arguments: argparse.Namespace) -> int:
    """Declare a task; a process runs it when one of that name begins."""
    fields, after, mode = parsed(arguments.settings)
    if mode:
        raise ScheduleError(f"cannot add {arguments.task!r} in mode {mode!r}: a task has modes when its program declares some")
    declaration = Declaration(arguments.task, terms_of(fields), after or ())
    return given(arguments, lambda rows, held: orders.added(rows, [declaration], held))


def change(arguments: argparse.Namespace) -> int:
    """Change a task: at once, or with its next activation."""
    fields, after, mode = parsed(arguments.settings)
    wanted = Change(arguments.task, fields, after, mode, arguments.next)
    return given(arguments, lambda rows, held: orders.changed(rows, [wanted], held))


def remove(arguments: argparse.Namespace) -> int:
    """Take tasks off the schedule; their programs' loops come to an end."""
    return given(arguments, lambda rows, _: orders.removed(rows, arguments.tasks))


def histogram(arguments: argparse.Namespace) -> int:
    """How late a task began, and how long it took, as bars."""
    with opened(arguments) as file:
        row = file.row_of(arguments.task)
        if row is None:
            orders.removed(file.rows(), [arguments.task])  # says what there is instead
            raise ScheduleError(f"the schedule has no task {arguments.task!r}")
        found = {
            "late": layout.read_histogram(file.table, row, layout.LATENESS_FIELD),
            "took": layout.read_histogram(file.table, row, layout.DURATION_FIELD),
        }
    if arguments.json:
        render.as_json(
            {name: {str(1 << place): count for place, count in enumerate(counts) if count} for name, counts in found.items()}
        )
        return 0
    for name, counts in found.items():
        most = max(counts)
        lines = [
            (f"below {span(1 << place)}", str(count), "#" * max(round(count / most * BAR_WIDTH), 1))
            for place, count in enumerate(counts)
            if count
        ]
        print(render.plain_table((name, "activations", ""), lines) if lines else f"{name}: nothing yet")
    return 0
