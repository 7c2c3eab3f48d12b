"""What a driver without kept state has carried out, in the robot's shared memory: it outlives the process.

So a message that was answered gets the same answer again, and a command that was in hand is not begun a second time: its sender
is told that it may have been carried out. A robot that boots has forgotten all of it, and its devices begin anew, too.

Each record is framed as those of `failover.drivers.posts_file`, with its content in msgpack. The file is written anew when a
process begins with it, when most of it is over, and when records are missing in it, as the memory was full. It is open only while
something is written: a capture seldom finds it open.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

import msgspec
from msgspec import UNSET, Struct

from checkpoint.errors import UNDECODABLE
from failover.core.messaging.envelope import Envelope, Fault
from failover.core.messaging.mailbox import NO_ANSWER, SENDERS_MAX, WINDOW, Key, Stream, key_of
from failover.drivers.posts_file import framed, record_at

TIDY_SIZE: Final = 512 << 10
"""Bytes of a file that is not written anew, however little of it still counts."""

ANSWER_SIZE_MAX: Final = 4 << 10
"""Bytes of an answer that is kept: the picture of a camera is asked for again instead."""

ANSWERS_SIZE_MAX: Final = 1 << 20
"""The same of all answers together, the newest first; of the others small ones are kept."""

SMALL: Final = 512
ASKED_MAX: Final = 4_096
"""Queries with large answers that are known as such."""

RETRY_S: Final = 1.0
"""From a time when the file could not be written anew to the next."""

ANSWER_LOST: Final = "answer_lost"
"""Kind of the error in place of an answer that is not kept."""

log = logging.getLogger("failover.drivers")


class Known(Struct, frozen=True, tag="known"):
    """Up to where the messages of a sender's life are over."""

    sender: str
    boot: int
    last: int


class Began(Struct, frozen=True, tag="began"):
    """A command that is carried out now."""

    sender: str
    boot: int
    seq: int
    id: str
    verb: str


class Over(Struct, frozen=True, tag="over"):
    """The answer to a message."""

    answer: Envelope


class Asked(Struct, frozen=True, tag="asked"):
    """A query was answered, and its answer is not kept: it may be asked again."""

    sender: str
    boot: int
    seq: int


_read: Final = msgspec.msgpack.Decoder(Known | Began | Over | Asked).decode
_written: Final = msgspec.msgpack.Encoder().encode


class CarriedOut:
    """The file of one driver; only its process uses it."""

    def __init__(self, path: Path, whose: str) -> None:
        """What an earlier process has left there, if it can be read. ``whose``: the driver, in what senders are told."""
        self._path, self._whose = path, whose
        self._began: dict[Key, Began] = {}
        self._in_hand: set[Key] = set()
        self.streams: OrderedDict[str, Stream] = OrderedDict()
        """For the mailbox of this process."""
        self.asked: OrderedDict[Key, None] = OrderedDict()
        """Queries that this mailbox takes again."""
        self._size = self._least = 0
        self._again_s = 0.0
        self._is_torn = self._is_behind = self._is_told = False
        try:
            self._load(path.read_bytes())
        except FileNotFoundError:
            pass
        except OSError as error:
            log.warning("%s cannot be read: %s; what %s has carried out before is forgotten", path, error.strerror, whose)
        for one in list(self._began.values()):
            sentence = f"{whose} ended while it carried out {one.verb}; it may have been carried out, and is not begun again"
            fault = Fault(NO_ANSWER, sentence)
            self._note(Over(Envelope(to=one.sender, re=one.id, boot=one.boot, seq=one.seq, error=fault)))
        for stream in self.streams.values():
            stream.answers = dict(sorted(stream.answers.items())[-WINDOW:])
        self._write_anew(self.streams)

    def _load(self, content: bytes) -> None:
        at = 0
        while (found := record_at(content, at)) is not None:
            try:
                self._note(_read(found[0]))
            except UNDECODABLE:  # of another version of failover: it is as if the robot had booted
                log.warning("%s cannot be read; what %s has carried out before is forgotten", self._path, self._whose)
                self.streams.clear()
                self.asked.clear()
                self._began.clear()
                at = 0
                break
            at += len(framed(found[0], 0))
        self._size, self._is_torn = at, at < len(content)

    def _note(self, one: Known | Began | Over | Asked) -> None:
        if isinstance(one, Began):
            self._began[one.sender, one.boot, one.seq] = one
            return
        if isinstance(one, Known):
            sender, boot, last = one.sender, one.boot, one.last
        else:
            sender, boot, last = key_of(one.answer) if isinstance(one, Over) else (one.sender, one.boot, one.seq)
            self._began.pop((sender, boot, last), None)
        stream = self.streams.get(sender)
        if stream is None or boot > stream.boot:
            stream = self.streams[sender] = Stream(boot, answers={})
        if boot < stream.boot:
            return
        stream.last = stream.reliable = max(stream.last, last)
        self.streams.move_to_end(sender)
        if isinstance(one, Over):
            stream.answers[last] = one.answer
            self.asked.pop((sender, boot, last), None)
        elif isinstance(one, Asked):
            self._may_be_asked((sender, boot, last))
        if len(self.streams) > SENDERS_MAX:
            self.streams.popitem(last=False)

    def began(self, messages: Iterable[Envelope]) -> None:
        """These commands are carried out next."""
        named = [one for one in messages if one.seq and one.sender]
        self._in_hand.update((one.sender, one.boot, one.seq) for one in named)
        self._append([_written(Began(one.sender, one.boot, one.seq, one.id, one.verb[:64])) for one in named])

    def over(self, answers: Iterable[Envelope], streams: Callable[[], Mapping[str, Stream]]) -> None:
        """These answers have left. ``streams``: tells what the mailbox keeps, for a file that is to be written anew."""
        named = [one for one in answers if one.seq and one.to]
        for one in named:
            if (key := key_of(one)) in self._in_hand:
                self._in_hand.discard(key)
            elif len(_over(one)) > ANSWER_SIZE_MAX:
                self._may_be_asked(key)
            elif self.asked:
                self.asked.pop(key, None)
        self._append([self._kept(one) for one in named])
        has_grown = self._size > TIDY_SIZE and self._size > 2 * self._least
        if (has_grown or self._is_behind) and time.monotonic() >= self._again_s:
            self._write_anew(streams())

    def _may_be_asked(self, key: Key) -> None:
        self.asked[key] = None
        self.asked.move_to_end(key)
        if len(self.asked) > ASKED_MAX:
            self.asked.popitem(last=False)

    def _kept(self, answer: Envelope, limit: int = ANSWER_SIZE_MAX) -> bytes:
        record = _over(answer)
        if len(record) <= limit:
            return record
        if (key := key_of(answer)) in self.asked:
            return _written(Asked(*key))
        sentence = f"{self._whose} has carried it out; its answer of {len(record)} bytes was lost with its process"
        return _over(msgspec.structs.replace(answer, ok=UNSET, error=Fault(ANSWER_LOST, sentence)))

    def _append(self, records: list[bytes]) -> None:
        if not records:
            return
        content = b"".join(framed(one, 0) for one in records)
        try:
            descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                if self._is_torn:  # what stands behind half a record is not read
                    os.ftruncate(descriptor, min(self._size, os.fstat(descriptor).st_size))
                written = os.write(descriptor, content)
                self._is_torn = written < len(content)
            finally:
                os.close(descriptor)
        except OSError as error:
            self._lacks(error.strerror)
            return
        if self._is_torn:
            self._lacks("it is full")
        else:
            self._size += len(content)

    def _lacks(self, why: str | None) -> None:
        """The file misses something; a driver that acts on is worth more than one that does not."""
        self._is_behind = True
        if not self._is_told:
            self._is_told = True
            log.warning("%s cannot be written: %s; until it can, a command may come twice after a kill", self._path, why)

    def _write_anew(self, streams: Mapping[str, Stream]) -> None:
        records: list[bytes] = []
        left = ANSWERS_SIZE_MAX
        for sender, stream in reversed(list(streams.items())):
            records.append(_written(Known(sender, stream.boot, stream.last)))
            for answer in reversed(stream.answers.values()):
                records.append(self._kept(answer, ANSWER_SIZE_MAX if left > 0 else SMALL))
                left -= len(records[-1])
        content = b"".join(framed(one, 0) for one in (*reversed(records), *self._unanswered(streams)))
        new = self._path.with_suffix(".new")
        try:
            new.unlink(missing_ok=True)
            with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "wb") as file:
                file.write(content)
            new.rename(self._path)
        except OSError as error:
            with contextlib.suppress(OSError):
                new.unlink(missing_ok=True)
            self._again_s = time.monotonic() + RETRY_S
            self._lacks(error.strerror)
            return
        self._size = self._least = len(content)
        self._is_torn = self._is_behind = False

    def _unanswered(self, streams: Mapping[str, Stream]) -> list[bytes]:
        """Queries that an earlier process has answered, and that have not been asked again."""
        for key in [key for key in self.asked if key[0] not in streams or streams[key[0]].boot != key[1]]:
            del self.asked[key]
        return [_written(Asked(*key)) for key in self.asked if key[2] not in streams[key[0]].answers]


def _over(answer: Envelope) -> bytes:
    return _written(Over(msgspec.structs.replace(answer, hops=())))
