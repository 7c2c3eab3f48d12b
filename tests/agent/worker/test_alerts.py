"""Alerts of one robot: which components it tells of, what outlives its worker process, and how its commands are run."""

from __future__ import annotations

import asyncio
import json
import os
import pwd
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agent.alerts_config import AlertsConfig
from agent.config import Config, Settings
from agent.worker import alerts as module
from agent.worker.alerts import AT_ONCE, FILE_NAME, WAITING_MAX, Alerts
from agent.worker.components.hooks import Hooks
from checkpoint.model import Position
from failover.config.team import Robot, Team
from failover.core import acts, events
from failover.core.types import Resumption

NAME = "/lab/robot1/mapper"
PATIENCE_S = 30.0
NOTE = 'cat >>"$1"'


def component(role: str, primary: str = "robot1", **more: Any) -> dict[str, Any]:
    """As a robot sees it."""
    well = {"name": NAME, "role": role, "primary": primary, "state": "running", "epoch": 3, "standby": "robot2"}
    return {**well, "protection": "protected", "notes": [], "reasons": [], "elsewhere": {}, **more}


class Known:
    """What a robot knows of its team, and what the others answer."""

    def __init__(self, mine: dict[str, Any], peers: dict[str, str], elsewhere: dict[str, dict[str, Any]] | None = None) -> None:
        self.mine, self.peers, self.elsewhere = mine, peers, elsewhere or {}
        self.asked: list[set[str]] = []

    async def joined(self, robots: Any) -> dict[str, Any]:
        self.asked.append(set(robots))
        seen = {robot: view for robot, view in self.elsewhere.items() if robot in robots}
        peers = [{"name": name, "state": state} for name, state in self.peers.items()]
        return {"rule": "pair", "peers": peers, "components": [{**self.mine, "elsewhere": seen}] if self.mine else []}


def alerts(directory: Path, team: Known, robot: str = "robot2", **config: Any) -> Alerts:
    members = {name: Robot((), "") for name in ("robot1", "robot2", "robot3")}
    here = Config(robot=robot, state_directory=str(directory), alerts=AlertsConfig(**config))
    told: list[events.Event] = []
    questions: Any = team
    made = Alerts(Settings(directory / "agent.toml", here, Team("lab", members), ""), questions, told.append, Hooks())
    made.events = told  # type: ignore[attr-defined]
    return made


def tells_of(directory: Path, team: Known, robot: str) -> list[str]:
    return list(asyncio.run(alerts(directory, team, robot)._sights()))


def test_the_robot_that_runs_it_tells_of_it_with_the_word_of_its_standby(tmp_path: Path) -> None:
    team = Known(component("primary"), {"robot2": "live", "robot3": "live"}, {"robot2": component("standby", lacks=["a file"])})
    (sight,) = asyncio.run(alerts(tmp_path, team, "robot1")._sights()).values()
    assert "a file" in sight.trouble and team.asked[-1] == {"robot2"}, "no other robot is asked"
    assert tells_of(tmp_path, Known(component("standby"), {"robot1": "live", "robot3": "live"}), "robot2") == []


@pytest.mark.parametrize(("robot", "expected"), [("robot2", [NAME]), ("robot3", [])])
def test_of_one_that_no_robot_runs_the_first_of_its_holders_tells(tmp_path: Path, robot: str, expected: list[str]) -> None:
    held = component("standby", state="held", standby="", protection="none")
    other = "robot3" if robot == "robot2" else "robot2"
    team = Known(held, {"robot1": "dead", other: "live"}, {other: held})
    assert tells_of(tmp_path, team, robot) == expected


def test_what_was_told_is_followed_where_it_runs_now_and_outlives_the_worker_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def first_life() -> None:
        alone = component("primary", "robot2", standby="", protection="none", notes=["no robot stands by"])
        robot = alerts(tmp_path, Known(alone, {"robot1": "dead"}), degraded_after_s=1, on_degraded=["true"])
        robot._take(robot._watch.look(await robot._sights(), 1))
        robot._take(robot._watch.look(await robot._sights(), 2 * 10**9))
        robot._due.clear()
        await robot._save()

    async def second_life(team: Known) -> list[str]:
        robot = alerts(tmp_path, team, recovered_after_s=1, on_recovered=["true"])
        robot.begin()
        kinds = [one.kind for at in (10, 12, 14) for one in robot._watch.look(await robot._sights(), at * 10**9)]
        await robot.close()
        return kinds

    asyncio.run(first_life())
    assert json.loads((tmp_path / FILE_NAME).read_bytes())["told"][NAME]["is_told"]
    moved = component("standby", "robot1", protection="none")
    well = component("primary", "robot1", standby="robot2")
    assert asyncio.run(second_life(Known(moved, {"robot1": "live"}, {"robot1": well}))) == ["recovered"]
    asyncio.run(first_life())
    released = Known({}, {"robot1": "live"})
    assert asyncio.run(second_life(released)) == [], "the peers may not have been heard yet"
    monkeypatch.setattr(module, "SETTLED_NS", 0)
    assert asyncio.run(second_life(released)) == ["recovered"], "it was released"


@pytest.mark.parametrize("content", [b"\xff not ours", b'{"told":{"\xff":1}}', b'{"x":' + b"[" * 100_000])
def test_a_file_that_cannot_be_read_is_no_reason_to_tell_nothing(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)

    async def begun() -> int:
        robot = alerts(tmp_path, Known({}, {}))
        robot.begin()
        await robot.close()
        return len(robot._watch.troubles)

    assert asyncio.run(begun()) == 0


async def until(condition: Callable[[], bool], what: str) -> None:
    loop = asyncio.get_running_loop()
    deadline = loop.time() + PATIENCE_S
    while not condition():
        assert loop.time() < deadline, f"waited in vain for {what}"
        await asyncio.sleep(0.01)


def test_each_command_runs_once_though_the_worker_process_begins_anew(tmp_path: Path) -> None:
    note = tmp_path / "told"

    async def live(robot: Alerts, told: int) -> None:
        robot.begin()
        await until(lambda: note.exists() and len(note.read_text().splitlines()) >= told, "the commands")
        await until(lambda: not robot._due and not robot._running, "them to end")
        await robot.close()

    async def both() -> None:
        command = ["/bin/sh", "-c", NOTE, "sh", str(note)]
        robot = alerts(tmp_path, Known({}, {}), on_split=command)
        for epoch in range(1, 7):
            robot.ordered(acts.KeepAside(f"{NAME}{epoch}", epoch, "robot1 holds a later epoch"))
        await robot._save()  # the worker process dies before it has begun any
        for _ in range(2):
            await live(alerts(tmp_path, Known({}, {}), on_split=command), 6)

    asyncio.run(both())
    told = [json.loads(line) for line in note.read_text().splitlines()]
    assert sorted(one["epoch"] for one in told) == [1, 2, 3, 4, 5, 6] and len({one["id"] for one in told}) == 6
    assert {one["alert"] for one in told} == {"split"} and all("robot1 holds a later epoch" in one["reason"] for one in told)


def test_no_more_run_at_once_than_may_and_what_waits_has_a_bound(tmp_path: Path) -> None:
    running = tmp_path / "running"
    running.mkdir()

    async def many() -> tuple[int, Alerts]:
        script = 'touch "$1/$$"; ls "$1" | wc -l >>"$1.most"; sleep 0.05; rm "$1/$$"'
        robot = alerts(tmp_path, Known({}, {}), on_split=["/bin/sh", "-c", script, "sh", str(running)])
        for epoch in range(1, WAITING_MAX + 11):
            robot.ordered(acts.KeepAside(f"{NAME}{epoch}", epoch, "it lost"))
        waiting = len(robot._due)
        while len(robot._due) > 4 * AT_ONCE:  # enough to see
            robot._due.pop()
        robot.begin()
        await until(lambda: not robot._due and not robot._running, "all to be told")
        await robot.close()
        return waiting, robot

    waiting, robot = asyncio.run(many())
    assert waiting == WAITING_MAX
    assert "others wait for their commands" in " ".join(str(one) for one in robot.events)  # type: ignore[attr-defined]
    assert max(map(int, running.with_suffix(".most").read_text().split())) <= AT_ONCE


def test_a_takeover_is_told_when_the_program_runs_and_a_handover_is_none(tmp_path: Path) -> None:
    async def taken(why: Resumption) -> int:
        robot = alerts(tmp_path / str(why).replace(" ", "-"), Known({}, {}), on_takeover=["true"])

        async def own_lines(_component: str, _age: int) -> Any:
            return [], 0

        robot._questions.telling = type("Telling", (), {"own_lines": staticmethod(own_lines)})()
        position = Position(1, 1, bytes(16))
        robot.ordered(acts.Restore(NAME, 4, position, None, why=why))
        assert not robot._due, "it does not run yet"
        robot.heard(events.Restored(NAME, 4, position))
        await asyncio.gather(*robot._tasks)
        return len(robot._due)

    assert asyncio.run(taken(Resumption.TAKEN_OVER)) == 1
    assert asyncio.run(taken(Resumption.HANDED_OVER)) == asyncio.run(taken(Resumption.RESTARTED)) == 0


@pytest.mark.root
def test_a_command_has_the_rights_and_groups_of_the_user_that_is_named(tmp_path: Path) -> None:
    account = pwd.getpwnam("nobody")
    user = module.user_of("nobody")
    assert user is not None and (user.uid, user.gid) == (account.pw_uid, account.pw_gid)
    assert set(user.groups) == set(os.getgrouplist("nobody", account.pw_gid))
    assert module.user_of("") is None
    assert replace(AlertsConfig(), on_split=["x"]).wanted and not AlertsConfig().wanted
