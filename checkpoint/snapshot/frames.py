"""The frames of a snapshot file: its contents in pieces, each with its own digest.

A frame is verified before it is used, and stays in a processor's cache from the first to the last step of its processing.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from queue import SimpleQueue
from typing import Final, Protocol

from blake3 import blake3
from msgspec import Struct

from checkpoint.errors import FormatError
from checkpoint.snapshot import compression, layout
from checkpoint.snapshot.byte_sources import Reader
from checkpoint.snapshot.compression import Compressor
from checkpoint.snapshot.layout import Codec, FrameHead, Preamble

ROW: Final = 4
"""Frames that a thread works on at once: to be woken, and to wait for the interpreter, take it as long as one of them."""


class Sink(Protocol):
    """Where a file goes: a binary file, or anything that takes bytes and says how many."""

    def write(self, content: bytes | memoryview, /) -> int | None: ...


class Body(Struct, frozen=True):
    """A frame that is ready to be written, wherever it will lie."""

    codec: Codec
    content: bytes | memoryview
    raw_size: int
    digest: bytes


class Packer:
    """Makes bodies of frames, in several threads at once: each borrows a compressor, for none may be used twice at a time."""

    def __init__(self, threads: int) -> None:
        self._compressors: SimpleQueue[Compressor] = SimpleQueue()
        for _ in range(threads):
            self._compressors.put(compression.compressor() if threads > 1 else compression.own_compressor())

    def __call__(self, raw: memoryview) -> Body:
        """The body of one frame."""
        with self._borrowed() as compressor:
            codec, content = compression.stored(raw, compressor)
        return Body(codec, content, len(raw), layout.digest_of(content))

    def each(self, raws: Sequence[memoryview]) -> list[Body]:
        """The bodies of several frames."""
        with self._borrowed() as compressor:
            stored = compression.stored_each(raws, compressor)
        told = zip(raws, stored, strict=True)
        return [Body(codec, content, len(raw), layout.digest_of(content)) for raw, (codec, content) in told]

    @contextmanager
    def _borrowed(self) -> Iterator[Compressor]:
        compressor = self._compressors.get()
        try:
            yield compressor
        finally:
            self._compressors.put(compressor)


class FrameWriter:
    """Writes frames one after the other, and what stands behind the last one.

    Args:
        file: at the first frame's place.
        offset: that place.
    """

    def __init__(self, file: Sink, offset: int) -> None:
        self._file = file
        self._offset = offset
        self._heads: list[bytes] = []

    def add(self, body: Body) -> None:
        """Write one frame. Raises OSError."""
        padding = layout.padding_at(self._offset, body.codec)
        head = FrameHead(body.codec, padding, len(body.content), body.raw_size, body.digest).pack()
        write_all(self._file, head + bytes(padding))
        write_all(self._file, body.content)
        self._heads.append(head)
        self._offset += len(head) + padding + len(body.content)

    def finish(self, preamble: Preamble) -> int:
        """Write the trailer; the size of the whole file. Raises OSError."""
        file_size = self._offset + layout.TRAILER_SIZE
        seal = blake3(preamble.pack() + b"".join(self._heads))
        write_all(self._file, layout.pack_trailer(file_size, seal))
        return file_size


def write_all(file: Sink, content: bytes | memoryview) -> None:
    """Write all of it: an unbuffered file may take less at a time.

    Raises:
        OSError: it takes nothing more, and says no reason.
    """
    rest = memoryview(content)
    while rest:
        taken = file.write(rest)
        if not taken:
            raise OSError(errno.EIO, "the file takes nothing more")
        rest = rest[taken:]


class Frame(Struct, frozen=True):
    """A frame's head and where its body lies."""

    where: str
    head: FrameHead
    body_offset: int


def frames_of(reader: Reader, preamble: Preamble) -> Iterator[Frame]:
    """Every frame in order; after the last one the trailer has been checked, and that nothing follows."""
    seal = blake3(preamble.pack())
    offset = preamble.frames_offset
    for index in range(preamble.frame_count):
        where = f"frame {index} at byte {offset}"
        packed = reader.read(offset, layout.FRAME_HEAD_SIZE)
        head = FrameHead.parse(packed, offset, preamble.frame_raw_size(index), where)
        seal.update(packed)
        offset += layout.FRAME_HEAD_SIZE
        if bytes(reader.read(offset, head.padding)) != bytes(head.padding):
            raise FormatError(f"{where}: its padding is not all zero, or cut off")
        yield Frame(where, head, offset + head.padding)
        offset += head.padding + head.stored_size
    file_size = offset + layout.TRAILER_SIZE
    layout.check_trailer(reader.read(offset, layout.TRAILER_SIZE), file_size, seal)
    if reader.size != file_size:
        raise FormatError(f"{reader.size - file_size} bytes follow the trailer: the file was added to")


def content_of(reader: Reader, frame: Frame) -> bytes | memoryview:
    """A frame's contents, verified before they are decompressed."""
    body = verified(reader, frame)
    return body if frame.head.codec is Codec.RAW else compression.decompressed(body, frame.head.raw_size, frame.where)


def read_frame(reader: Reader, frame: Frame, target: memoryview) -> None:
    """The same, put into ``target``."""
    if frame.head.codec is Codec.RAW:
        check_frame(reader, frame, target)
    else:
        compression.decompress_into(target, verified(reader, frame), frame.where)


def check_frame(reader: Reader, frame: Frame, body: memoryview) -> None:
    """Put a frame's body, as it is stored, into memory of its size. Raises FormatError."""
    reader.read_into(frame.body_offset, body, frame.where)
    check_digest(body, frame)


class DecodedFrames:
    """Contents of single frames of a file, of which the last few that were asked for stay decompressed."""

    def __init__(self, reader: Reader, preamble: Preamble, kept: int) -> None:
        self._reader = reader
        self._preamble = preamble
        self._kept = kept
        self._contents: dict[int, bytes | memoryview] = {}

    @cached_property
    def frames(self) -> list[Frame]:
        """All of them, when they are first asked for. Raises FormatError."""
        return list(frames_of(self._reader, self._preamble))

    def __getitem__(self, index: int) -> bytes | memoryview:
        """The contents of one, verified. Raises FormatError."""
        if index not in self._contents:
            while len(self._contents) >= self._kept:
                del self._contents[next(iter(self._contents))]
            self._contents[index] = content_of(self._reader, self.frames[index])
        return self._contents[index]


def verified(reader: Reader, frame: Frame) -> bytes | memoryview:
    """A frame's body, as it is stored. Raises FormatError."""
    body = reader.read(frame.body_offset, frame.head.stored_size)
    check_digest(body, frame)
    return body


def check_digest(body: bytes | memoryview, frame: Frame) -> None:
    if len(body) < frame.head.stored_size:
        raise FormatError(f"{frame.where}: the file ends inside its body: it is cut off")
    if layout.digest_of(body) != frame.head.digest:
        raise FormatError(f"{frame.where}: its body does not match its digest: the file was altered or damaged")
