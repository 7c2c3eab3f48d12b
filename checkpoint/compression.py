"""How bytes are stored: compressed where that makes them fewer, and as they are where it does not."""

from __future__ import annotations

from typing import TypeAlias

import zstandard

from checkpoint.errors import FormatError
from checkpoint.layout import Codec

COMPRESSION_LEVEL = -1
"""zstd's fastest useful level: about 1 GB/s and 5× on a Python heap, 2.7 GB/s on what does not compress.

The same for every link: levels 1 and 3 make a Python heap's base 3 and 4 % smaller, its deltas 5 and 10 % (``python -m benchmarks
encoding``), which no link is slow enough to be asked for.
"""

WORTH_COMPRESSING = 15 / 16
"""A frame is stored compressed when that takes less than this part of its size."""

Compressor: TypeAlias = zstandard.ZstdCompressor
Decompressor: TypeAlias = zstandard.ZstdDecompressor
"""Neither may be used by two threads at a time."""


def compressor() -> Compressor:
    """One for everything that is stored."""
    return Compressor(level=COMPRESSION_LEVEL)


def stored(raw: bytes | memoryview, compressor: Compressor) -> tuple[Codec, bytes | memoryview]:
    """Compressed where it is worth it."""
    compressed = compressor.compress(raw)
    if len(compressed) < len(raw) * WORTH_COMPRESSING:
        return Codec.ZSTD, compressed
    return Codec.RAW, raw


def decompressed(stored: bytes | memoryview, raw_size: int, where: str, decompressor: Decompressor) -> bytes:
    """Decompress what holds exactly ``raw_size`` bytes; nothing is allocated on the compressed bytes' own word."""
    try:
        declared = zstandard.get_frame_parameters(stored).content_size
        if declared != raw_size:
            raise FormatError(f"{where}: compressed bytes declare {declared} bytes where {raw_size} belong")
        raw = decompressor.decompress(stored, max_output_size=raw_size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise FormatError(f"{where}: cannot be decompressed: {error}") from error
    if len(raw) != raw_size:
        raise FormatError(f"{where}: decompressed to {len(raw)} bytes where {raw_size} belong")
    return raw
