"""failover ps as a tree: each component with its own tasks, whole at 60, 80, 100 and 200 columns."""

from __future__ import annotations

import io
from typing import Any

import pytest
from msgspec.structs import replace
from rich.console import Console

from failover.cli.output import render, task_tree
from failover.client.process_use import Use
from failover.schedule.overview import Seen

MS = 1_000_000
ODOMETRY = Seen(
    task="odometry",
    kind="periodic",
    state="running",
    period_ns=10 * MS,
    phase_ns=2 * MS,
    deadline_ns=8 * MS,
    overrun="skip",
    mode="",
    priority=40,
    after=(),
    missing=(),
    pid=3,
    started=9,
    ended=9,
    misses=3,
    past_deadline_ns=0,
    overruns=0,
    skipped=0,
    orphaned=0,
    blamed="",
    late_p50_ns=70_000,
    late_p99_ns=260_000,
    took_p50_ns=MS,
    took_p99_ns=2 * MS,
)
MAPPER = replace(ODOMETRY, task="mapper", period_ns=50 * MS, phase_ns=0, after=("odometry",), misses=0)
LOGGER = replace(ODOMETRY, task="logger", state="idle")
OWN = replace(ODOMETRY, task="/lab/robot1/controller")
TASKS = [OWN, ODOMETRY, MAPPER, LOGGER]
OWNERS = {OWN.task: OWN.task, "odometry": "/lab/robot1/navigation", "mapper": "/lab/robot1/navigation"}


def component(name: str, primary: str, state: str, **more: Any) -> dict[str, Any]:
    facts = {"name": name, "primary": primary, "state": state, "role": "primary", "standby": "robot9", "epoch": 1}
    return {**facts, "protection": "protected", **more}


STATUS = {
    "robot": "robot1",
    "peers": [{"name": "robot2", "state": "dead"}],
    "components": [
        component("/lab/robot1/controller", "robot1", "running", restarts=2),
        component("/lab/robot1/navigation", "robot1", "running"),
        component("/lab/robot1/camera", "robot1", "failed", exit_status=256, role="none"),
        component("/lab/robot2/arm", "robot2", "running"),
    ],
}


USES = {"/lab/robot1/controller": Use(cpu=0.034, memory=24_500_000, processes=2), "/lab/robot1/navigation": None}


def tree() -> tuple[task_tree.Robot, ...]:
    return task_tree.robots("robot1", TASKS, STATUS, OWNERS, USES)


def drawn(width: int) -> str:
    columns, rows = task_tree.fitting(tree(), width)
    console = Console(width=width, file=io.StringIO(), highlight=False, force_terminal=False)
    console.print(render._drawn(width, columns, [(row.cells, "") for row in rows], "tasks of robot1"))
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_robots_components_and_tasks_are_there_whole_at_each_width(width: int) -> None:
    lines = drawn(width).splitlines()
    assert max(map(render.width_of, lines)) <= width
    said = " ".join(" ".join(lines).replace("│", " ").split())
    assert all(word in said for word in ("camera", "controller", "navigation", "arm", "other programs", "odometry", "logger"))
    assert all(word in said for word in ("failed (exit 1)", "10 ms", "50 ms", "2.00 ms", "0.07 ms", "0.26 ms", "idle", "dead"))
    assert width < task_tree.WHOLE_WIDTH or all(word in said for word in ("3%", "24.5 MB"))


def test_on_a_narrow_terminal_a_row_stays_inside_the_lines_of_the_tree() -> None:
    lines = drawn(60).splitlines()
    place = next(place for place, line in enumerate(lines) if "odometry" in line and "├─" in line)
    assert lines[place].startswith("│  ├─ odometry")
    assert lines[place + 1].startswith("│  │     state running, period 10 ms, phase 2.00 ms, misses")


def test_json_has_the_tree_by_names_and_each_task_with_its_component() -> None:
    told = task_tree.told("robot1", TASKS, tree())
    assert {one["task"]: one["component"] for one in told["tasks"]} == {**OWNERS, "logger": ""}
    assert told["tasks"][0]["period_ms"] == 10
    here, other = told["robots"]
    assert (here["robot"], here["state"], other["state"]) == ("robot1", "live", "dead")
    found = {one["name"]: (one["state"], one["restarts"], one["exit_status"], one["tasks"]) for one in here["components"]}
    assert found["/lab/robot1/controller"] == ("running", 2, None, ["/lab/robot1/controller"])
    assert found["/lab/robot1/camera"] == ("failed", None, 256, [])
    assert found["/lab/robot1/navigation"][3] == ["odometry", "mapper"]
    uses = {one["name"]: one["use"] for one in (*here["components"], *other["components"])}
    assert uses["/lab/robot1/controller"] == {"cpu": 0.034, "memory": 24_500_000, "processes": 2}
    assert uses["/lab/robot1/navigation"] is None and uses["/lab/robot2/arm"] is None


@pytest.mark.parametrize(("state", "primary"), [("released", "robot1"), ("running", "robot2")])
def test_a_task_of_a_component_that_is_not_shown_here_is_one_of_the_other_programs(state: str, primary: str) -> None:
    status = {**STATUS, "components": [component("/lab/robot1/navigation", primary, state)]}
    here, *_ = found = task_tree.robots("robot1", TASKS, status, OWNERS)
    assert [one.task for one in here.components[-1].tasks] == [one.task for one in TASKS]
    assert {one["component"] for one in task_tree.told("robot1", TASKS, found)["tasks"]} == {""}


def test_it_is_well_while_no_task_is_idle_or_late_and_no_component_has_failed() -> None:
    well = {**STATUS, "components": STATUS["components"][:2]}
    assert task_tree.is_well(task_tree.robots("robot1", TASKS[:3], well, OWNERS))
    assert not task_tree.is_well(task_tree.robots("robot1", TASKS[:3], STATUS, OWNERS)), "camera has failed"
    assert not task_tree.is_well(task_tree.robots("robot1", TASKS, well, OWNERS)), "logger is idle"


def test_without_an_agent_there_are_only_the_tasks() -> None:
    (here,) = task_tree.robots("robot1", TASKS, None, {})
    assert [row.cells[0] for row in task_tree.rows((here,))] == ["/lab/robot1/controller", "odometry", "mapper", "logger"]
