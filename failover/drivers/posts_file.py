"""What a program has posted and has no answer to, in a file: it outlives the program, which sends it when it runs again.

A record is written for each message that is posted, before `failover.proxy`'s ``post`` returns, and for each that is over. The
file is written anew when it is opened, and when most of it is over. Each record: the size of its content (four bytes,
little-endian); how many bytes of the file were safe on the disk by then (eight); the XXH3 of these twelve bytes and the
content, eight; the content in msgpack, a `Begun` first.

A power cut leaves what was not safe in any form: cut, zeros, some of its blocks. What cannot be read there is left out, and what
follows it: no `post` has returned for a message in it. Where it was safe, the file is damaged.

Source: rename(2), fdatasync(2); doc/xxhash_spec.md of xxHash.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

import msgspec
import xxhash
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.boards import locks
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import INTEGER_MAX, Envelope, Hop
from failover.core.messaging.mailbox import Outgoing, Waiting
from failover.errors import DriverError, EnvelopeError

FOLDER: Final = "FAILOVER_STATE"
"""The variable that names the folder, as for a kept state without an agent; else it is the working directory."""

TIDY_SIZE: Final = 256 << 10
"""Bytes of a file that is not written anew, however little of it still counts."""

NAME_MAX: Final = 200
"""Bytes of a file's name, with room for an ending. Source: a file system's 255."""

_NUMBERS: Final = struct.Struct("<IQ")
_HEAD: Final = _NUMBERS.size + 8
_BEGINS: Final = b"\xa4type"
"""How the content of each record begins, after the byte of its map. Source: the msgpack specification."""

_LOCK_AT: Final = 0
NS: Final = 1_000_000_000


Number = Annotated[int, msgspec.Meta(ge=0, lt=INTEGER_MAX)]


class Begun(Struct, frozen=True, tag="begun"):
    """The sender's life, and how many messages it had posted when the file was written. ``path``: of the driver."""

    sender: str
    path: str
    boot: Number
    seq: Number


class Posted(Struct, frozen=True, tag="posted"):
    """A message. ``until_s``: its deadline in seconds since 1970: no other clock outlives a machine's boot; None: it has none."""

    message: Envelope
    until_s: float | None


class Over(Struct, frozen=True, tag="over"):
    """The message of this number has its answer, or has expired."""

    seq: Number


_read: Final = msgspec.msgpack.Decoder(Begun | Posted | Over).decode
_written: Final = msgspec.msgpack.Encoder().encode


class PostsFile:
    """The file of one sender to one driver; used under its `Sending`'s lock."""

    def __init__(self, sender: str, path: str, boot: int, now_ns: int) -> None:
        """
        Args:
            boot: of a sender that has no file, or one in which nothing waits.
            now_ns: by the clock of the outbox's deadlines.

        Raises:
            DriverError: it cannot be read or written, is damaged, or another process has it.
        """
        self._descriptor = self._lock = -1
        self._whose = sender, path
        self._waiting: dict[int, bytes] = {}
        self._size = 0
        self._safe = 0
        """Bytes that outlive a power cut."""
        self._is_behind = False
        """Whether the file lacks that a message is over."""
        try:
            self.path = place_of(sender, path)
        except OSError as error:
            raise DriverError(
                f"cannot keep what is posted in the working directory: {error.strerror}; {FOLDER} names another folder"
            ) from error
        _OPEN.add(self)
        try:
            self._lock = os.open(self.path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise self._refused(error) from error
        try:
            if not locks.take(self._lock, _LOCK_AT):
                raise DriverError(
                    f"another process posts as {sender} to {path}, and has {self.path}: end it, or use another name"
                )
            self.kept = self._found(boot, now_ns)
            self._seq = self.kept.seq
            self._write_anew()
        except OSError as error:
            self.close()
            raise self._refused(error) from error
        except DriverError:
            self.close()
            raise

    def _refused(self, error: OSError) -> DriverError:
        return DriverError(f"cannot keep what is posted in {self.path}: {error.strerror}; {FOLDER} names another folder")

    # --- Read ---------------------------------------------------------------------------------------------------------------

    def _found(self, boot: int, now_ns: int) -> Outgoing:
        """What is in the file; the last record may be half there: its ``post`` has not returned."""
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            return Outgoing(boot)
        begun: Begun | None = None
        found: dict[int, Waiting] = {}
        seq = 0
        try:
            for number, record in enumerate(self._records(content)):
                one = _read(record)
                if isinstance(one, Begun) is not (number == 0):
                    raise DriverError(f"{self.path} is damaged: its record {number} is in the wrong place; {_CURE}")
                if isinstance(one, Begun):
                    if (one.sender, one.path) != self._whose:
                        raise DriverError(
                            f"{self.path} holds what {one.sender} has posted to {one.path}: use another sender, "
                            f"or another folder, which {FOLDER} names"
                        )
                    begun, seq = one, one.seq
                elif isinstance(one, Over):
                    found.pop(one.seq, None)
                    self._waiting.pop(one.seq, None)
                else:
                    hops = (Hop(one.message.sender, now_ns),)  # the clock of the stamps there may have begun anew
                    message = msgspec.structs.replace(one.message, hops=hops)
                    envelopes.check_head(message)
                    found[message.seq], self._waiting[message.seq] = Waiting(message, _until_ns(one, now_ns)), record
                    seq = max(seq, message.seq)
        except (EnvelopeError, *UNDECODABLE) as error:
            raise DriverError(f"{self.path} is damaged: {error}; {_CURE}") from error
        if begun is None:
            return Outgoing(boot)
        if not found:  # a new life: the driver may have heard a later one than this file tells
            return Outgoing(max(boot, begun.boot + 1))
        return Outgoing(begun.boot, seq, list(found.values()))

    def _records(self, content: bytes) -> Iterator[bytes]:
        at = safe = 0
        while at < len(content):
            found = record_at(content, at)
            if found is None:
                if at < max(safe, *_safe_behind(content, at), 0):
                    raise DriverError(f"{self.path} is damaged at byte {at}; {_CURE}")
                return
            record, safe = found[0], max(safe, found[1])
            yield record
            at += _HEAD + len(record)

    # --- Write --------------------------------------------------------------------------------------------------------------

    def posted(self, message: Envelope, until_ns: int | None, now_ns: int) -> None:
        """Keep a message; once this returns it survives a power cut, and so does all that was `over` before.

        Raises:
            DriverError: it cannot be kept.
        """
        if self._lock < 0:
            raise DriverError(
                f"cannot keep what is posted in {self.path}: it is closed, or is the file of the parent process; make a new proxy"
            )
        until_s = None if until_ns is None else time.time() + (until_ns - now_ns) / NS
        try:
            record = _written(Posted(message, until_s))
            _read(record)
        except (TypeError, *UNDECODABLE) as error:
            raise DriverError(f"cannot keep the message {message.id} in {self.path}: {error}") from error
        try:
            if self._is_behind:
                self._write_anew()
            self._append(record)
            os.fdatasync(self._descriptor)
        except OSError as error:
            self._take_back()
            raise self._refused(error) from error
        except BaseException:  # Ctrl-C: the caller hears that it was not taken
            self._take_back()
            raise
        self._waiting[message.seq], self._seq = record, message.seq
        self._safe = self._size = self._size + _HEAD + len(record)

    def over(self, seq: int) -> None:
        """A message needs to be sent no more. If this cannot be written now, it is before the next message."""
        if self._waiting.pop(seq, None) is None or self._lock < 0:
            return
        record = _written(Over(seq))
        try:
            self._append(record)
            self._size += _HEAD + len(record)
            if self._size > TIDY_SIZE and self._size > 2 * sum(map(len, self._waiting.values())):
                self._write_anew()
        except OSError:
            self._is_behind = True
            self._take_back()

    def _take_back(self) -> None:
        """What was half appended; if it stays, the next record is written over it."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._descriptor, self._size)

    def _append(self, record: bytes) -> None:
        whole = framed(record, self._safe)
        if os.pwrite(self._descriptor, whole, self._size) < len(whole):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _write_anew(self) -> None:
        """With what waits, and nothing else."""
        records = [_written(Begun(*self._whose, self.kept.boot, self._seq)), *self._waiting.values()]
        size = sum(_HEAD + len(one) for one in records)
        content = b"".join(framed(one, size) for one in records)
        new = self.path.with_suffix(".new")
        descriptor = os.open(new, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        try:
            if os.write(descriptor, content) < len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(descriptor)
            os.rename(new, self.path)
            folder = os.open(self.path.parent, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except BaseException:
            self._is_behind = True  # the file may be the new one already, which this process has not open
            os.close(descriptor)
            raise
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor, self._size, self._safe, self._is_behind = descriptor, size, size, False

    def close(self) -> None:
        """Let another process have it, or another proxy of this one."""
        if self._lock >= 0:
            locks.give(self._lock, _LOCK_AT)  # a child that has just been forked has the same opening open
        self.leave()

    __del__ = close
    """A proxy that was not closed, and that is garbage, holds the file no longer."""

    def leave(self) -> None:
        """Close the descriptors. The lock stays with a process that has the same opening: the one that forked this one."""
        for descriptor in (self._descriptor, self._lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._descriptor = self._lock = -1


_OPEN: Final = weakref.WeakSet[PostsFile]()


def _left_to_the_parent() -> None:
    """In a process that was forked: the files are its parent's."""
    for file in list(_OPEN):
        file.leave()


os.register_at_fork(after_in_child=_left_to_the_parent)

_CURE: Final = "move it away, and what it holds is not sent"


def place_of(sender: str, path: str) -> Path:
    """The file of a sender and a driver."""
    name = f"{sender}-to-{path}".replace("/", ".")
    if len(name.encode()) > NAME_MAX:
        name = f"{name.encode()[: NAME_MAX - 20].decode(errors='ignore')}-{xxhash.xxh3_64_hexdigest(name.encode())}"
    return Path(os.environ.get(FOLDER) or Path.cwd()) / f"{name}.posts"


def _until_ns(one: Posted, now_ns: int) -> int | None:
    """A kept message's deadline. Its time does not grow when the calendar is set back."""
    if one.until_s is None:
        return None
    left_s = one.until_s - time.time()
    if one.message.deadline_ms is not None:
        left_s = min(left_s, one.message.deadline_ms / 1_000)
    if not abs(left_s) < INTEGER_MAX:
        raise ValueError(f"it holds the deadline {one.until_s}")
    return now_ns + round(left_s * NS)


def framed(record: bytes, safe: int) -> bytes:
    """A record as it stands in the file."""
    numbers = _NUMBERS.pack(len(record), safe)
    return numbers + xxhash.xxh3_64_digest(numbers + record) + record


def record_at(content: bytes, at: int) -> tuple[bytes, int] | None:
    """The record there, and how many bytes of the file are safe, as it says; None: there is no whole one."""
    if at < 0 or at + _HEAD > len(content):
        return None
    size, safe = _NUMBERS.unpack_from(content, at)
    record = content[at + _HEAD : at + _HEAD + size]
    numbers, digest = content[at : at + _NUMBERS.size], content[at + _NUMBERS.size : at + _HEAD]
    return (record, safe) if len(record) == size and xxhash.xxh3_64_digest(numbers + record) == digest else None


def _safe_behind(content: bytes, at: int) -> Iterator[int]:
    """How much was safe by what each record says that is whole behind a place where none is."""
    while (at := content.find(_BEGINS, at + 1)) >= 0:
        if (found := record_at(content, at - 1 - _HEAD)) is not None:
            yield found[1]
