"""Answers ``failover why``: merges this robot's event log and every other robot's, on one clock, in one order."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from msgspec import Struct, field

from agent import event_log
from agent.config import Settings
from agent.errors import RefusedError
from agent.main_loop.messages import Told
from agent.system import clock
from agent.worker.control.arguments import PageArguments, arguments_of
from agent.worker.network.remote_orders import Errands
from checkpoint.errors import UNDECODABLE
from failover.core.event_log.decisions import Line, Sighting
from failover.core.event_log.merge import Timed, merged

PAGE_SIZE: Final = 128 << 10
"""Bytes of lines in one answer over the replication link, whose messages are small."""

PAGES_MAX: Final = 32
"""Asked of one robot for one answer: all that it keeps."""

PATIENCE_S: Final = 3.0
"""How long one page of another robot is waited for; its disk may be slow."""

CALENDAR_DOUBT_NS: Final = 10**9
"""How far an instant may be wrong that only the calendar of an earlier boot of that robot tells; it may have been set since."""

NS_PER_MS: Final = 10**6


class Worker(Protocol):
    """The part of `agent.worker.process.Worker` that is needed here."""

    settings: Settings
    errands: Errands

    async def ask(self, what: Any) -> Told: ...


class Reading(Struct, frozen=True):
    """Both clocks of one robot at one instant."""

    kernel: str
    now_ns: int
    wall_ns: int


class Heard(Struct):
    """One robot's event log as it came.

    Attributes:
        offset_ns: its calendar minus ours; known within ``doubt_ns``.
        reason: why it did not answer, "" if it did.
    """

    robot: str
    lines: list[Line] = field(default_factory=list)
    damaged: int = 0
    reading: Reading = Reading("", 0, 0)
    offset_ns: int = 0
    doubt_ns: int = 0
    reason: str = ""


class Telling:
    """Both ends: asks the others, and answers them."""

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    async def whole(self, component: str, robot: str, age_ms_max: int) -> dict[str, Any]:
        """The event logs of all robots, or of one, of one component ("" for all), without the lines that are older (0: with all).

        Raises:
            RefusedError: the team has no such robot.
        """
        settings = self._worker.settings
        members = [settings.config.robot, *sorted(settings.peers)]
        if robot and robot not in members:
            raise RefusedError(f"why: the team knows no robot {robot!r}, only {', '.join(members)}")
        asked = [robot] if robot else members
        logs = await asyncio.gather(*(self._log_of(one, component, age_ms_max) for one in asked))
        told = merged({one.robot: _timed(one) for one in logs})
        return {"story": [_shown(one) for one in told], "robots": [_witness(one) for one in logs]}

    async def page(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        """This robot's own lines for another robot: the newest that fit before ``before``, with its clocks."""
        came_ns = clock.wall_ns(clock.now_ns())
        wanted = arguments_of(PageArguments, "story", arguments)
        lines, damaged = await self.own_lines(wanted.name, wanted.age_ms_max)
        older = [line for line in lines if wanted.before == (0, 0) or _place(line) < wanted.before]
        fitting = _fitting(older)
        now = _reading()
        return {
            "lines": [event_log.packed(line) for line in fitting],
            "more": len(fitting) < len(older),
            "damaged": damaged,
            "kernel": now.kernel,
            "now_ns": now.now_ns,
            "came_ns": came_ns,
            "left_ns": now.wall_ns,
        }

    async def own_lines(self, component: str, age_ms_max: int) -> tuple[list[Line], int]:
        """This robot's lines, oldest first. It asks the main loop for lines not written yet before it reads the disk."""
        told = await self._worker.ask("why")
        try:
            kept = await asyncio.to_thread(event_log.read, Path(self._worker.settings.config.state_directory))
        except OSError as error:
            raise RefusedError(f"this robot cannot read its event log: {error.strerror}") from error
        found = {_place(line): line for line in (*kept.lines, *told.unwritten)}
        now = _reading()
        chosen = [
            line
            for _, line in sorted(found.items())
            if line.decision.component in ("", component or line.decision.component)
            and (not age_ms_max or _age_ns(line, now) <= age_ms_max * NS_PER_MS)
        ]
        return chosen, kept.damaged

    async def _log_of(self, robot: str, component: str, age_ms_max: int) -> Heard:
        heard = Heard(robot)
        try:
            if robot == self._worker.settings.config.robot:
                heard.lines, heard.damaged = await self.own_lines(component, age_ms_max)
                heard.reading = _reading()
            else:
                await self._fetch(heard, component, age_ms_max)
        except RefusedError as refusal:
            heard.reason = str(refusal)
        except (*UNDECODABLE, LookupError, TypeError, ValueError) as error:
            heard.reason = (
                f"{robot} sent an event log that this robot does not understand: {error}; install the same release on both"
            )
        return heard

    async def _fetch(self, heard: Heard, component: str, age_ms_max: int) -> None:
        """Page by page, the newest first."""
        before = (0, 0)
        for _ in range(PAGES_MAX):
            asked_ns = clock.wall_ns(clock.now_ns())
            question = {"name": component, "age_ms_max": age_ms_max, "before": before}
            page = await self._worker.errands.send(heard.robot, "story", question, patience_s=PATIENCE_S)
            _set_clock(heard, page, asked_ns, clock.wall_ns(clock.now_ns()))
            lines = [event_log.unpacked(bytes(content).rstrip(b"\n")) for content in page["lines"]]
            whole = [line for line in lines if line is not None]
            heard.lines[:0] = whole
            if not page["more"] or not whole:
                return
            before = _place(whole[0])


def _set_clock(heard: Heard, page: dict[str, Any], asked_ns: int, answered_ns: int) -> None:
    """Where its calendar stands against ours; the quickest page knows best. Source: RFC 5905, section 8."""
    heard.damaged = int(page["damaged"])
    came_ns, left_ns = int(page["came_ns"]), int(page["left_ns"])
    doubt_ns = max((answered_ns - asked_ns) - (left_ns - came_ns), 0) // 2
    if not heard.reading.wall_ns or doubt_ns < heard.doubt_ns:
        heard.reading = Reading(str(page["kernel"]), int(page["now_ns"]), left_ns)
        heard.offset_ns = ((came_ns - asked_ns) + (left_ns - answered_ns)) // 2
        heard.doubt_ns = doubt_ns


def _reading() -> Reading:
    now_ns = clock.now_ns()
    return Reading(clock.kernel_boot(), now_ns, clock.wall_ns(now_ns))


def _place(line: Line) -> tuple[int, int]:
    return line.life, line.number


def _age_ns(line: Line, now: Reading) -> int:
    return now.now_ns - line.decision.at_ns if line.kernel == now.kernel else now.wall_ns - line.wall_ns


def _fitting(lines: Sequence[Line]) -> list[Line]:
    """The newest lines that fit one page, at least one."""
    chosen: list[Line] = []
    size = 0
    for line in reversed(lines):
        size += len(event_log.packed(line))
        if chosen and size > PAGE_SIZE:
            break
        chosen.append(line)
    return chosen[::-1]


def _timed(heard: Heard) -> list[Timed]:
    """Every line by our own calendar."""
    return [_on_our_clock(line, heard) for line in heard.lines]


def _on_our_clock(line: Line, heard: Heard) -> Timed:
    reading = heard.reading
    if line.kernel == reading.kernel:
        at_ns = reading.wall_ns - (reading.now_ns - line.decision.at_ns)
        return Timed(line, at_ns - heard.offset_ns, heard.doubt_ns)
    return Timed(line, line.wall_ns - heard.offset_ns, heard.doubt_ns + CALENDAR_DOUBT_NS)


def _witness(heard: Heard) -> dict[str, Any]:
    """One robot's part in the answer; see `failover.client.control.WHY`."""
    return {
        "robot": heard.robot,
        "answered": not heard.reason,
        "reason": heard.reason,
        "lines": len(heard.lines),
        "damaged": heard.damaged,
        "clock_offset_ms": heard.offset_ns / NS_PER_MS,
        "clock_doubt_ms": heard.doubt_ns / NS_PER_MS,
    }


def _shown(timed: Timed) -> dict[str, Any]:
    """One line of the event log; see `failover.client.control.WHY`."""
    line, facts = timed.line, timed.line.decision.facts
    return {
        "at": timed.at_ns / 10**9,
        "doubt_ms": timed.doubt_ns / NS_PER_MS,
        "robot": line.robot,
        "component": line.decision.component,
        "did": line.decision.sentence,
        "life": line.life,
        "number": line.number,
        "repeats": line.repeats,
        "epoch_before": facts.epoch_before,
        "epoch": facts.epoch,
        "state": facts.state,
        "late_ms": facts.late_ns / NS_PER_MS,
        "lease_left_ms": None if facts.lease_left_ns is None else facts.lease_left_ns / NS_PER_MS,
        "checkpoint": facts.checkpoint or None,
        "checkpoint_age_ms": _milliseconds(facts.checkpoint_age_ns),
        "output_pending": facts.output_pending if facts.output_pending >= 0 else None,
        "seen": _seen(facts.seen),
    }


def _seen(sightings: Iterable[Sighting]) -> list[dict[str, Any]]:
    return [
        {
            "robot": one.robot,
            "state": one.state,
            "silent_ms": one.silent_ns / NS_PER_MS,
            "limit_ms": one.limit_ns / NS_PER_MS,
            "links": {link: silent_ns / NS_PER_MS for link, silent_ns in one.links},
            "hears_us": one.hears_us,
            "says": one.says,
            "life": one.boot,
            "beat": one.counter,
        }
        for one in sightings
    ]


def _milliseconds(span_ns: int) -> float | None:
    return span_ns / NS_PER_MS if span_ns >= 0 else None
