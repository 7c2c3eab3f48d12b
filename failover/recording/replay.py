"""A recording put back on a board: each value at its time, with the age that it had.

The recorded robot that has the board's name is this robot: its items are items of the board. The others are other robots, each
with a file as an agent makes it, so that programs read them as they do in a team. On an agent's board nothing is done so: there
all items become private items of this robot with other names.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from msgspec import Struct
from msgspec.structs import replace

from failover.boards import boottime, directory
from failover.boards.board import Board, board, is_alike
from failover.boards.directory import PRIVATE_NAME
from failover.boards.received import ReceivedItems
from failover.core.board import ages, layout, recording
from failover.core.board.item_types import parse
from failover.core.board.items import BLOCK_SIZE_MAX, Item
from failover.core.board.layout import Wanted
from failover.core.board.recording import Channel, Coder, Put
from failover.core.frames.frame import Portion
from failover.errors import BoardError, ItemError, RecordingError
from failover.recording.follower import Choice
from failover.recording.mcap_file import Recorded
from failover.recording.stream import Endable

NAME: Final = "failover board replay"
"""Of this program among the board's users."""
TURN_S: Final = 0.1
"""What a turn of a replay takes at least that begins again and again, also where all was recorded in one instant."""
ROOM_LEFT: Final = 4
"""One of so many parts of an agent's table stays free for programs."""


class Contents(Struct):
    """What the chosen channels of the files hold, after a look at all of them.

    Attributes:
        here: the robot that recorded; "": the files do not say.
        first_ns, last_ns: log times of the first and the last message.
        lost: sentences on what the files have not, and on channels that are left out.
    """

    channels: dict[str, Channel] = {}
    puts: int = 0
    here: str = ""
    first_ns: int = 0
    last_ns: int = 0
    lost: list[str] = []


class _Message(Struct, frozen=True):
    """One message: of a channel of the board, or of the robots' states (``channel`` None)."""

    channel: Channel | None
    topic: str
    log_ns: int
    age_ns: int
    content: bytes


class Source:
    """The files of a recording, one behind the other."""

    def __init__(self, paths: Sequence[Path], choice: Choice) -> None:
        self._files = [Recorded(path) for path in paths]
        self._choice = choice

    def examined(self) -> Contents:
        """Look at every message, before any is played.

        Raises:
            RecordingError: no channel is a board's, one is declared in two ways, or a file is of another version or damaged.
            BoardError: nothing in them is chosen.
        """
        found = Contents({}, lost=[])
        known: set[tuple[str, str]] = set()
        refused: dict[str, str] = {}
        for message in self.messages(known, refused):
            if message.channel is None:
                found.here = found.here or recording.read_robots(message.content).here
                continue
            before = found.channels.setdefault(message.topic, message.channel)
            if before is not message.channel and before.declared != message.channel.declared:
                raise RecordingError(f"{message.topic} is declared in two ways in these files; replay them one after the other")
            found.puts += 1
            found.first_ns = min(found.first_ns, message.log_ns) if found.puts > 1 else message.log_ns
            found.last_ns = max(found.last_ns, message.log_ns)
        names = ", ".join(str(file.path) for file in self._files)
        if not known and not refused:
            raise RecordingError(f"{names}: no item of a board is recorded there; failover board record makes such files")
        if refused and not found.channels:
            raise RecordingError(next(iter(refused.values())))
        self._choice.check(known)
        if not found.channels:
            raise BoardError(f"{names}: no item is chosen: none of the robots in --robots has one of --items")
        found.lost = [said for file in self._files if (said := file.loss.sentence(file.path))]
        found.lost += [f"{said}; {topic} is left out" for topic, said in refused.items()]
        found.here = found.here or next(iter(found.channels.values())).robot
        return found

    def messages(self, known: set[tuple[str, str]] | None = None, refused: dict[str, str] | None = None) -> Iterator[_Message]:
        """The chosen messages of items, and those of the robots' states.

        Args:
            known: is filled with all robots and items. refused: with the topics of chosen channels that cannot be read, and why.
        """
        known = set() if known is None else known
        refused = {} if refused is None else refused
        for file in self._files:
            channels: dict[int, Channel | None] = {}
            for _, channel, message in file.messages():
                if channel.id not in channels:
                    channels[channel.id] = self._channel(file.path, channel, known, refused)
                one = channels[channel.id]
                if one is None and channel.topic != recording.ROBOTS_TOPIC:
                    continue
                age_ns = max(message.log_time - message.publish_time, 0)
                yield _Message(one, channel.topic, message.log_time, age_ns, message.data)

    def _channel(self, path: Path, said: Any, known: set[tuple[str, str]], refused: dict[str, str]) -> Channel | None:
        """A channel of a chosen item; None: it is another one."""
        metadata = said.metadata
        if recording.FORMAT_KEY not in metadata:
            return None
        robot, item = metadata.get("robot", ""), metadata.get("item", "")
        if robot.isprintable() and item.isprintable():  # others are in no sentence
            known.add((robot, item))
        if not self._choice.has(robot, item):
            return None
        try:
            return recording.read_channel(metadata)
        except RecordingError as error:
            refused.setdefault(said.topic[:80], f"{path}: {error}")
            return None


# --- Where values go -------------------------------------------------------------------------------------------------


class Target(Protocol):
    """Takes the values of one channel."""

    def put(self, octets: bytes, age_ns: int, error_us: int) -> None: ...


class _OwnItem:
    """An item of this robot."""

    def __init__(self, board: Board, wanted: Wanted, shared: bool) -> None:
        """Raises: BoardError: it is declared otherwise, or another process writes it."""
        self._board = board
        try:
            item = Item(
                wanted.name,
                parse(wanted.text),
                shared=shared,
                period=wanted.period,
                phase=wanted.phase,
                bound_ms=wanted.bound_ns / 1_000_000,
                banks=wanted.banks,
                finite=bool(wanted.flags & layout.FINITE),
                urgent=bool(wanted.flags & layout.URGENT),
            )
        except ItemError as error:
            raise BoardError(f"cannot add item {wanted.name!r}: {error}") from None
        self.was_there = board.has(wanted.name, board.robot)
        board.add(item)
        self.name = wanted.name
        self._writer = board.writer(wanted.name)
        self._writer.ready()

    def put(self, octets: bytes, age_ns: int, error_us: int) -> None:
        writer, _ = self._writer.ready()
        writer.store(octets, max(boottime.now_ns(self._board.skew_ns) - age_ns, 0), error_us)


class _Peer:
    """Another robot: its file, and all its items."""

    def __init__(self, place: Path, robot: str, rank: int) -> None:
        directory.dismiss(place / f"{directory.PEER_PREFIX}{robot}")
        self.received = ReceivedItems(directory.make_peer(place, robot, rank=rank, state=layout.RUN))
        self._ids: set[int] = set()

    def add(self, wanted: Wanted) -> int:
        """An item; its number here."""
        number = wanted.id
        while number in self._ids:
            number += 1
        self._ids.add(number)
        self.received.change((), (replace(wanted, id=number, flags=wanted.flags | layout.ADDED),))
        return number


class _PeerItem:
    """An item of another robot."""

    def __init__(self, peer: _Peer, wanted: Wanted, skew_ns: int) -> None:
        self._peer = peer
        self._number = peer.add(wanted)
        self._skew_ns = skew_ns
        self._puts = 0

    def put(self, octets: bytes, age_ns: int, error_us: int) -> None:
        self._puts += 1
        now_ns = boottime.now_ns(self._skew_ns)
        age_us = min(age_ns // ages.NS_PER_US, ages.AGE_MAX_US)
        came_ns = now_ns - (age_ns % ages.NS_PER_US if age_us < ages.AGE_MAX_US else 0)
        self._peer.received.heard(now_ns)
        self._peer.received.take((Portion(self._number, age_us, self._puts, octets),), came_ns, error_us, 0)


class Stage:
    """A board on which a recording is played, with all its items; a context manager.

    Attributes:
        notes: sentences for the person who replays.
    """

    def __init__(self, place: Path, contents: Contents, prefix: str) -> None:
        """Find or make the board.

        Args:
            prefix: all items become private items ``PREFIX.ROBOT.ITEM``; "": see above.

        Raises:
            BoardError: it is an agent's, or another replay uses it.
        """
        self.notes: list[str] = []
        self.targets: dict[str, Target] = {}
        self._peers: dict[str, _Peer] = {}
        self._added: list[str] = []
        made, index = directory.enter(place.resolve(), NAME, contents.here)
        try:
            self.board = board(place, NAME)
        finally:
            directory.leave(place.resolve(), made, index)
        try:
            self._check(made.header.flags, prefix)
            self._fill(contents, prefix)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check(self, flags: int, prefix: str) -> None:
        place = self.board.directory
        other = next((pid for pid, _, name in self.board.users() if name == NAME and pid != os.getpid()), 0)
        if other:
            raise BoardError(
                f"pid {other} replays a recording on the board {place} already; end it first, or name another --board"
            )
        if not prefix and not flags & layout.ALONE:
            raise BoardError(
                f"the board {place} is an agent's: old values would stand there as those of {self.board.robot} and its team; "
                f"give --board {directory.SHARED_MEMORY}/NAME for a board of its own, or --as PREFIX for items with other names"
            )

    def _make_room(self, contents: Contents, prefix: str) -> None:
        """Remove what a replay that was killed has left under this prefix, and is not wanted again.

        Raises:
            BoardError: too little room would be left for programs: the row of an item that was removed is not used again.
        """
        wanted = {_prefixed(prefix, channel): channel.wanted for channel in contents.channels.values()}
        file = next(file for file in self.board.ensured().files if file.path.name == PRIVATE_NAME)
        for record in file.records():
            is_ours = record.flags & layout.ADDED and record.name.startswith(f"{prefix}.")
            if not is_ours or record.name.count(".") < prefix.count(".") + 2:
                continue
            if record.name in wanted and is_alike(record, wanted[record.name]):
                self._added.append(record.name)
                del wanted[record.name]
                continue
            with contextlib.suppress(BoardError):  # a program writes it: it is that program's
                self.board.writer(record.name).ready()
                self.board.remove(record.name)
        header = file.read_header()
        rows = header.capacity - header.count - len(wanted)
        octets = sum(one.banks * layout.aligned(layout.BANK_HEAD + one.size) for one in wanted.values())
        left = BLOCK_SIZE_MAX - header.file_size - octets
        if wanted and (rows < header.capacity // ROOM_LEFT or left < BLOCK_SIZE_MAX // ROOM_LEFT):
            raise BoardError(
                f"the board {self.board.directory} has room for {header.capacity - header.count} private items and "
                f"{BLOCK_SIZE_MAX - header.file_size} bytes; {len(wanted)} of {octets} bytes would leave less than a quarter of "
                "the table, and what a replay has used is free only when the agent begins anew: start the agent anew, choose "
                f"fewer with --items, or give --board {directory.SHARED_MEMORY}/NAME for a board of its own"
            )

    def _fill(self, contents: Contents, prefix: str) -> None:
        """Make every item; those of this robot first, because another process may write one of them."""
        if prefix:
            self._make_room(contents, prefix)
        here = self.board.robot
        own = [one for one in contents.channels.values() if prefix or one.robot == here]
        others = [one for one in contents.channels.values() if not prefix and one.robot != here]
        for channel in own:
            name = _prefixed(prefix, channel) if prefix else channel.wanted.name
            item = _OwnItem(self.board, replace(channel.wanted, name=name), not (prefix or channel.private))
            self.targets[channel.topic] = item
            if prefix and not item.was_there:
                self._added.append(name)
        for rank, robot in enumerate(sorted({one.robot for one in others}), 1):
            self._peers[robot] = _Peer(self.board.directory, robot, rank)
        for channel in others:
            self.targets[channel.topic] = _PeerItem(self._peers[channel.robot], channel.wanted, self.board.skew_ns)
        if not own:
            self.notes.append(f"this board is {here}'s: {contents.here}, which recorded, is another robot on it")

    def tell_robots(self, content: bytes) -> None:
        """States of the other robots, as they were recorded."""
        for robot in recording.read_robots(content).robots:
            peer = self._peers.get(robot.name)
            if peer is not None and robot.state in layout.STATES:
                peer.received.tell_state(layout.STATES.index(robot.state))
                if robot.age_us >= 0:
                    heard_ns = boottime.now_ns(self.board.skew_ns) - robot.age_us * ages.NS_PER_US
                    peer.received.heard(max(heard_ns, 0))

    def close(self) -> None:
        """The other robots are not there any more; what has a prefix is removed; the board goes with its last user."""
        for peer in self._peers.values():
            peer.received.tell_state(layout.NOT)
            peer.received.file.close()
        for name in self._added:
            with contextlib.suppress(BoardError):
                self.board.remove(name)
        self.board.close()


def _prefixed(prefix: str, channel: Channel) -> str:
    return f"{prefix}.{channel.robot}.{channel.wanted.name}"


class Player(Endable):
    """Plays a recording on a stage."""

    def __init__(self, source: Source, contents: Contents, stage: Stage, pace: float) -> None:
        self._source = source
        self._contents = contents
        self._stage = stage
        self._pace = pace
        self._coders = {topic: Coder(channel) for topic, channel in contents.channels.items()}
        self.puts = 0

    def run(self, least_s: float = 0.0) -> None:
        """Play it once, which takes ``least_s`` at least.

        Raises:
            RecordingError: a message is damaged; what came before it is played.
            BoardError: the board is another one now, or an item is.
        """
        begin_s = time.monotonic()
        for message in self._source.messages():
            due_s = begin_s + (message.log_ns - self._contents.first_ns) / 1e9 / self._pace
            self.sleep_until(due_s)
            if self.is_ended:
                return
            if message.channel is None:
                self._stage.tell_robots(message.content)
                continue
            target = self._stage.targets.get(message.topic)
            if target is None:
                continue  # the file is another one than it was when it was examined
            put: Put = recording.read_put(message.content, message.topic)
            octets = self._coders[message.topic].octets_of(put)
            target.put(octets, message.age_ns, put.error_us)
            self.puts += 1
        self.sleep_until(begin_s + least_s)
