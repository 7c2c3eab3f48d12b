"""drain, undrain: everything leaves a robot before its maintenance, and may come back after it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Any, Final

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
        before, left = set[str](), _left(_seen(agent), arguments.robot, set())
        while left and time.monotonic() < deadline:
            before |= set(left)
            time.sleep(POLL_S)
            seen = _seen(agent)
            left = _left(seen, arguments.robot, before)
            _tell(arguments, moved, _gone(seen, before - set(left) - set(moved)))
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


def _seen(agent: Control) -> dict[str, Mapping[str, Any]]:
    """The components by their names, each as the robot sees it that runs it."""
    return {one["name"]: sight(one) for one in agent.ask("status", team=True)["components"]}


def _left(seen: Mapping[str, Mapping[str, Any]], robot: str, before: set[str]) -> dict[str, str]:
    """The components that a robot runs still, or that do not run elsewhere yet, each with what it says about that."""
    here = {name: one for name, one in seen.items() if one.get("primary") == robot and one.get("state") not in OVER_STATES}
    here |= {name: one for name, one in seen.items() if name in before and one.get("state") in UNDER_WAY}
    return {
        name: "; ".join(note for note in one["notes"] if "is drained" in note) or str(one["state"]) for name, one in here.items()
    }


def _gone(seen: Mapping[str, Mapping[str, Any]], names: set[str]) -> dict[str, str]:
    """Where the components run that have left; "" for one that has ended."""
    found = {name: seen.get(name, {}) for name in names}
    return {name: "" if one.get("state") in OVER_STATES else str(one.get("primary") or "") for name, one in found.items()}
