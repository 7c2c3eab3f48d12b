"""why: explains the team's decisions to a reader who did not see them happen."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Final

from failover.cli.connection import connect
from failover.cli.output import render, team_tree

COLUMNS: Final = ("when", "robot", "component", "what was seen and done")

LATE_TOLD_MS: Final = 5.0
"""An own lateness below this has delayed nothing."""

SHOWN_MAX: Final = 100
"""Decisions that are told where --since is not given: the last ones."""

NEAR_MS: Final = 1.0
"""Clocks that are closer together need no word."""


def why(arguments: argparse.Namespace) -> int:
    """Tell which robot saw which facts, when, and what it decided."""
    wanted = {"name": arguments.name or "", "robot": arguments.robot or "", "age_ms_max": arguments.since or 0}
    with connect(arguments) as agent:
        answer = agent.ask("why", **wanted)
    if arguments.json:
        render.as_json(answer)
        return 0
    lines = answer["story"]
    earlier = 0 if arguments.since else max(len(lines) - SHOWN_MAX, 0)
    lines = lines[earlier:]
    witnesses = render.spoken(told_of_robots(answer.get("robots") or ()))
    if not lines:
        print("no decisions yet" + (f" about {arguments.name}" if arguments.name else ""))
    elif arguments.brief:
        render.table(COLUMNS, [brief(line) for line in lines])
    else:
        print(render.spoken("\n\n".join(paragraph(line) for line in lines)))
    if earlier:
        print(f"\n{earlier} earlier decisions are not shown; failover why --since 7d, or --json, tells more")
    if witnesses:
        print(f"\n{witnesses}")
    return 0


def brief(line: Mapping[str, Any]) -> tuple[str, ...]:
    """One line of the event log as a row of a table."""
    return instant(line.get("at")), *(str(line.get(key) or "") for key in ("robot", "component", "did"))


def paragraph(line: Mapping[str, Any]) -> str:
    """One line of the event log with all that stands behind it."""
    about = line.get("component") or "the robot itself"
    head = f"{instant(line.get('at'))}  {line.get('robot')}  {about}"
    body = [str(line.get("did") or ""), *(f"- {fact}" for fact in facts(line))]
    return "\n".join([head, *(f"    {text}" for text in body)])


def facts(line: Mapping[str, Any]) -> list[str]:
    """The facts that the robot knew when it decided, a sentence each, without those that go without saying."""
    told = [sighting(one) for one in line.get("seen") or ()]
    if line.get("component"):
        told += _primacy(line)
        told += _at_stake(line)
    if (line.get("late_ms") or 0) >= LATE_TOLD_MS:
        told.append(f"its own loop had been late by {team_tree.milliseconds(line['late_ms'])}")
    if line.get("repeats"):
        told.append(f"the line before it was said {line['repeats']} more times")
    return told


def sighting(seen: Mapping[str, Any]) -> str:
    """One peer, as the robot had heard it."""
    state = seen.get("state")
    limit = team_tree.milliseconds(seen.get("limit_ms"))
    silence = f"silent for {team_tree.milliseconds(seen.get('silent_ms'))} (the limit is {limit})"
    if state == "unheard":
        return f"{seen.get('robot')}: not heard yet, {silence}"
    links = seen.get("links") or {}
    each = ", ".join(f"{link or 'one link'} {team_tree.milliseconds(silent_ms)}" for link, silent_ms in links.items())
    over = f" ({each})" if len(links) > 1 else f" on {each.rsplit(' ', 2)[0]}" if links and "" not in links else ""
    verdict = {"alive": "alive", "suspect": "suspect", "dead": "counted as dead"}.get(str(state), str(state))
    says = f"; it said: {seen['says']}" if seen.get("says") else ""
    deaf = "" if seen.get("hears_us") or state == "dead" else "; it does not hear this robot"
    return f"{seen.get('robot')}: {verdict}, {silence}{over}{deaf}{says}"


def _primacy(line: Mapping[str, Any]) -> list[str]:
    before, now, state = line.get("epoch_before"), line.get("epoch"), line.get("state")
    epochs = f"epoch {now}" if before == now else f"epoch {before} → {now}"
    lease_ms = line.get("lease_left_ms")
    lease = "" if lease_ms is None else f", may act for {team_tree.milliseconds(lease_ms)} more"
    lease = ", its lease is over" if lease_ms == 0 else lease
    return [f"here: {state}, {epochs}{lease}"]


def _at_stake(line: Mapping[str, Any]) -> list[str]:
    """The loss, had it gone on from the newest checkpoint in that instant."""
    number, age_ms, output = line.get("checkpoint"), line.get("checkpoint_age_ms"), line.get("output_pending")
    told = []
    if number:
        age = "" if age_ms is None else f", {team_tree.milliseconds(age_ms)} old: a takeover from it loses the work since then"
        told.append(f"newest checkpoint: {number}{age}")
    elif line.get("state") not in ("absent", "finished", "failed", "released"):
        told.append("no checkpoint yet: a takeover loses all work")
    if output is not None:
        told.append(f"output in no checkpoint: {team_tree.size(output)}")
    return told


def told_of_robots(robots: Sequence[Mapping[str, Any]]) -> str:
    """A sentence on the robots that answered, those whose clock is off, and those that did not answer."""
    told = []
    for one in robots:
        if not one.get("answered"):
            told.append(f"{one.get('robot')} did not send its event log: {one.get('reason')}")
            continue
        offset_ms, doubt_ms = one.get("clock_offset_ms") or 0.0, one.get("clock_doubt_ms") or 0.0
        if abs(offset_ms) > max(doubt_ms, NEAR_MS):
            way = "ahead of" if offset_ms > 0 else "behind"
            told.append(
                f"{one.get('robot')}: its clock is {_span(abs(offset_ms))} {way} this robot's (± {doubt_ms:.1f} ms); "
                "all times above are this robot's"
            )
        if one.get("damaged"):
            told.append(f"{one.get('robot')}: {one['damaged']} lines of its event log cannot be read any more")
    return "\n".join(told)


def _span(span_ms: float) -> str:
    return f"{span_ms / 1000:.3f} s" if span_ms >= 1000 else f"{span_ms:.1f} ms"


def instant(at: object) -> str:
    """An instant (seconds since 1970) by this machine's calendar, to the millisecond; with the day if that is not today."""
    if not isinstance(at, int | float):
        return str(at or "")
    when = datetime.fromtimestamp(at).astimezone()
    day = "" if when.date() == datetime.now().astimezone().date() else when.strftime("%Y-%m-%d ")
    return day + when.strftime("%H:%M:%S.%f")[:-3]
