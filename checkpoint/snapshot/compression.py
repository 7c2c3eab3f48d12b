"""Store bytes compressed where that makes them fewer, and unchanged where it does not."""

from __future__ import annotations

from collections.abc import Sequence
from threading import local
from typing import Final, TypeAlias, TypeVar

import zstandard

from checkpoint.errors import FormatError
from checkpoint.snapshot.layout import Codec

COMPRESSION_LEVEL = -1
"""zstd's fastest useful level: about 1 GB/s and 5× on a Python heap, 2.7 GB/s on what does not compress.

The same for every link: levels 1 and 3 make a Python heap's base 3 and 4 % smaller, its deltas 5 and 10 % (``python -m benchmarks
encoding``), which no link is slow enough to be asked for.
"""

WORTH_COMPRESSING = 15 / 16
"""A frame is stored compressed when that takes less than this part of its size."""

_of_thread: Final = local()

A = TypeVar("A", bound=bytes | memoryview)

Compressor: TypeAlias = zstandard.ZstdCompressor
"""None may be used by two threads at a time."""


def compressor() -> Compressor:
    """One for everything that is stored."""
    return Compressor(level=COMPRESSION_LEVEL)


def own_compressor() -> Compressor:
    """This thread's own: to make one takes as long as to compress a small snapshot."""
    if not hasattr(_of_thread, "compressor"):
        _of_thread.compressor = compressor()
    return _of_thread.compressor  # type: ignore[no-any-return]


def stored(raw: bytes | memoryview, compressor: Compressor) -> tuple[Codec, bytes | memoryview]:
    """Compressed where it is worth it."""
    return _better(raw, compressor.compress(raw))


def stored_each(raws: Sequence[memoryview], compressor: Compressor) -> list[tuple[Codec, memoryview]]:
    """As `stored`, of several; threads disturb each other less than where each is told by itself."""
    packed = compressor.multi_compress_to_buffer(list(raws))
    contents = [memoryview(packed[index]) for index in range(len(raws))]  # type: ignore[arg-type]  # which are buffers
    return list(map(_better, raws, contents))


def _better(raw: A, packed: A) -> tuple[Codec, A]:
    return (Codec.ZSTD, packed) if len(packed) < len(raw) * WORTH_COMPRESSING else (Codec.RAW, raw)


def decompressed(stored: bytes | memoryview, raw_size: int, where: str) -> bytes:
    """Decompress what holds exactly ``raw_size`` bytes; nothing is allocated on the compressed bytes' own word."""
    try:
        _check_declared(stored, raw_size, where)
        raw = _decompressor().decompress(stored, max_output_size=raw_size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise FormatError(f"{where}: cannot be decompressed: {error}") from error
    if len(raw) != raw_size:
        raise FormatError(f"{where}: decompressed to {len(raw)} bytes where {raw_size} belong")
    return raw


def decompress_into(target: memoryview, stored: bytes | memoryview, where: str) -> None:
    """The same into memory that is used again and again: a new piece of it is given by the kernel, page by page."""
    filled = 0
    try:
        _check_declared(stored, len(target), where)
        reader = _decompressor().stream_reader(stored)
        while filled < len(target) and (more := reader.readinto(target[filled:])):
            filled += more
    except zstandard.ZstdError as error:
        raise FormatError(f"{where}: cannot be decompressed: {error}") from error
    if filled != len(target):
        raise FormatError(f"{where}: decompressed to {filled} bytes where {len(target)} belong")


def _check_declared(stored: bytes | memoryview, raw_size: int, where: str) -> None:
    declared = zstandard.get_frame_parameters(stored).content_size
    if declared != raw_size:
        raise FormatError(f"{where}: compressed bytes declare {declared} bytes where {raw_size} belong")


def _decompressor() -> zstandard.ZstdDecompressor:
    """This thread's own: none may be used by two at a time, and to make one takes longer than to decompress a frame."""
    if not hasattr(_of_thread, "decompressor"):
        _of_thread.decompressor = zstandard.ZstdDecompressor()
    return _of_thread.decompressor  # type: ignore[no-any-return]
