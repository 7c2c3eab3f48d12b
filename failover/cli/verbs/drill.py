"""drill: moves a component to its standby and back, and measures what a takeover costs on these robots."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec
from msgspec import Struct

from failover.cli.connection import connect
from failover.cli.output import render
from failover.cli.output.team_tree import milliseconds, named
from failover.cli.verbs.components import agreed
from failover.client.control import Control
from failover.client.health import OVER_STATES, is_unwell, sight
from failover.errors import AgentRefusedError, FailoverError

PATIENCE_S: Final = 60.0
"""For a component to be protected at the other robot: a first snapshot of it is sent there as a whole."""

POLL_S: Final = 0.1

MOVE_S: Final = 10
"""After which the rules call a handover off; see `failover.core.types.Config.handover_ms`."""


class Leg(Struct, frozen=True):
    """One of the two moves.

    Attributes:
        stood_still_ms: from the state that the robot before took last (of a program that keeps its state: its last commit) to the
            first act at the other robot; known within doubt_ms, for two clocks are compared; None: the agents do not tell.
        took_ms: the order, until it was carried out; protected_ms: from then until the next standby held a checkpoint.
        checkpoint_age_ms: how old the newest checkpoint was before: what a loss of the robot would have cost.
        output: bytes that it had written for good, before and after.
    """

    source: str
    target: str
    epoch: int
    stood_still_ms: float | None
    doubt_ms: float | None
    took_ms: float
    protected_ms: float
    checkpoint_age_ms: float | None
    output: tuple[int, int]


class Report(Struct, frozen=True):
    """What came of it. ``missed``: what was not as promised, a sentence each; ``runs_at``: where it is now."""

    name: str
    home: str
    standby: str
    runs_at: str
    promise: str
    legs: tuple[Leg, ...]
    missed: tuple[str, ...]


def drill(arguments: argparse.Namespace) -> int:
    """Move it there and back, and tell how that went."""
    with connect(arguments) as agent:
        before = _fit(agent, arguments.name)
        name, home, standby = before["name"], before["primary"], before["standby"]
        if not arguments.json:
            print(_plan(before), file=sys.stderr)
        if not (arguments.yes or agreed(f"move {name} to {standby} and back now?")):
            raise AgentRefusedError(f"{name} is left as it is; --yes moves it without a question", "Unconfirmed")
        legs: list[Leg] = []
        missed: list[str] = []
        try:
            for source, target in ((home, standby), (standby, home)):
                legs.append(_moved(agent, name, source, target))
                missed += _missed(legs[-1], arguments.at_most_ms)
        except FailoverError as error:
            missed.append(f"{error}")
        except KeyboardInterrupt:
            print(render.spoken(_interrupted(name, home)), file=sys.stderr)
            raise
        runs_at = _runs_at(agent, name)
    if runs_at and runs_at != home:
        missed.append(f"{name} is not back at {home}: once it is protected, give failover handover {name} --to {home}")
    elif not runs_at:
        missed.append(f"no robot that answers runs {name} now; see failover status {name}")
    report = Report(name, home, standby, runs_at, before.get("promise") or "", tuple(legs), tuple(dict.fromkeys(missed)))
    if arguments.json:
        render.as_json(msgspec.to_builtins(report) | {"kept": not report.missed})
    else:
        print(render.spoken("\n".join(_told(report))))
    return 1 if report.missed else 0


def _fit(agent: Control, wanted: str) -> dict[str, Any]:
    """The component, as the robot sees it that runs it.

    Raises:
        AgentRefusedError: there is none of this name, or it could not be moved safely, or another robot would stand by then.
    """
    status = _status(agent)
    component = named(status, wanted)
    seen = sight(component)
    if seen.get("role") != "primary" or seen.get("state") not in ("running", "degraded"):
        raise AgentRefusedError(f"no drill of {seen['name']}: it is {seen.get('state')}, not running; see failover status")
    if is_unwell(component) or seen.get("protection") != "protected":
        notes = [note for one in (seen, component) for note in (*(one.get("lacks") or ()), *(one.get("notes") or ()))]
        why = "; ".join(dict.fromkeys(notes)) or seen.get("promise") or "no other robot holds its checkpoints"
        raise AgentRefusedError(f"no drill of {seen['name']}: it is NOT PROTECTED: {why}", "NotProtected")
    belongs = seen.get("prefer") or seen.get("home")
    robots = sum(peer["role"] == "robot" for peer in status["peers"]) + 1
    if robots > 2 and belongs not in ("", None, seen["primary"]):
        raise AgentRefusedError(
            f"no drill of {seen['name']}: it runs at {seen['primary']} and belongs at {belongs}, which would stand by for it "
            f"after the first move; failover failback {wanted} first"
        )
    return dict(seen)


def _status(agent: Control) -> dict[str, Any]:
    return agent.ask("status", team=True)


def _seen(agent: Control, name: str) -> dict[str, Any]:
    """The component as the robot sees it that runs it; empty where no robot that answers does."""
    found = next((one for one in _status(agent)["components"] if one["name"] == name), None)
    return dict(sight(found)) if found is not None else {}


def _interrupted(name: str, home: str) -> str:
    return (
        f"\nfailover: the drill of {name} was interrupted; a move that was ordered goes on without it. failover status {name} "
        f"shows where it runs; if that is not {home}: failover handover {name} --to {home}, once it is protected"
    )


def _plan(before: Mapping[str, Any]) -> str:
    name, home, standby = before["name"], before["primary"], before["standby"]
    return (
        f"failover: drill of {name}: it moves from {home} to {standby}, and back as soon as it is protected there. Its program "
        f"stands still for some milliseconds to a second each time; a move that takes longer than {MOVE_S} s is called off, and "
        "the program runs on where it was. Connections with others end unless they are carried. All of it takes some seconds "
        "for a small program; a first snapshot of a large one takes as long as the link needs for it."
    )


def _moved(agent: Control, name: str, source: str, target: str) -> Leg:
    """Move it, and wait until it is protected again.

    Raises:
        FailoverError: it was not moved, or is not protected in time.
    """
    before, output = _seen(agent, name), _output(agent, name)
    answer = agent.ask("handover", name=name, to=target, epoch=before.get("epoch") or 0)
    if answer["to"] != target:
        raise AgentRefusedError(f"{name} did not move to {target}: {answer['sentence']}")
    moved_s = time.monotonic()
    after = _until_protected(agent, name, target, source)
    protected_ms = (time.monotonic() - moved_s) * 1000
    stood_still_ms, doubt_ms = _stood_still(agent, name, target, after.get("resumed"))
    return Leg(
        source,
        target,
        int(answer["epoch"]),
        stood_still_ms,
        doubt_ms,
        float(answer["took_ms"]),
        protected_ms,
        before.get("lag_ms"),
        (output, _output(agent, name)),
    )


def _until_protected(agent: Control, name: str, target: str, source: str) -> dict[str, Any]:
    """Raises AgentRefusedError: it is not protected there by the robot that it came from, or has ended."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        seen = _seen(agent, name)
        if seen.get("primary") == target and seen.get("protection") == "protected" and seen.get("standby") == source:
            return seen
        if seen.get("state") in OVER_STATES:
            how = "has ended" if seen["state"] == "ended" else "was released"
            raise AgentRefusedError(f"{name} {how} since it moved to {target}; nothing is left to move")
        if time.monotonic() > deadline_s:
            why = "; ".join(seen.get("notes") or ()) or f"{source} holds no checkpoint of it yet"
            where = f"{name} runs at {seen.get('primary') or 'no robot that answers'}"
            raise AgentRefusedError(f"{where} and was not protected by {source} within {PATIENCE_S:.0f} s: {why}")
        time.sleep(POLL_S)


def _stood_still(agent: Control, name: str, target: str, resumed: Mapping[str, Any] | None) -> tuple[float | None, float | None]:
    """For how long nothing of it acted, and the doubt of that: each robot's calendar against that of the robot that is asked."""
    if not resumed:
        return None, None
    robots = {one["robot"]: one for one in agent.ask("why", name=name, age_ms_max=1)["robots"]}
    there, here = robots.get(target, {}), robots.get(resumed["robot"], {})
    if not (there.get("answered") and here.get("answered")):
        return None, None
    apart_ms = (resumed["at"] - resumed["state_at"]) * 1000
    return apart_ms - there["clock_offset_ms"] + here["clock_offset_ms"], there["clock_doubt_ms"] + here["clock_doubt_ms"]


def _output(agent: Control, name: str) -> int:
    """Bytes that it has written to both streams and that no takeover takes back."""
    return sum(agent.ask("logs", name=name, offsets=[-1, -1])["totals"])


def _runs_at(agent: Control, name: str) -> str:
    try:
        seen = _seen(agent, name)
        return "" if seen.get("state") in OVER_STATES else str(seen.get("primary") or "")
    except FailoverError:
        return ""


def _missed(leg: Leg, at_most_ms: int | None) -> list[str]:
    """What of one move was not as promised."""
    missed = []
    if at_most_ms is not None and (leg.stood_still_ms is None or leg.stood_still_ms - (leg.doubt_ms or 0) > at_most_ms):
        stood = "an unknown time" if leg.stood_still_ms is None else f"{leg.stood_still_ms:.0f} ms"
        missed.append(f"from {leg.source} to {leg.target} it stood still for {stood}, longer than {at_most_ms} ms")
    if leg.output[1] < leg.output[0]:
        taken = leg.output[0] - leg.output[1]
        missed.append(f"from {leg.source} to {leg.target} {taken} bytes of output were taken back that readers may have seen")
    return missed


def _told(report: Report) -> Sequence[str]:
    lines = [_told_of(leg) for leg in report.legs]
    ages = [leg.checkpoint_age_ms for leg in report.legs if leg.checkpoint_age_ms is not None]
    if ages:
        lines.append(f"a real loss would have cost {milliseconds(max(ages))} of its work, and the silence: {report.promise}")
    if report.missed:
        where = f"{report.name} runs at {report.runs_at or 'no robot that answers'}"
        return [*lines, *(f"MISSED: {line}" for line in report.missed), where]
    return [*lines, f"{report.name} is back at {report.home}: all was as promised"]


def _told_of(leg: Leg) -> str:
    stood = "for a time that is not known" if leg.stood_still_ms is None else f"{leg.stood_still_ms:.1f} ms"
    doubt = f" (± {leg.doubt_ms:.1f} ms)" if leg.doubt_ms else ""
    wrote = leg.output[1] - leg.output[0]
    return (
        f"{leg.source} → {leg.target}, epoch {leg.epoch}: it stood still {stood}{doubt}; the order took {leg.took_ms:.0f} ms; "
        f"protected again after {milliseconds(leg.protected_ms)}; {wrote} bytes of output since, none taken back"
    )
