"""What status shows of one component."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, cast

import pytest

from agent.config import ComponentConfig, HooksConfig
from agent.worker.components.context import Surroundings
from agent.worker.components.run_records import Records
from agent.worker.components.supervisor import Supervisor
from agent.worker.control.status_view import told_lacks
from failover.cli.output.team_tree import is_healthy, rows
from failover.core.types import ComponentView, Protection, State

NAME = "/lab/x"
LACK = "/srv/maps/area.db cannot be used (No such file or directory)"
VIEW = ComponentView(NAME, State.STANDBY, 1, "robot1", "robot2", Protection.NONE, -1, 0, (), "")


@pytest.mark.parametrize(
    ("hooks", "sentence"),
    [
        (HooksConfig(), f"robot2 could not resume it: {LACK}"),
        (
            HooksConfig(before_resume=("/bin/mount-maps",)),
            f"robot2 lacks this now, and the hook before_resume must bring it: {LACK}",
        ),
    ],
)
def test_what_a_hook_perhaps_brings_is_lacking_now_and_no_refusal(hooks: HooksConfig, sentence: str, tmp_path: Path) -> None:
    async def told() -> list[str]:
        none = cast(Any, None)
        around = Surroundings(none, none, Records(tmp_path), none, none, none, lambda _: ComponentConfig(hooks=hooks))
        supervisor = Supervisor(NAME, around)
        supervisor.figures.lacks = (LACK,)
        return told_lacks(VIEW, supervisor, "robot2")

    assert asyncio.run(told()) == [sentence]


@pytest.mark.parametrize("prepared_first", [False, True])
def test_a_standby_that_a_hook_gets_ready_is_no_reason_for_alarm(prepared_first: bool) -> None:
    status = lacking_at_standby(prepared_first=prepared_first)
    assert is_healthy(status) is prepared_first


@pytest.mark.parametrize("asked", ["robot1", "robot2"])
@pytest.mark.parametrize("prepared_first", [False, True])
def test_a_component_that_its_standby_would_refuse_is_shown_as_unprotected(asked: str, prepared_first: bool) -> None:
    row = next(row for row in rows(lacking_at_standby(asked=asked, prepared_first=prepared_first)) if "count" in row.cells[0])
    assert row.cells[2] == ("running" if prepared_first else "running, unprotected")
    assert row.mood == ("good" if prepared_first else "warning")


def lacking_at_standby(*, asked: str = "robot1", prepared_first: bool) -> dict[str, Any]:
    """What an agent answers where robot1 runs a component that robot2 has something against."""
    both = {"name": "/lab/count", "primary": "robot1", "state": "running", "standby": "robot2", "protection": "protected"}
    sights: dict[str, dict[str, Any]] = {
        "robot1": {**both, "role": "primary", "lacks": None, "prepared_first": False},
        "robot2": {**both, "role": "standby", "lacks": [LACK], "prepared_first": prepared_first},
    }
    other = {"robot1": "robot2", "robot2": "robot1"}[asked]
    own = {**sights[asked], "elsewhere": {other: sights[other]}}
    return {"robot": asked, "peers": [{"name": other, "state": "live"}], "components": [own]}
