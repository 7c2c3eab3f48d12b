"""Read bytes of a snapshot file by offset: from a path, a descriptor or memory."""

from __future__ import annotations

import io
import mmap
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, Protocol

from checkpoint.errors import FormatError

Source = int | str | os.PathLike[str] | bytes | bytearray | memoryview | mmap.mmap | BinaryIO
"""Where a file's bytes are: a descriptor, a path, the bytes themselves, or an open file. Read from its first byte on."""


class Reader(Protocol):
    """Bytes by offset. Reading beyond the end answers with what there is."""

    size: int

    def read(self, offset: int, size: int) -> bytes | memoryview: ...

    def read_into(self, offset: int, target: memoryview, where: str) -> None: ...


class _FileReader:
    """A regular file, read by offset: a file that shrinks meanwhile is an error, not a SIGBUS."""

    def __init__(self, descriptor: int) -> None:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise FormatError("not a snapshot file: it is no regular file")
        self._descriptor = descriptor
        self.size = status.st_size

    def read(self, offset: int, size: int) -> bytes:
        try:
            return os.pread(self._descriptor, min(size, max(0, self.size - offset)), offset)
        except OSError as error:
            raise FormatError(f"cannot read {size} bytes at {offset}: {error.strerror}") from error

    def read_into(self, offset: int, target: memoryview, where: str) -> None:
        try:
            count = os.preadv(self._descriptor, [target], offset)
        except OSError as error:
            raise FormatError(f"{where}: cannot read {len(target)} bytes: {error.strerror}") from error
        if count < len(target):
            raise FormatError(f"{where}: the file ends inside its body: it is cut off")


class _BytesReader:
    """A file that is already in memory."""

    def __init__(self, content: bytes | bytearray | memoryview | mmap.mmap) -> None:
        self._content = memoryview(content).cast("B")
        self.size = len(self._content)

    def read(self, offset: int, size: int) -> memoryview:
        return self._content[offset : offset + size]

    def read_into(self, offset: int, target: memoryview, where: str) -> None:
        found = self.read(offset, len(target))
        if len(found) < len(target):
            raise FormatError(f"{where}: the file ends inside its body: it is cut off")
        target[:] = found


@contextmanager
def opened(source: Source) -> Iterator[Reader]:
    """A reader of the source; a path is opened and closed, everything else is borrowed."""
    if isinstance(source, str | os.PathLike):
        with _opened_path(source) as reader:
            yield reader
    elif isinstance(source, int):
        yield _FileReader(source)
    elif isinstance(source, bytes | bytearray | memoryview | mmap.mmap):
        yield _BytesReader(source)
    elif isinstance(source, io.BytesIO):
        yield _BytesReader(source.getbuffer())
    else:
        yield _FileReader(source.fileno())


@contextmanager
def _opened_path(path: str | os.PathLike[str]) -> Iterator[Reader]:
    """A reader of the file at a path; refusals name the path."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise FormatError(f"cannot open snapshot {os.fspath(path)}: {error.strerror}") from error
    try:
        yield _FileReader(descriptor)
    except FormatError as error:
        raise FormatError(f"snapshot {os.fspath(path)}: {error}") from error
    finally:
        os.close(descriptor)
