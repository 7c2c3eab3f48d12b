"""The full screen against real agents: what it shows, how it is moved about in, and that its orders ask first."""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_orders import COUNTING

pytest.importorskip("textual")

from textual.pilot import Pilot
from textual.widgets import DataTable, Static

from failover.cli.output.top_screen import Question, Story, Top
from failover.cli.verbs.top import AgentSource

Pair = tuple[RobotMachine, RobotMachine]

POLL_S = 0.2


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """Two robots, and a program that counts at the first."""
    with robots.two_robots(tmp_path_factory.mktemp("top"), own_pids=False) as both:
        robots.run(both[0], "count", *COUNTING)
        robots.until_protected(both[0])
        yield both


@asynccontextmanager
async def screen(robot: RobotMachine, size: tuple[int, int]) -> AsyncIterator[tuple[Top, Pilot[None]]]:
    """The screen of a terminal of that size, once it shows the team."""
    app = Top(AgentSource(argparse.Namespace(socket=str(robot.socket), every_ms=500)))
    async with app.run_test(size=size) as pilot:
        await until(pilot, lambda: any("count" in line for line in shown(app)), "the team to be shown")
        yield app, pilot


async def until(pilot: Pilot[None], condition: Callable[[], Any], what: str) -> None:
    waited_s = 0.0
    while not condition():
        assert waited_s < robots.PATIENCE_S, f"waited in vain for {what}"
        await pilot.pause(POLL_S)
        waited_s += POLL_S


def shown(app: Top) -> list[str]:
    """The lines of the table."""
    table = app.screen_stack[0].query_one(DataTable)
    return [" | ".join(str(cell) for cell in table.get_row_at(row)) for row in range(table.row_count)]


def told(app: Top, which: str) -> str:
    return str(app.screen.query_one(which, Static).content)


async def choose(pilot: Pilot[None], app: Top) -> None:
    """Move to the component's line."""
    table = app.screen_stack[0].query_one(DataTable)
    (row,) = (row for row, line in enumerate(shown(app)) if is_of_component(line))
    table.move_cursor(row=row)
    await pilot.pause()


def is_of_component(line: str) -> bool:
    """Its name is shortened below its own robot alone."""
    return line.partition(" | ")[0].strip() in ("count", "/demo/robot1/count")


def test_on_60_columns_robots_and_components_are_shown_live_filtered_sorted_and_explained(pair: Pair) -> None:
    async def look() -> None:
        async with screen(pair[0], (60, 20)) as (app, pilot):
            assert "healthy: team demo, at robot1" in told(app, "#head")
            (component,) = filter(is_of_component, shown(app))
            assert "running" in component and "robot2" in component and " ms" in component
            assert any(line.startswith("robot2 | live") and "connected" in line for line in shown(app))
            await until(pilot, lambda: any("%" in line and " MB" in line for line in shown(app)), "cpu and memory")
            before = shown(app)
            await until(pilot, lambda: shown(app) != before, "something to change by itself")

            await pilot.press("slash", *"zzz", "enter")
            await until(pilot, lambda: not any("count" in line for line in shown(app)), "the filter to hide it")
            await pilot.press("escape")
            await until(pilot, lambda: any("count" in line for line in shown(app)), "all to be shown again")
            await pilot.press("s", "s")
            await until(pilot, lambda: "sorted by age" in told(app, "#head"), "another order")

            await choose(pilot, app)
            await pilot.press("enter")
            await until(pilot, lambda: isinstance(app.screen, Story), "its story")
            assert "it runs at robot1, epoch 1" in told(app, "#told")
            await pilot.press("escape")
            await until(pilot, lambda: not isinstance(app.screen, Story), "the table again")

    asyncio.run(look())


def test_on_200_columns_an_order_is_asked_for_first_and_its_effect_is_seen_and_an_agent_that_goes_away_is_waited_for(
    pair: Pair,
) -> None:
    async def move() -> None:
        async with screen(pair[0], (200, 60)) as (app, pilot):
            epoch = robots.component(pair[0], "count")["epoch"]
            for key, answer in (("h", "n"), ("x", "escape")):
                await choose(pilot, app)
                await pilot.press(key)
                await until(pilot, lambda: isinstance(app.screen, Question), "the question")
                assert "/demo/robot1/count" in told(app, "#question")
                await pilot.press(answer)
                await until(pilot, lambda: not isinstance(app.screen, Question), "it to be gone")
            assert robots.component(pair[0], "count")["epoch"] == epoch, "nothing was done"
            for key, robot in (("h", "robot2"), ("b", "robot1")):
                await until(pilot, lambda: "healthy" in told(app, "#head"), "it to be protected")
                await choose(pilot, app)
                await pilot.press(key)
                await until(pilot, lambda: isinstance(app.screen, Question), "the question")
                await pilot.press("y")
                await until(pilot, lambda robot=robot: runs_below(app, robot), f"it to run at {robot}")  # type: ignore[misc]

            os.kill(pair[0].status()["lanes_pid"], signal.SIGKILL)  # the process that answers; the main loop starts another one
            await until(pilot, lambda: "team demo" not in told(app, "#head"), "it to be said")
            await until(pilot, lambda: "team demo, at robot1" in told(app, "#head"), "it to come back")

    asyncio.run(move())


def runs_below(app: Top, robot: str) -> bool:
    """Whether the component stands below that robot."""
    above = ""
    for line in shown(app):
        if not line.startswith(" "):
            above = line
        elif is_of_component(line):
            return above.startswith(robot)
    return False
