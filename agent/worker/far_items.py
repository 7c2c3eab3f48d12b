"""Items of robots of other sites: each robot asks each of those for what has changed, twice a second at most.

The question and its answer are an order on the replication link (`agent.worker.network.remote_orders`); heartbeats and frames do
not leave a site. A robot asks again only after the answer, so a cut leaves no queue: the first answer after it has the newest
values, or is the one that was under way. The question names the last answer that came. From that the asked robot knows which
puts the other one has.

The bound of an age is honest by the clock of the robot that asked alone: an answer left after its question did, so it was under
way for no longer than the whole took. Only declared items travel so; what a program adds while it runs stays at its site.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from pathlib import Path
from typing import Any, Final, Protocol

import msgspec
from msgspec import Struct, field

from agent.config import Settings
from agent.errors import RefusedError
from agent.main_loop.own_items import OwnFiles, OwnItems, own_items
from agent.system import clock
from agent.worker.network.remote_orders import CONTENT_MAX, ITEMS, Errands
from failover.boards import boottime, directory
from failover.boards.agents_file import AgentsFile
from failover.boards.mapping import USER_PREFIX, uid_of
from failover.boards.received import ReceivedItems
from failover.boards.unmapped_file import UnmappedFile
from failover.core.board import layout
from failover.core.board.ages import NO_ERROR_BOUND, NS_PER_US, bound_ns, sent_age_us
from failover.core.board.items import ITEMS_MAX
from failover.core.frames.frame import Portion
from failover.errors import BoardError, OvertakenError

ASK_S: Final = 0.5
"""Between two questions to one robot."""

ANSWER_S: Final = 0.4
"""Between two answers to one robot: one that comes sooner waits."""

ANSWERS_WAITING: Final = 4
"""For one robot; a question beyond that is refused."""

PUT_MAX: Final = 1 << 62
"""A number that is no put's."""

PATIENCE_S: Final = 10.0
"""For an answer on a link that loses packets."""

VALUES_MAX: Final = CONTENT_MAX * 3 // 4
"""Bytes of values in an answer; the rest goes with the next one."""

ITEM_HEAD: Final = 32
"""Bytes of an item in an answer besides its value, at most."""

SILENT_QUESTIONS: Final = 6
"""A robot that was not heard for so many questions may have left; it never counts as dead."""

OTHER_BOARD: Final = "{} has another [board] in its team.toml: its items are not read here; bring the same [board] to every robot"

UNFIT: Final = "items of {} are not read: {}; install the same release on both"

log = logging.getLogger("failover.lanes")


class Question(Struct, frozen=True):
    """What has changed since your answer ``got``? 0: I have nothing. ``board``: digest of our declarations."""

    got: int
    board: int = 0


class Answer(Struct, frozen=True):
    """Values that have changed, or a part of them.

    Attributes:
        number: of this answer, from 1 on; boot: life of the agent; board: digest of the declarations.
    """

    number: int
    boot: int
    board: int
    items: tuple[Portion, ...]


class Lines(Protocol):
    """What of `agent.worker.hub.Switchboard` is needed here."""

    settings: Settings
    errands: Errands

    def hindrance(self, peer: str) -> str: ...


class _Told(Struct):
    """What another robot has of this robot's items: item → put.

    Attributes:
        under_way: the puts of the answer ``number``.
        turn: item → the answer that had it last: what waits longest goes first.
    """

    has: dict[int, int] = field(default_factory=dict)
    under_way: dict[int, int] = field(default_factory=dict)
    number: int = 0
    turn: dict[int, int] = field(default_factory=dict)
    told_ns: int = 0


class _Far(Struct):
    """A robot that is asked. Instants are of the machine."""

    items: ReceivedItems
    got: int = 0
    boot: int = 0
    heard_ns: int = 0
    worst_ns: int = 0
    state: int = layout.NOT
    asks: asyncio.Task[None] | None = None


class FarItems:
    """Both sides: what this robot has of others, and others of it. Lives in the worker's loop."""

    def __init__(self, lines: Lines, place: Path, boot: int) -> None:
        """
        Args:
            place: of the board; boot: life of this agent.

        Raises:
            BoardError, OSError: it cannot be read.
        """
        self._lines = lines
        self._boot = boot
        self.dropped: Counter[str] = Counter()
        self._told: dict[str, _Told] = {}
        self._far: dict[str, _Far] = {}
        self._files: list[UnmappedFile] = []
        self._odd: set[str] = set()
        self._unfit: dict[str, str] = {}
        self.open(place)

    def open(self, place: Path) -> None:
        """Take the files of the board as they are now: the team has changed.

        Raises:
            BoardError, OSError: they cannot be read.
        """
        self.close()
        try:
            self._open(place)
        except (BoardError, OSError):
            self.close()
            raise
        self._told = {name: told for name, told in self._told.items() if name in self._far}
        self._odd &= set(self._far)
        self._unfit = {name: why for name, why in self._unfit.items() if name in self._far}

    def _open(self, place: Path) -> None:
        owners = AgentsFile(place).owners()
        self._files.append(UnmappedFile.open(place / directory.OWN_NAME))
        for uid in sorted({owner.uid for owner in (owners or {}).values() if owner.uid is not None}):
            with contextlib.suppress(OSError):  # told where heartbeats' items are read
                self._files.append(UnmappedFile.open(place / f"{USER_PREFIX}{uid}"))
        self._own: OwnItems | OwnFiles = own_items([(file, uid_of(file.path)) for file in self._files], owners, self.dropped)
        self._board = self._lines.settings.team.items().digest
        for name, robot in self._lines.settings.far.items():
            if robot.role == "robot":
                self._far[name] = _Far(ReceivedItems.open(place / f"{directory.PEER_PREFIX}{name}"))

    def close(self) -> None:
        """Let the files go."""
        for one in self._far.values():
            if one.asks is not None:
                one.asks.cancel()
            one.items.file.close()
        self._far.clear()
        for file in self._files:
            file.close()
        self._files.clear()

    def heard_ms(self, robot: str) -> int | None:
        """Since a robot's last answer; None: none came."""
        one = self._far.get(robot)
        return (_now_ns() - one.heard_ns) // 1_000_000 if one is not None and one.heard_ns else None

    def notes(self) -> list[str]:
        """What is wrong, for the status."""
        unfit = [UNFIT.format(robot, why) for robot, why in sorted(self._unfit.items())]
        return [*(OTHER_BOARD.format(robot) for robot in sorted(self._odd)), *unfit]

    # --- asking ---

    async def run(self) -> None:
        """Ask, as long as this robot lives."""
        while True:
            for robot, one in list(self._far.items()):
                if self._lines.hindrance(robot):
                    one.got = 0  # what was under way is lost with the connection
                elif one.asks is None or one.asks.done():
                    one.asks = asyncio.create_task(self._ask(robot, one))
                self._tell_state(one)
            await asyncio.sleep(ASK_S)

    async def _ask(self, robot: str, one: _Far) -> None:
        asked_ns = _now_ns()
        question = msgspec.to_builtins(Question(one.got, self._board))
        try:
            said = await self._lines.errands.send(robot, ITEMS, question, patience_s=PATIENCE_S)
            answer = msgspec.convert(said, Answer, builtin_types=(bytes,))
        except RefusedError as error:
            log.debug("no items of %s: %s", robot, error)
            return  # it knows what is here still
        except msgspec.ValidationError as error:
            self._unfit[robot] = str(error)
            return
        if self._far.get(robot) is not one:
            return
        try:
            self._take(robot, one, answer, asked_ns, _now_ns())
            self._unfit.pop(robot, None)
        except Exception as error:  # noqa: BLE001  no answer of another robot ends this worker, or the questions to it
            log.warning("items of %s: %s", robot, error)
            self._unfit[robot] = str(error)

    def _take(self, robot: str, one: _Far, answer: Answer, asked_ns: int, came_ns: int) -> None:
        """Put what an answer brought into that robot's file."""
        if answer.board != self._board:
            self._odd.add(robot)
            return
        self._odd.discard(robot)
        if answer.boot != one.boot:
            one.boot = answer.boot
            one.items.begin_life()
        way_ns = came_ns - asked_ns
        error_us = min(way_ns // NS_PER_US + 2, NO_ERROR_BOUND)  # the age was rounded, and the way is
        items = [item for item in answer.items if item.total == 0 and item.number < ITEMS_MAX and item.put < PUT_MAX]
        one.items.take(items, came_ns, error_us, 0)
        one.got, one.heard_ns = answer.number, came_ns
        one.items.heard(came_ns)
        one.worst_ns = max(way_ns, one.worst_ns - one.worst_ns // 100)
        round_ns, worst_ns = self._lines.settings.config.beat_ms * 1_000_000, one.worst_ns
        one.items.bound(lambda period: bound_ns(1, period * round_ns, worst_ns, int(ASK_S * 1e9), 1))
        self._tell_state(one)

    def _tell_state(self, one: _Far) -> None:
        if not one.heard_ns:
            return
        is_there = _now_ns() - one.heard_ns < SILENT_QUESTIONS * int(ASK_S * 1e9) + one.worst_ns
        state = layout.RUN if is_there else layout.REMOVE
        if state != one.state:
            one.state = state
            one.items.tell_state(state)

    # --- being asked ---

    async def told(self, robot: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Answer a robot of another site.

        Raises:
            RefusedError: it is none, or does not wait for answers, or its question is not understood.
        """
        if robot not in self._far:
            raise RefusedError(f"{robot} is no robot of another site: its items come in frames")
        try:
            question = msgspec.convert(arguments, Question)
        except msgspec.ValidationError as error:
            raise RefusedError(f"its question for items is not understood: {error}; same release there?") from error
        told = self._told.setdefault(robot, _Told())
        now_ns, pause_ns = _now_ns(), int(ANSWER_S * 1e9)
        wait_ns = max(told.told_ns + pause_ns - now_ns, 0)
        if wait_ns > ANSWERS_WAITING * pause_ns:
            raise RefusedError(f"{robot} asks for items more often than every {ANSWER_S:g} s")
        told.told_ns = now_ns + wait_ns
        if wait_ns:  # questions that came late come close together
            await asyncio.sleep(wait_ns / 1e9)
            if robot not in self._far:
                raise RefusedError(f"{robot} is no robot of another site any more")
        if question.got == told.number and told.number:
            told.has |= told.under_way
        elif question.got == 0:
            told.has = {}
        told.under_way = {}
        items = self._changed(told) if question.board in (0, self._board) else []
        told.number += 1
        for item in items:
            told.under_way[item.number] = item.put
            told.turn[item.number] = told.number
        answer = Answer(told.number, self._boot, self._board, tuple(items))
        built: dict[str, Any] = msgspec.to_builtins(answer, builtin_types=(bytes,))
        return built

    def _changed(self, told: _Told) -> list[Portion]:
        """The items with another newest put than that robot has, as far as they find room in one answer."""
        found: list[Portion] = []
        try:
            self._own.look(clock.now_ns())
            numbers = [number for number, one in self._own.records.items() if number < ITEMS_MAX and not one.flags & layout.ADDED]
            newest = self._own.newest(numbers)
        except (BoardError, OSError):
            return found
        changed = [(one, put) for one, put in newest if put and told.has.get(one.id) != put]
        changed.sort(key=lambda pair: told.turn.get(pair[0].id, 0))
        size = 0
        for record, put in changed:
            try:
                bank = self._own.get(record, put)
            except (OvertakenError, BoardError, OSError):
                continue
            if bank is None:
                continue
            size += len(bank.value) + ITEM_HEAD
            if size > VALUES_MAX:
                break
            found.append(Portion(record.id, sent_age_us(bank.stamp_ns, _now_ns()), bank.number, bank.value))
        return found


def _now_ns() -> int:
    """BOOTTIME of the machine, as the stamps of the board's files have it."""
    return clock.now_ns() - boottime.skew_ns()
