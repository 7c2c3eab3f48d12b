"""drain, undrain: everything leaves a robot before its maintenance, and may come back after it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Final

from failover.cli.connection import connect
from failover.cli.output import render
from failover.client.control import Control
from failover.client.health import OVER_STATES, sight
from failover.errors import AgentRefusedError

POLL_S: Final = 0.2
UNDER_WAY: Final = ("starting", "restoring")


def drain(arguments: argparse.Namespace) -> int:
    """Order it, and wait until each component runs elsewhere; 1 if one does not."""
    moved: dict[str, str] = {}
    deadline = time.monotonic() + arguments.timeout
    with connect(arguments) as agent:
        answer = agent.ask("drain", robot=arguments.robot)
        before, left = set[str](), _left(agent, arguments.robot, set())
        while left and time.monotonic() < deadline:
            before |= set(left)
            time.sleep(POLL_S)
            left = _left(agent, arguments.robot, before)
            _tell(arguments, moved, _gone(agent, before - set(left) - set(moved)))
    if arguments.json:
        render.as_json({**answer, "moved": moved, "left": left})
        return 1 if left and arguments.timeout else 0
    if left and arguments.timeout:
        stays = "; ".join(f"{name}: {why}" for name, why in sorted(left.items()))
        raise AgentRefusedError(f"{arguments.robot} is drained, and still runs {stays}; it moves as soon as it can")
    print(f"{arguments.robot} is drained" + (f"; {len(left)} are on their way: failover status shows them" if left else ""))
    return 0


def undrain(arguments: argparse.Namespace) -> int:
    """Order it."""
    with connect(arguments) as agent:
        answer = agent.ask("drain", robot=arguments.robot, on=False)
    if arguments.json:
        render.as_json(answer)
    else:
        print(answer["sentence"])
    return 0


def _tell(arguments: argparse.Namespace, moved: dict[str, str], gone: Mapping[str, str]) -> None:
    for name, robot in sorted(gone.items()):
        moved[name] = robot
        if not arguments.json:
            print(f"{name} runs at {robot}" if robot else f"{name} has ended", flush=True)


def _left(agent: Control, robot: str, before: set[str]) -> dict[str, str]:
    """The components that a robot runs still, or that do not run elsewhere yet, each with what it says about that."""
    seen = [sight(one) for one in agent.ask("status", team=True)["components"]]
    here = [one for one in seen if one.get("primary") == robot and one.get("state") not in OVER_STATES]
    here += [one for one in seen if one["name"] in before and one not in here and one.get("state") in UNDER_WAY]
    return {one["name"]: "; ".join(note for note in one["notes"] if "is drained" in note) or str(one["state"]) for one in here}


def _gone(agent: Control, names: set[str]) -> dict[str, str]:
    """Where the components run that have left; "" for one that has ended."""
    if not names:
        return {}
    seen = {one["name"]: sight(one) for one in agent.ask("status", team=True)["components"]}
    found = {name: seen.get(name, {}) for name in names}
    return {name: "" if one.get("state") in OVER_STATES else str(one.get("primary") or "") for name, one in found.items()}
