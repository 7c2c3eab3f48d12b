"""What a driver without kept state has carried out, in the robot's shared memory: it outlives the process.

So a message that was answered gets the same answer again, and a command that was in hand is not begun a second time: its sender
is told that it may have been carried out. A robot that boots has forgotten all of it, and its devices begin anew, too.

Each record is framed as those of `failover.drivers.posts_file`, with its content in msgpack. The file is written anew when a
process begins with it, and when most of it is over. It is open only while something is written: a capture does not find it open.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

import msgspec
from msgspec import UNSET, Struct

from checkpoint.errors import UNDECODABLE
from failover.core.messaging.envelope import Envelope, Fault
from failover.core.messaging.mailbox import NO_ANSWER, SENDERS_MAX, WINDOW, Stream
from failover.drivers.posts_file import framed, record_at

TIDY_SIZE: Final = 512 << 10
"""Bytes of a file that is not written anew, however little of it still counts."""

ANSWER_SIZE_MAX: Final = 4 << 10
"""Bytes of an answer that is kept: the picture of a camera is asked for again instead."""

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


_read: Final = msgspec.msgpack.Decoder(Known | Began | Over).decode
_written: Final = msgspec.msgpack.Encoder().encode


class CarriedOut:
    """The file of one driver; only its process uses it."""

    def __init__(self, path: Path, whose: str) -> None:
        """What an earlier process has left there, if it can be read. ``whose``: the driver, in what senders are told."""
        self._path, self._whose = path, whose
        self._began: dict[tuple[str, int, int], Began] = {}
        self.streams: OrderedDict[str, Stream] = OrderedDict()
        """For the mailbox of this process."""
        self._size = self._least = 0
        with contextlib.suppress(FileNotFoundError):
            self._load(path.read_bytes())
        for one in list(self._began.values()):
            sentence = f"{whose} ended while it carried out {one.verb}; it may have been carried out, and is not begun again"
            fault = Fault(NO_ANSWER, sentence)
            self._note(Over(Envelope(to=one.sender, re=one.id, boot=one.boot, seq=one.seq, error=fault)))
        self._write_anew(self.streams)

    def _load(self, content: bytes) -> None:
        at = 0
        while (found := record_at(content, at)) is not None:
            try:
                self._note(_read(found[0]))
            except UNDECODABLE:  # of another version of failover: it is as if the robot had booted
                log.warning("%s cannot be read; what %s has carried out before is forgotten", self._path, self._whose)
                self.streams.clear()
                self._began.clear()
                return
            at += len(framed(found[0], 0))

    def _note(self, one: Known | Began | Over) -> None:
        if isinstance(one, Began):
            self._began[one.sender, one.boot, one.seq] = one
            return
        sender, boot, last = (one.sender, one.boot, one.last) if isinstance(one, Known) else _of(one.answer)
        stream = self.streams.get(sender)
        if stream is None or boot > stream.boot:
            stream = self.streams[sender] = Stream(boot, answers={})
        stream.last = stream.reliable = last
        self.streams.move_to_end(sender)
        if isinstance(one, Over):
            self._began.pop((sender, boot, last), None)
            stream.answers[last] = one.answer
            if len(stream.answers) > WINDOW:
                del stream.answers[next(iter(stream.answers))]
        if len(self.streams) > SENDERS_MAX:
            self.streams.popitem(last=False)

    def began(self, messages: Iterable[Envelope]) -> None:
        """These commands are carried out next."""
        named = (one for one in messages if one.seq and one.sender)
        self._append([_written(Began(one.sender, one.boot, one.seq, one.id, one.verb[:64])) for one in named])

    def over(self, answers: Iterable[Envelope], streams: Callable[[], Mapping[str, Stream]]) -> None:
        """These answers have left. ``streams``: tells what the mailbox keeps, for a file that has grown."""
        self._append([self._kept(one) for one in answers if one.seq and one.to])
        if self._size > TIDY_SIZE and self._size > 2 * self._least:
            self._write_anew(streams())

    def _kept(self, answer: Envelope) -> bytes:
        answer = msgspec.structs.replace(answer, hops=())
        record = _written(Over(answer))
        if len(record) <= ANSWER_SIZE_MAX:
            return record
        fault = Fault(NO_ANSWER, f"{self._whose} has carried it out, and ended before its answer had arrived; ask again")
        return _written(Over(msgspec.structs.replace(answer, ok=UNSET, error=fault)))

    def _append(self, records: list[bytes]) -> None:
        if not records:
            return
        content = b"".join(framed(one, 0) for one in records)
        with contextlib.suppress(OSError):  # no room: after a kill these come twice, and a driver that acts on is worth more
            descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                self._size += os.write(descriptor, content)
            finally:
                os.close(descriptor)

    def _write_anew(self, streams: Mapping[str, Stream]) -> None:
        records = [
            record
            for sender, stream in streams.items()
            for record in (
                *(self._kept(one) for one in stream.answers.values()),
                _written(Known(sender, stream.boot, stream.last)),
            )
        ]
        content = b"".join(framed(one, 0) for one in records)
        new = self._path.with_suffix(".new")
        with contextlib.suppress(OSError):
            new.write_bytes(content)
            new.rename(self._path)
            self._size = self._least = len(content)


def _of(answer: Envelope) -> tuple[str, int, int]:
    return answer.to, answer.boot, answer.seq
