"""A board as a stream of messages, for a file or for programs that look on: each put once, with its age; the robots' states; the
decisions of their agents.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from msgspec import Struct

from failover.boards import boottime
from failover.boards.board import Board
from failover.core.board import recording
from failover.core.board.recording import Channel, Coder, Schema
from failover.errors import BoardError, FailoverError
from failover.recording.follower import Follower, Fresh

EACH_S: Final = 1.0
"""Between two messages of states and decisions, and two flushes: what a killed recorder loses at most."""
SLEEP_S: Final = 0.1
"""The longest sleep without a look at the signal that ends it."""
ASK_S: Final = 5.0
"""Between two questions for decisions, which are seldom: an answer takes each robot a look at its event log on the disk."""
LAST_ANSWER_S: Final = 3.0
"""For the decisions of the last seconds, at the end."""
MARGIN_MS: Final = 5_000
"""By how much questions overlap: a line comes late where its robot answers late."""

CODERS_MAX: Final = 65_536
"""Items whose coders are remembered: those that were removed are never asked for again."""

Ask = Callable[[int], Mapping[str, Any]]
"""``(age_ms_max)`` → the agent's answer to ``why``."""


Act = Callable[[], None]


def nothing() -> None:
    """The act of one who has nothing to do then."""


class Sink(Protocol):
    """Where messages go."""

    def channel(self, topic: str, schema: Schema | None, metadata: Mapping[str, str]) -> int:
        """The number of a channel, which replaces an earlier one of its topic."""
        ...

    def add(self, channel: int, log_ns: int, publish_ns: int, sequence: int, content: bytes) -> None: ...


class Decisions:
    """Lines of the robots' event logs since the beginning, asked for by a thread: other robots may take long to answer."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._since_s = time.time()
        self._begin_s = self._asked_s = time.monotonic()
        self._heard_s: dict[str, float] = {}
        self._known: set[tuple[object, ...]] = set()
        self._waiting: list[Mapping[str, Any]] = []
        self._lock = threading.Lock()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="decisions", daemon=True)
        self.complaint = ""

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Ask once more, and end."""
        self._is_over.set()
        self._thread.join(LAST_ANSWER_S)
        if self._thread.is_alive():
            self.complaint = f"the agent has not answered the last question within {LAST_ANSWER_S:g} s"

    def taken(self) -> list[Mapping[str, Any]]:
        """Lines that were not given yet."""
        with self._lock:
            lines, self._waiting = self._waiting, []
        return lines

    def _run(self) -> None:
        while not self._is_over.wait(ASK_S):
            self._look()
        self._look()

    def _look(self) -> None:
        asked_s, since_s = time.monotonic(), self._asked_s
        try:
            answer = self._ask(round((asked_s - since_s) * 1000) + MARGIN_MS)
            behind_s = min(map(self._heard_until, _answered(answer)), default=since_s)
            if behind_s < since_s:  # a robot that was cut off is back: what it decided meanwhile
                since_s = behind_s
                answer = self._ask(round((asked_s - since_s) * 1000) + MARGIN_MS)
        except (FailoverError, OSError) as error:
            self.complaint = str(error)
            return
        self.complaint, self._asked_s = "", asked_s
        self._heard_s |= {robot: asked_s for robot in _answered(answer) if self._heard_until(robot) >= since_s}
        fresh = []
        for line in answer.get("story") or ():
            key = (line.get("robot"), line.get("life"), line.get("number"))
            if key not in self._known and (line.get("at") or 0) >= self._since_s:
                self._known.add(key)
                fresh.append(line)
        with self._lock:
            self._waiting += fresh

    def _heard_until(self, robot: str) -> float:
        """By the monotonic clock: a robot's decisions before it are known."""
        return self._heard_s.get(robot, self._begin_s)


def _answered(answer: Mapping[str, Any]) -> list[str]:
    """The robots of an answer to ``why`` that have answered."""
    return [str(one.get("robot")) for one in answer.get("robots") or () if one.get("answered")]


class Counts(Struct):
    """What went through.

    Attributes:
        missed: puts that were replaced between two looks.
        pauses: sentences on spans in which there was no board.
        misfits: sentences on items that are declared as a type which their values do not have.
    """

    robots: set[str]
    items: set[str]
    pauses: list[str]
    misfits: set[str]
    puts: int = 0
    missed: int = 0
    decisions: int = 0


class Endable:
    """An act that takes its time, and is over soon after it ``is_ended``."""

    is_ended = False

    def end(self) -> None:
        """Also in a signal's function."""
        self.is_ended = True

    def sleep_until(self, instant_s: float) -> None:
        """Until an instant of `time.monotonic`, or the end."""
        while not self.is_ended and (left_s := instant_s - time.monotonic()) > 0:
            time.sleep(min(left_s, SLEEP_S))


class Stream(Endable):
    """Looks at a board, and says to a sink what is new."""

    def __init__(self, board: Board, follower: Follower, sink: Sink, decisions: Decisions | None = None) -> None:
        self._board = board
        self._follower = follower
        self._sink = sink
        self._decisions = decisions
        self._origin_ns = time.time_ns() - boottime.now_ns(board.skew_ns)
        self._coders: dict[int, tuple[object, Coder, int]] = {}
        self._channels: dict[str, tuple[Channel | None, int]] = {}
        self._pause = ""
        self.counts = Counts(set(), set(), [], set())

    def begin_anew(self, sink: Sink) -> None:
        """Another sink, which gets the newest value of each item."""
        self._sink = sink
        self._channels, self._coders = {}, {}
        self._follower.again()

    def run(self, rate: float, span_s: float | None, each_second: Act = nothing, each_look: Act = nothing) -> None:
        """Look so many times a second, until the end; ``span_s`` None: until `is_ended`.

        Args:
            each_second: after the states of the robots were said. each_look: before it.
        """
        begin_s = look_s = each_s = time.monotonic()
        end_s = None if span_s is None else begin_s + span_s
        if self._decisions is not None:
            self._decisions.start()
        while not self.is_ended and (end_s is None or look_s < end_s):
            each_look()
            self._look()
            if look_s >= each_s:
                self._say_robots()
                self._say_decisions()
                each_second()
                each_s = look_s + EACH_S
            look_s = max(look_s + 1 / rate, time.monotonic())
            self.sleep_until(look_s if end_s is None else min(look_s, end_s))
        self._look()
        if self._decisions is not None:
            self._decisions.stop()
            self._say_decisions()

    def _look(self) -> None:
        try:
            for fresh in self._follower.look():
                self._say_put(fresh)
        except BoardError as error:
            if not self._pause:
                self.counts.pauses.append(str(error))
            self._pause = str(error)
            return
        self._pause = ""

    def _say_put(self, fresh: Fresh) -> None:
        known = self._coders.get(id(fresh.place))
        if known is None or known[0] is not fresh.place:
            if len(self._coders) >= CODERS_MAX:
                self._coders.clear()
            known = self._coders[id(fresh.place)] = (fresh.place, *self._line(fresh))
        _, coder, channel = known
        age_ns, number = fresh.age_ns, fresh.found.number
        put = coder.put_of(fresh.found.value, number, age_ns, fresh.age_max_ns, fresh.is_stale)
        log_ns = self._origin_ns + fresh.now_ns
        self._sink.add(channel, log_ns, log_ns - age_ns, number, recording.encode(put))
        self.counts.puts += 1
        self.counts.missed += fresh.missed
        self.counts.robots.add(fresh.robot)
        self.counts.items.add(fresh.record.name)

    def _line(self, fresh: Fresh) -> tuple[Coder, int]:
        """How values of an item are said, and the number of its channel."""
        channel = recording.channel_of(fresh.robot, fresh.record, fresh.private)
        if why := recording.misfit_of(fresh.record):
            said = f"item {fresh.record.name!r} of {fresh.robot} is told as bytes: {why}; its declaration is wrong"
            if said not in self.counts.misfits:
                self.counts.misfits.add(said)
                self._follower.tell(said)
        declared, number = self._channels.get(channel.topic, (None, 0))
        if declared != channel.declared:
            number = self._sink.channel(channel.topic, recording.item_schema(channel), recording.metadata_of(channel))
            self._channels[channel.topic] = (channel.declared, number)
        return Coder(channel), number

    def _say_robots(self) -> None:
        if self._pause:
            return  # to ask for them would make a board
        with contextlib.suppress(BoardError):
            robots = tuple(
                recording.Robot(name, one.state, -1 if one.age_ns is None else one.age_ns // 1000, one.rank)
                for name, one in self._follower.robots().items()
            )
            said = recording.Robots(self._board.robot, robots)
            self._say(recording.ROBOTS_TOPIC, recording.ROBOTS_SCHEMA, recording.encode(said), 0)

    def _say_decisions(self) -> None:
        for line in self._decisions.taken() if self._decisions is not None else ():
            age_ns = max(time.time_ns() - round(line["at"] * recording.NS_PER_S), 0)
            at_ns = self._origin_ns + boottime.now_ns(self._board.skew_ns) - age_ns
            self._say(recording.DECISIONS_TOPIC, recording.LOG_SCHEMA, recording.encode(recording.log_of(line, at_ns)), age_ns)
            self.counts.decisions += 1

    def _say(self, topic: str, schema: Schema, message: bytes, age_ns: int) -> None:
        """A message of a channel that is no item's."""
        if topic not in self._channels:
            self._channels[topic] = (None, self._sink.channel(topic, schema, {}))
        log_ns = self._origin_ns + boottime.now_ns(self._board.skew_ns)
        self._sink.add(self._channels[topic][1], log_ns, log_ns - age_ns, 0, message)
