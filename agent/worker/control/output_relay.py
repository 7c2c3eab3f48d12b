"""Passes a component's output on to a client, from the robot that has it.

While the component runs, its standby has every byte that no takeover can take back, so the standby answers by itself. The end of
the output, and any request to a robot without checkpoints, is read at the robot where the component runs or ran, piece by piece.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final, Protocol

from msgspec import Struct

from agent.config import Settings
from agent.errors import RefusedError
from agent.guard.output_logs import STREAMS, OutputLogs
from agent.guard.output_times import Times
from agent.main_loop.messages import Told
from agent.system import clock
from agent.system.permissions import ROOT, check_right
from agent.worker.components.paths import Places, log_directory
from agent.worker.components.supervisor import Supervisor
from agent.worker.control.arguments import PieceArguments, arguments_of
from agent.worker.control.rights_gate import RightsGate
from agent.worker.control.server import Conversation
from agent.worker.network.remote_orders import Errands
from checkpoint.model import OutputPiece
from failover.core.types import ENDED, ComponentView, PeerView, State

POLL_S: Final = 0.02
"""How soon new output is passed on to a client that watches."""

POLL_ELSEWHERE_S: Final = 0.2
"""The same where another robot has the output: each look is a question to it."""

PIECE_SIZE: Final = 128 << 10
"""Bytes read from another robot at a time: less than the replication link's largest message."""

CHECK_S: Final = 1.0
"""How long a client that watches reads on by a right that it may have lost."""

Check = Callable[[], Awaitable[bool]]
"""Whether a rule lets the client read on; raises `RefusedError` where the rules say no. False: there are no rules."""

LIVING: Final = ("alive", "suspect")


class Worker(Protocol):
    """What of `agent.worker.process.Worker` is needed here."""

    settings: Settings
    places: Places
    supervisors: dict[str, Supervisor]
    errands: Errands

    async def ask(self, what: Any) -> Told: ...


Instants = tuple[tuple[int, int], ...]
"""When bytes were written: see `agent.guard.output_times.Times.of`."""


class Passage(Struct, frozen=True):
    """What a client wants of both streams.

    Attributes:
        offsets: from which on; below zero from the end.
        committed: only what no takeover can take back; all of it once it has ended.
        since_ms: not what is older, and nothing before the offsets; 0: of any age.
        times: with the instants at which it was written.
    """

    offsets: tuple[int, int] = (0, 0)
    committed: bool = True
    follow: bool = False
    since_ms: int = 0
    times: bool = False


class Part(Struct, frozen=True):
    """One piece of one stream, as it is asked for."""

    name: str
    stream: int
    offset: int
    committed: bool
    since_ms: int
    times: bool


class OutputRelay:
    """Reads streams, here or elsewhere."""

    def __init__(self, worker: Worker, gate: RightsGate | None = None) -> None:
        self._worker = worker
        self._gate = gate

    async def pass_on(self, say: Conversation, name: str, wanted: Passage, check: Check | None = None) -> tuple[int, int]:
        """Send what is wanted of the streams; with ``follow`` until the component's end is a record.

        Args:
            check: asked again and again whether a rule lets this user read it, with any owner; raises where it does not.

        Raises:
            RefusedError: another robot has them, and went away; or the user may not read on.
        """
        at = dict(zip(STREAMS, wanted.offsets, strict=True))
        since = dict.fromkeys(STREAMS, wanted.since_ms)
        now_s, permitted, again_s = asyncio.get_running_loop().time, False, 0.0
        while True:
            if check is not None and now_s() >= again_s:
                permitted, again_s = await check(), now_s() + CHECK_S
            over, elsewhere = await self._standing(name)
            whole = over or not wanted.committed or (not wanted.follow and await self._has_ended(name))
            sent = False
            for stream in STREAMS:
                part = Part(name, stream, at[stream], not whole, since[stream], wanted.times)
                piece, times = await self._read(elsewhere, part, say.caller.uid, permitted)
                if since[stream]:
                    at[stream], since[stream] = piece.offset, 0
                if piece.content:
                    await say.output(stream, piece.offset, piece.content, times)
                    at[stream] = piece.offset + len(piece.content)
                    sent = True
            if not sent and (over or not wanted.follow):
                return max(at[1], 0), max(at[2], 0)
            if not sent:
                await asyncio.sleep(POLL_ELSEWHERE_S if elsewhere else POLL_S)

    async def piece(self, arguments: dict[str, Any], by: int) -> dict[str, Any]:
        """A piece of a stream for another robot: what is committed here, all of it once the component has ended."""
        wanted = arguments_of(PieceArguments, "piece", arguments)
        if wanted.stream not in STREAMS:
            raise RefusedError(f"piece: {wanted.stream} is no stream; 1 is standard output, 2 standard error")
        view, _ = await self._view(wanted.name)
        owner = view.owner if view is not None else None
        if self._gate is not None and self._gate.has_rules:
            await self._gate.check(by, "read", wanted.name, owner)
            by = ROOT
        else:
            check_right(by, wanted.name, owner)
        is_committed = not await self._has_ended(wanted.name)
        part = Part(wanted.name, wanted.stream, wanted.offset, is_committed, wanted.since_ms, wanted.times)
        piece, times = self._read_here(part, by)
        told = {"offset": piece.offset, "content": piece.content}
        return told | {"times": times} if wanted.times else told

    async def _read(self, robot: str, part: Part, by: int, permitted: bool) -> tuple[OutputPiece, Instants]:
        if not robot:
            return self._read_here(part, ROOT if permitted else by)
        question: dict[str, Any] = {"name": part.name, "stream": part.stream, "offset": part.offset}
        if part.since_ms or part.times:  # an agent of an earlier release knows neither
            question |= {"since_ms": part.since_ms, "times": part.times}
        told = await self._worker.errands.send(robot, "piece", question, by)
        times = tuple((int(offset), int(at_ns)) for offset, at_ns in told.get("times", ()))
        return OutputPiece(part.stream, told["offset"], told["content"]), times

    def _read_here(self, part: Part, by: int) -> tuple[OutputPiece, Instants]:
        """Raises RefusedError: these are still the logs of another user's component, which had the name before."""
        directory = log_directory(part.name, self._worker.places)
        logs = OutputLogs(directory)
        try:
            if logs.owner is not None:
                check_right(by, f"the output of {part.name} that is kept here", logs.owner)
            size, offset = logs.bounds(part.stream).size, part.offset
            if part.since_ms:
                offset = max(_since(directory, part, size), min(offset, size))
            piece = logs.read(part.stream, offset, PIECE_SIZE, committed=part.committed)
        finally:
            logs.close()
        if not part.times or not piece.content:
            return piece, ()
        return piece, tuple(Times(directory).of(part.stream, piece.offset, piece.offset + len(piece.content)))

    async def _standing(self, name: str) -> tuple[bool, str]:
        """Whether the component's end is a record, and the robot to ask for what it wrote; "" for this one."""
        supervisor = self._worker.supervisors.get(name)
        if supervisor is not None and supervisor.ended is not None and supervisor.ended.done():
            return True, ""
        if supervisor is not None and supervisor.component is not None:
            return False, ""
        view, peers = await self._view(name)
        return (view.state in ENDED, _where(view, peers)) if view is not None else (False, "")

    async def _has_ended(self, name: str) -> bool:
        """The core's word: status shows it, and peers hear it, before it is written and our own supervisor is told.

        Held output waits for the supervisor: then the end is on record at every robot that is heard.
        """
        view, _ = await self._view(name)
        if view is None or view.state not in ENDED:
            return False
        if not self._is_held(name) or view.primary != self._worker.settings.config.robot:
            return True
        supervisor = self._worker.supervisors.get(name)
        return supervisor is not None and supervisor.ended is not None and supervisor.ended.done()

    def _is_held(self, name: str) -> bool:
        logs = OutputLogs(log_directory(name, self._worker.places))
        try:
            return logs.is_held
        finally:
            logs.close()

    async def _view(self, name: str) -> tuple[ComponentView | None, tuple[PeerView, ...]]:
        """The component as this robot's core sees it, and the peers."""
        told = await self._worker.ask("status")
        if told.status is None:
            return None, ()
        return next((one for one in told.status.components if one.name == name), None), told.status.peers


def _where(view: ComponentView, peers: tuple[PeerView, ...]) -> str:
    """The living robot that has more of a component's output than this one; "" if there is none."""
    living = {peer.robot for peer in peers if peer.state in LIVING}
    holds = view.state is State.STANDBY and bool(view.positions)
    return view.primary if view.primary in living and not holds else ""


def _since(directory: Path, part: Part, size: int) -> int:
    """The offset from which on a stream was written within the last ``since_ms``; its end where nothing was."""
    since_ns = clock.wall_ns(clock.now_ns()) - part.since_ms * 1_000_000
    found = Times(directory).since(since_ns)
    return size if found is None else found[part.stream - 1]
