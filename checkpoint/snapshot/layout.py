"""The fixed parts of a snapshot file, byte for byte: numbers, sizes, limits. FORMAT.md describes the same in words.

All integers are little-endian. Parsing checks everything that can be checked in one part alone; it raises FormatError and never
reads beyond the bytes it was given.
"""

from __future__ import annotations

import enum
import struct

from blake3 import blake3
from msgspec import Struct

from checkpoint.errors import FormatError

MAGIC = b"\x89FOVR\r\n\x1a"
"""First bytes of a file. Not text, and altered by every transfer that alters line ends."""

END_MAGIC = b"FOVR.END"
"""First bytes of the trailer."""

VERSION = 1
"""Version of the format for a component of one process."""

TREE_VERSION = 2
"""Version for one of several processes."""

DIFFERENCES = 2
"""Added to either by a delta that tells pages as differences: versions 3 and 4."""

VERSIONS = range(VERSION, TREE_VERSION + DIFFERENCES + 1)
"""All of them are written and read."""

DIGEST_SIZE = 32
"""Bytes of a blake3 digest."""

FRAME_SIZE = 1 << 20
"""Bytes of contents in every frame but the last: large enough to compress well, small enough to stay in the cache."""

ALIGNMENT = 4096
"""A raw frame's body begins at a multiple of this from the start of the file."""

# Limits: what a file may ask a reader to allocate before its content has been checked.

MAX_CONTENTS_SIZE = 64 << 30
"""Bytes of page contents in one snapshot; ``decode`` takes a smaller one."""

MAX_HEADER_SIZE = 1 << 20
"""Bytes of the header section."""

MAX_STATE_SIZE = 32 << 20
"""Bytes of the state section: mappings, threads, descriptors. A process with 65,530 mappings needs about 12 MiB."""

MAX_RUNS_SIZE = 128 << 20
"""Bytes of the run table: 8 million runs."""

MAX_OUTPUT_SIZE = 256 << 20
"""Bytes of the output section: what a component may write to its streams between two snapshots."""


class Codec(enum.IntEnum):
    """How bytes are stored."""

    RAW = 0
    ZSTD = 1


class SectionKind(enum.IntEnum):
    """The content of a section; sections stand in this order."""

    HEADER = 1
    STATE = 2
    RUNS = 3
    OUTPUT = 4


SECTION_LIMITS = {
    SectionKind.HEADER: MAX_HEADER_SIZE,
    SectionKind.STATE: MAX_STATE_SIZE,
    SectionKind.RUNS: MAX_RUNS_SIZE,
    SectionKind.OUTPUT: MAX_OUTPUT_SIZE,
}

_PREAMBLE = struct.Struct("<8sIIQII")  # magic, version, section count, contents size, frame size, frame count
_SECTION = struct.Struct("<IIQQQ32s")  # kind, codec, offset, stored size, raw size, digest of the stored bytes
_FRAME = struct.Struct("<IIII32s")  # codec, padding, stored size, raw size, digest of the stored bytes
_TRAILER = struct.Struct("<8sQ")  # magic, size of the whole file

PREAMBLE_SIZE = _PREAMBLE.size + len(SectionKind) * _SECTION.size + DIGEST_SIZE
FRAME_HEAD_SIZE = _FRAME.size
TRAILER_SIZE = _TRAILER.size + DIGEST_SIZE


def digest_of(content: bytes | bytearray | memoryview) -> bytes:
    """The blake3 digest, 32 bytes."""
    return blake3(content).digest()


class Section(Struct, frozen=True):
    """Where one section lies. ``stored_size`` is what it takes in the file, ``raw_size`` what it holds."""

    kind: SectionKind
    codec: Codec
    offset: int
    stored_size: int
    raw_size: int
    digest: bytes

    def pack(self) -> bytes:
        """Its 64 bytes of the section table."""
        return _SECTION.pack(self.kind, self.codec, self.offset, self.stored_size, self.raw_size, self.digest)


class Preamble(Struct, frozen=True):
    """The first bytes of a file: what follows, where, and how large.

    Attributes:
        contents_size: bytes of page contents, all frames together, before compression.
        sections: one of each kind, in the order of SectionKind, without gaps.
        version: one of `VERSIONS`.
    """

    contents_size: int
    sections: tuple[Section, ...]
    version: int = VERSION

    @property
    def is_tree(self) -> bool:
        """Whether it is of several processes."""
        return self.version in (TREE_VERSION, TREE_VERSION + DIFFERENCES)

    @property
    def has_differences(self) -> bool:
        """Whether it tells pages as differences from its parent's."""
        return self.version > TREE_VERSION

    @property
    def frames_offset(self) -> int:
        """Where the first frame's head lies."""
        last = self.sections[-1]
        return last.offset + last.stored_size

    @property
    def frame_count(self) -> int:
        """How many frames the contents fill."""
        return -(-self.contents_size // FRAME_SIZE)

    def frame_raw_size(self, index: int) -> int:
        """Bytes of contents in one frame: all are full but the last."""
        return min(FRAME_SIZE, self.contents_size - index * FRAME_SIZE)

    def pack(self) -> bytes:
        """The preamble's bytes, its own digest last."""
        fixed = _PREAMBLE.pack(MAGIC, self.version, len(self.sections), self.contents_size, FRAME_SIZE, self.frame_count)
        body = fixed + b"".join(section.pack() for section in self.sections)
        return body + digest_of(body)

    @classmethod
    def parse(cls, packed: bytes | memoryview) -> Preamble:
        """Read and check the first ``PREAMBLE_SIZE`` bytes.

        Raises:
            FormatError: not a snapshot, another version, altered, or of impossible sizes.
        """
        packed = bytes(packed)
        if packed[: len(MAGIC)] != MAGIC[: len(packed)] or not packed:
            raise FormatError("not a snapshot file: it does not begin with a snapshot's magic bytes")
        if len(packed) < PREAMBLE_SIZE:
            raise FormatError(f"the file ends inside its preamble, after {len(packed)} of {PREAMBLE_SIZE} bytes: it is cut off")
        _, version, section_count, contents_size, frame_size, frame_count = _PREAMBLE.unpack_from(packed)
        if version not in VERSIONS:
            known = f"versions {VERSIONS[0]} to {VERSIONS[-1]}"
            raise FormatError(f"format version {version}: this program reads {known}; use the one that wrote it")
        if digest_of(packed[:-DIGEST_SIZE]) != packed[-DIGEST_SIZE:]:
            raise FormatError("the preamble does not match its digest: the file was altered or damaged")
        if section_count != len(SectionKind) or frame_size != FRAME_SIZE:
            raise FormatError(f"preamble: {section_count} sections and frames of {frame_size} bytes are not of version {version}")
        preamble = cls(contents_size, _parse_sections(packed), version)
        if frame_count != preamble.frame_count:
            raise FormatError(f"preamble: {frame_count} frames cannot hold {contents_size} bytes of contents")
        return preamble


def _parse_sections(packed: bytes) -> tuple[Section, ...]:
    """Read the section table: every kind once, in order, without gaps, inside its limit."""
    sections = []
    expected_offset = PREAMBLE_SIZE
    for index, kind in enumerate(SectionKind):
        where = f"section {index} of the table"
        entry = packed[_PREAMBLE.size + index * _SECTION.size :][: _SECTION.size]
        number, codec, offset, stored_size, raw_size, digest = _SECTION.unpack(entry)
        if number != kind:
            raise FormatError(f"{where}: kind {number} where {kind} ({kind.name.lower()}) belongs")
        if offset != expected_offset:
            raise FormatError(f"{where}: lies at byte {offset}, not at {expected_offset}")
        check_sizes(where, codec, stored_size, raw_size, SECTION_LIMITS[kind])
        sections.append(Section(kind, Codec(codec), offset, stored_size, raw_size, digest))
        expected_offset += stored_size
    return tuple(sections)


class FrameHead(Struct, frozen=True):
    """The head before a frame's body.

    Attributes:
        padding: zero bytes between head and body, so that a raw body is aligned.
    """

    codec: Codec
    padding: int
    stored_size: int
    raw_size: int
    digest: bytes

    def pack(self) -> bytes:
        """Its bytes, without the padding."""
        return _FRAME.pack(self.codec, self.padding, self.stored_size, self.raw_size, self.digest)

    @classmethod
    def parse(cls, packed: bytes | memoryview, offset: int, raw_size_expected: int, where: str) -> FrameHead:
        """Read and check the head that lies at ``offset`` of the file.

        Raises:
            FormatError: cut off, or not a head that can stand here.
        """
        if len(packed) < FRAME_HEAD_SIZE:
            raise FormatError(f"{where}: the file ends inside its head: it is cut off")
        codec, padding, stored_size, raw_size, digest = _FRAME.unpack(packed)
        check_sizes(where, codec, stored_size, raw_size, FRAME_SIZE)
        if raw_size != raw_size_expected:
            raise FormatError(f"{where}: holds {raw_size} bytes of contents where {raw_size_expected} belong")
        head = cls(Codec(codec), padding, stored_size, raw_size, digest)
        if padding != padding_at(offset, head.codec):
            raise FormatError(f"{where}: {padding} bytes of padding where {padding_at(offset, head.codec)} belong")
        return head


def padding_at(head_offset: int, codec: Codec) -> int:
    """Zero bytes after a frame's head at this offset: a raw body is aligned, a compressed one follows at once."""
    return -(head_offset + FRAME_HEAD_SIZE) % ALIGNMENT if codec is Codec.RAW else 0


def check_sizes(where: str, codec: int, stored_size: int, raw_size: int, limit: int) -> None:
    """Refuse an unknown codec and sizes that cannot be.

    Raises:
        FormatError: names the place.
    """
    if codec not in Codec.__members__.values():
        raise FormatError(f"{where}: unknown codec {codec}")
    if raw_size > limit:
        raise FormatError(f"{where}: claims {raw_size} bytes; the limit is {limit}")
    if stored_size > raw_size or (codec == Codec.RAW and stored_size != raw_size):
        raise FormatError(f"{where}: {stored_size} stored bytes cannot hold {raw_size} with codec {Codec(codec).name}")


def pack_trailer(file_size: int, seal: blake3) -> bytes:
    """The last bytes of a file; ``seal`` has seen the preamble and every frame head."""
    packed = _TRAILER.pack(END_MAGIC, file_size)
    seal.update(packed)
    return packed + seal.digest()


def check_trailer(packed: bytes | memoryview, file_size: int, seal: blake3) -> None:
    """Compare the last bytes of a file with what they must be.

    Raises:
        FormatError: cut off, altered, or followed by something.
    """
    packed = bytes(packed)
    if len(packed) < TRAILER_SIZE:
        raise FormatError("the file ends inside its trailer: it is cut off")
    if packed[: len(END_MAGIC)] != END_MAGIC:
        raise FormatError("trailer: does not begin with its magic bytes: the file was altered or damaged")
    if packed != pack_trailer(file_size, seal):
        raise FormatError("trailer: the digest over preamble and frame heads does not match: the file was altered or damaged")
