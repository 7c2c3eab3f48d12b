"""MCAP files: written so that a kill costs a second at most, read also where they end in the middle. The only ``mcap`` import.

A file that is being written grows only: nothing that was written is written again. Each flush appends whole chunks by one
write(2). So a recorder that is killed leaves whole chunks, and behind them at most a part of one. Such a file has no index;
`recover` makes one that has. Source: MCAP format specification, version 0.
"""

from __future__ import annotations

import fcntl
import os
import stat
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, cast

from msgspec import Struct

from checkpoint.store.whole_file import write_all
from failover.core.board.recording import Schema as SchemaText
from failover.errors import RecordingError

if TYPE_CHECKING:
    from mcap.records import Channel, Message, Schema

CHUNK_SIZE: Final = 1 << 20
"""Bytes of a chunk before it is compressed: a reader takes one as a whole."""

RAW_SIZE_MAX: Final = 256 << 20
"""Bytes of a chunk that a reader unpacks; a larger one is a mistake, or was made to do harm."""

MAGIC_SIZE: Final = 8
"""Bytes with which a file begins and ends."""

INDEX_MAX: Final = 250_000
"""Entries of a file's index from which it `is_full`: the library keeps them in memory until the file is closed."""

CHANNELS_MAX: Final = 65_535
"""Channels and schemas of a file have numbers of two bytes, from 1."""

BEFORE: Final = ".before"
"""Ending of a file's name that `recover` gives to the file as it was."""


def _mcap(what: str) -> None:
    """Refuse where the library is not installed.

    Raises:
        RecordingError: says how to install it.
    """
    try:
        import mcap.writer  # noqa: F401
    except ImportError:
        raise RecordingError(f"{what} needs the library mcap, which is not installed: pip install 'failover[record]'") from None


# --- Writing ---------------------------------------------------------------------------------------------------------


class _Stream:
    """What the library writes to: collects, and appends to the file by one write when it is flushed."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._waiting = bytearray()
        self.written = 0

    def write(self, octets: bytes) -> int:
        self._waiting += octets
        return len(octets)

    def tell(self) -> int:
        return self.written + len(self._waiting)

    def flush(self) -> None:
        """Append what waits; where that fails the file is as long as before.

        Raises:
            OSError: it failed.
        """
        try:
            write_all(self._descriptor, bytes(self._waiting))
        except OSError:
            os.ftruncate(self._descriptor, self.written)
            raise
        self.written += len(self._waiting)
        self._waiting.clear()


class NewFile:
    """An MCAP file that is being written.

    Attributes:
        path: where it is.
        messages: so far.
        index_entries: so far: one for each chunk, and one for each channel that has messages in it.
    """

    def __init__(self, path: Path, library: str) -> None:
        """Make it.

        Args:
            library: who writes it, for people.

        Raises:
            RecordingError: there is one already, it cannot be made, or the library is missing.
        """
        _mcap(f"to write {path}")
        from mcap.writer import Writer

        self.path = path
        self.messages = 0
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o644)
        except FileExistsError:
            raise RecordingError(
                f"{path} exists, and a recording is never overwritten: name another file, or move it away"
            ) from None
        except OSError as error:
            raise RecordingError(f"cannot make {path}: {error.strerror}") from error
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)  # told to `recover`, for as long as this process writes it
        self._stream = _Stream(self._descriptor)
        self._writer = Writer(cast("IO[Any]", self._stream), chunk_size=CHUNK_SIZE)
        self._schemas: dict[SchemaText, int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._is_failed = False
        self.index_entries = 0
        self._active: set[int] = set()
        self._writer.start(library=library)

    @property
    def is_full(self) -> bool:
        """Its index takes as much memory as it may."""
        return self.index_entries >= INDEX_MAX

    @property
    def size(self) -> int:
        """Bytes that the file has, and those that wait; without the chunk that is being filled."""
        return self._stream.tell()

    def channel(self, topic: str, schema: SchemaText | None, metadata: Mapping[str, str], encoding: str = "json") -> int:
        """The number of a channel, the same for the same one; ``schema`` None: its messages have none.

        Raises:
            RecordingError: there are too many.
        """
        key = (topic, schema, tuple(sorted(metadata.items())), encoding)
        if key not in self._channels:
            if len(self._channels) == CHANNELS_MAX:
                raise RecordingError(f"{self.path}: an MCAP file has room for {CHANNELS_MAX} channels; choose items with --items")
            self._channels[key] = int(self._writer.register_channel(topic, encoding, self._schema(schema), dict(metadata)))
        return self._channels[key]

    def _schema(self, schema: SchemaText | None) -> int:
        """The number of a schema, the same for the same one; 0: none."""
        if schema is None:
            return 0
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema.name, schema.encoding, schema.content)
        return self._schemas[schema]

    def add(self, channel: int, log_ns: int, publish_ns: int, sequence: int, content: bytes) -> None:
        """Append a message; it is in the file after the next `flush`."""
        self._active.add(channel)
        before = self._stream.tell()
        self._writer.add_message(channel, max(log_ns, 0), content, max(publish_ns, 0), sequence & 0xFFFF_FFFF)
        self.messages += 1
        if self._stream.tell() != before:
            self._count_chunk()

    def _count_chunk(self) -> None:
        self.index_entries += 1 + len(self._active)
        self._active.clear()

    def flush(self) -> None:
        """Bring all messages so far into the file, as whole chunks.

        Raises:
            RecordingError: they cannot be written; what was there is kept. Only `close` or `abandon` may follow.
        """
        self._written(self._writer.flush)
        if self._active:
            self._count_chunk()

    def close(self) -> None:
        """Write the index, and close the file; one that could not be written is only closed, and so is one that is closed.

        Raises:
            RecordingError: as for `flush`.
        """
        try:
            if self._descriptor >= 0 and not self._is_failed:
                self.flush()
                self._written(self._writer.finish)
                self._written(self._stream.flush)
                self._written(lambda: os.fsync(self._descriptor))
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1

    def _written(self, act: Any) -> None:
        try:
            act()
        except OSError as error:
            self._is_failed = True
            raise RecordingError(
                f"cannot write {self.path} any more: {error.strerror}; it keeps its first {self._stream.written} bytes, what was "
                f"recorded until a second before; make room, then failover board record --recover {self.path} gives it its index"
            ) from error


# --- Reading ---------------------------------------------------------------------------------------------------------


class Loss(Struct):
    """What a file has not, known when it was read to its end.

    Attributes:
        is_finished: it has its last record and its index.
        tail: bytes at its end that are no whole record.
        chunks: of messages that were damaged, and left out.
        is_written: a process is recording it, and what it has written since the first look is not read.
    """

    is_finished: bool = False
    tail: int = 0
    chunks: int = 0
    is_written: bool = False

    def sentence(self, path: Path) -> str:
        """What is lost; "" if nothing is."""
        told = []
        if self.is_written:
            told.append("it is being recorded: what comes from now on is left out")
        elif not self.is_finished:
            rest = (
                f"its last {self.tail} bytes are no whole record and are left out" if self.tail else "all its records are whole"
            )
            told.append(f"it was not finished, because its recorder was ended: {rest}; at most its last second is lost")
        if self.chunks:
            told.append(f"{self.chunks} damaged chunks are left out, and messages of channels that began in them")
        return f"{path}: {'; '.join(told)}" if told else ""


class Recorded:
    """An MCAP file to be read, any number of times: each time what it had when it was opened first."""

    def __init__(self, path: Path) -> None:
        """Look at its beginning.

        Raises:
            RecordingError: it is no MCAP file, cannot be read, or the library is missing.
        """
        _mcap(f"to read {path}")
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import McapError
        from mcap.stream_reader import read_magic

        self.path = path
        with self._opened() as file:
            self._size = os.fstat(file.fileno()).st_size
            self._is_written = _is_written(file)
            try:
                read_magic(ReadDataStream(file))
            except (McapError, struct.error):
                raise RecordingError(f"{path} is no MCAP file: its first bytes are not those of one") from None
            except OSError as error:
                raise RecordingError(f"cannot read {path}: {error.strerror}") from error
        self.loss = Loss(is_written=self._is_written)

    def _opened(self) -> IO[bytes]:
        try:
            if not stat.S_ISREG(self.path.stat().st_mode):
                raise RecordingError(f"cannot read {self.path}: it is no file")
            return self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {error.strerror}") from error

    def messages(self) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Every message that is whole, in the order of the file; `loss` is right at the end.

        Raises:
            RecordingError: the file cannot be read any more.
        """
        from mcap.records import Channel, Message, Schema

        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        loss = Loss(is_written=self._is_written)
        for record in self._records(loss):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                yield schemas.get(channel.schema_id), channel, record
        self.loss = loss

    def _records(self, loss: Loss) -> Iterator[Any]:
        """Every record, those of chunks too; ends where nothing more is whole."""
        from mcap.records import Chunk, Footer
        from mcap.stream_reader import StreamReader, breakup_chunk

        with self._opened() as file:
            size = min(self._size, os.fstat(file.fileno()).st_size)
            whole, has_footer = MAGIC_SIZE, False
            for record in _whole(StreamReader(file, emit_chunks=True, record_size_limit=size).records):
                end = file.tell()
                if end > size:
                    break
                if isinstance(record, Chunk):
                    inner = _broken_up(record, breakup_chunk)
                    if inner is None and end == size:
                        break  # it was being written when the power went
                    loss.chunks += inner is None
                    yield from inner or ()
                else:
                    yield record
                whole, has_footer = end, isinstance(record, Footer)
            loss.tail = size - whole
            loss.is_finished = has_footer and loss.tail == MAGIC_SIZE


def _whole(records: Iterator[Any]) -> Iterator[Any]:
    """Records until one is not whole: the library then fails in one of many ways.

    Raises:
        RecordingError: the file cannot be read.
    """
    from mcap.exceptions import McapError

    try:
        yield from records
    except OSError as error:
        raise RecordingError(f"cannot read the recording: {error.strerror}") from error
    except (McapError, struct.error, ValueError, MemoryError, OverflowError):
        return


def _broken_up(chunk: Any, break_up: Any) -> list[Any] | None:
    """The records of a chunk; None if it is damaged."""
    if chunk.uncompressed_size > RAW_SIZE_MAX:
        return None
    try:
        raw = _unpacked(chunk)
        if len(raw) != chunk.uncompressed_size:
            return None
        return list(break_up(replace(chunk, compression="", data=raw), validate_crc=True))
    except Exception:  # noqa: BLE001  # its bytes are anything, and each codec has errors of its own
        return None


def _unpacked(chunk: Any) -> bytes:
    """The records of a chunk, and at most a byte more than it says that they have: the codecs' own sizes may be made to do harm.

    Raises:
        Exception: its codec is not known, not installed, or refuses the bytes.
    """
    most = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            return bytes(reader.read(most))
    if chunk.compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most))
    if chunk.compression:
        raise ValueError(f"no codec {chunk.compression!r} is known")
    return bytes(chunk.data)


# --- Recovery --------------------------------------------------------------------------------------------------------


class Recovered(Struct, frozen=True):
    """What `recover` did.

    Attributes:
        messages: of the file that stands there now.
        kept: the file as it was; None: it is whole, and nothing was changed.
    """

    messages: int
    loss: Loss
    kept: Path | None


def recover(path: Path, library: str) -> Recovered:
    """Make a whole file, with its index, of one that is not finished or is damaged; keep the old one beside it.

    Raises:
        RecordingError: it is none, or there is no room; nothing was changed.
    """
    recorded = Recorded(path)
    if recorded.loss.is_written:
        raise RecordingError(f"{path} is being recorded now: end its recorder first, which gives it its index")
    messages = sum(1 for _ in recorded.messages())
    if not recorded.loss.sentence(path):
        return Recovered(messages, recorded.loss, None)
    kept = path.with_name(path.name + BEFORE)
    if kept.exists():
        raise RecordingError(f"{kept} exists: it is {path.name} from an earlier recovery; move it away first")
    made = path.with_name(f"{path.name}.recovering-{os.getpid()}")
    file = NewFile(made, library)
    try:
        _copy(recorded, file)
        file.close()
        kept.hardlink_to(path)
        made.rename(path)
    except BaseException as error:
        file.abandon()
        made.unlink(missing_ok=True)
        if isinstance(error, RecordingError) and isinstance(error.__cause__, OSError):
            raise RecordingError(
                f"{path} is not recovered, and is as it was: cannot write a second file beside it: {error.__cause__.strerror}"
            ) from error
        raise
    return Recovered(file.messages, recorded.loss, kept)


def _is_written(file: IO[bytes]) -> bool:
    """Whether a process writes a file; the lock that finds it goes when ``file`` is closed."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    return False


def _copy(recorded: Recorded, file: NewFile) -> None:
    channels: dict[int, int] = {}
    for schema, channel, message in recorded.messages():
        if channel.id not in channels:
            text = None if schema is None else SchemaText(schema.name, schema.data, schema.encoding)
            channels[channel.id] = file.channel(channel.topic, text, channel.metadata, channel.message_encoding)
        file.add(channels[channel.id], message.log_time, message.publish_time, message.sequence, message.data)
        if file.messages % 10_000 == 0:
            file.flush()
