"""When hooks run: before a capture seldom, and never for long."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, cast

from agent.config import ComponentConfig, HooksConfig
from agent.worker.components.context import Surroundings
from agent.worker.components.hook_runner import CAPTURE_LIMIT_S, Occasions
from agent.worker.components.statistics import Figures
from failover.core import acts
from failover.core.types import ComponentSpec, Launch

NAME = "/lab/robot1/mapper"


class Here:
    """The places of a robot, as far as hooks are told of them."""

    robot = "robot1"


def occasions(hooks: HooksConfig) -> Occasions:
    none = cast(Any, None)
    around = Surroundings(cast(Any, Here()), none, none, lambda _: None, none, none, lambda _: ComponentConfig(hooks=hooks))
    return Occasions(NAME, around, Figures())


def capture(*, base: bool = False, hold: bool = False) -> acts.Capture:
    return acts.Capture(NAME, 3, base, 194, 7, hold)


def test_a_hook_before_captures_is_run_for_whole_ones_once_in_a_while_and_for_the_last_of_a_handover(tmp_path: Path) -> None:
    told = tmp_path / "told"
    note = ("/bin/sh", "-c", f'echo "$FAILOVER_HOOK $FAILOVER_EPOCH $FAILOVER_GENERATION $FAILOVER_PID" >>{told}')

    async def run() -> None:
        one = occasions(HooksConfig(before_capture=note))
        for act in (capture(), capture(base=True), capture(base=True), capture(), capture(hold=True), capture(hold=True)):
            await one.before_capture(act, 4711)

    asyncio.run(run())
    assert told.read_text().splitlines() == ["before_capture 3 194 4711"] * 3


def test_a_hook_that_came_with_the_program_gives_way_to_this_robots_own(tmp_path: Path) -> None:
    launch = Launch(hooks=(("before_capture", ("/bin/touch", str(tmp_path / "its"))),))

    async def run(hooks: HooksConfig) -> None:
        one = occasions(hooks)
        one.runs_here(ComponentSpec(NAME, launch=launch))
        await one.before_capture(capture(base=True), 4711)

    asyncio.run(run(HooksConfig(before_capture=("/bin/touch", str(tmp_path / "ours")))))
    assert [path.name for path in tmp_path.iterdir()] == ["ours"]
    asyncio.run(run(HooksConfig()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["its", "ours"]


def test_nothing_waits_longer_for_a_hook_before_a_capture_than_a_handover_can() -> None:
    one = occasions(HooksConfig(before_capture=("/bin/true",), after_resume=("/bin/true",), limit_s=50))
    assert one._hook("before_capture", None).limit_s == CAPTURE_LIMIT_S
    assert one._hook("after_resume", None).limit_s == 50


def test_a_robot_is_got_ready_first_by_its_own_hook_or_by_the_programs() -> None:
    its = ComponentSpec(NAME, launch=Launch(hooks=(("before_resume", ("/bin/true",)),)))
    assert occasions(HooksConfig(before_resume=("/bin/true",))).prepares(None)
    assert occasions(HooksConfig()).prepares(its)
    assert not occasions(HooksConfig(after_resume=("/bin/true",))).prepares(ComponentSpec(NAME))
