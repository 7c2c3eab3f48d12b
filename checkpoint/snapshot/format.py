"""Encode and decode a snapshot ⇄ the bytes of one file. FORMAT.md describes the file to the byte.

`checkpoint.snapshot.layout` holds its fixed parts. Writing streams: contents are compressed frame by frame and never copied as a
whole. Reading verifies: every byte of the file is covered by a digest that is checked before the byte is used, sizes are checked
before anything is allocated, and inconsistent bytes of any kind are refused with FormatError.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from threading import local
from typing import Final, TypeAlias

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import PageCopy, PageRun, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Flags, Words
from checkpoint.pages.xor_delta import Rows
from checkpoint.runtime import parallel
from checkpoint.runtime.identity_memo import Memo
from checkpoint.runtime.lazy_numpy import NDArray, np
from checkpoint.snapshot import canonical_state, compression, layout
from checkpoint.snapshot.byte_sources import Reader, Source, opened
from checkpoint.snapshot.canonical_state import Header, State
from checkpoint.snapshot.frames import Frame, FrameWriter, Packer, Sink, check_frame, frames_of, read_frame, write_all
from checkpoint.snapshot.layout import Codec, Preamble, Section, SectionKind
from checkpoint.snapshot.validity import check_snapshot

WORTH_THREADS = 8
"""Frames that are worth threads of their own."""

_COUNTS = struct.Struct("<QQ")  # of the run table: cleared runs, carried runs
_RUN_SIZE = 16
_COUNT = struct.Struct("<Q")  # of its copies, and of its differences
_COPY_SIZE = 24

_of_thread: Final = local()


# Writing


def encode(snapshot: Snapshot, file: Sink, *, threads: int = 1) -> int:
    """Write a snapshot to a file, at its position, in one pass.

    Args:
        threads: that compress; more than one takes processors from a program that runs.

    Returns:
        Bytes written.

    Raises:
        FormatError: the snapshot does not hold together; nothing was written.
        OSError: the file does not take it.
    """
    check_snapshot(snapshot)
    contents = memoryview(snapshot.contents).cast("B")
    preamble, sections = begin(snapshot, len(contents))
    write_all(file, preamble.pack() + sections)
    writer = FrameWriter(file, preamble.frames_offset)
    raws = (contents[index * layout.FRAME_SIZE :][: layout.FRAME_SIZE] for index in range(preamble.frame_count))
    with closing(parallel.in_order(Packer(threads), raws, worth(threads, preamble))) as bodies:
        for body in bodies:
            writer.add(body)
    return writer.finish(preamble)


def begin(snapshot: Snapshot, contents_size: int) -> tuple[Preamble, bytes]:
    """The bytes before the frames: the preamble, and all sections as they are stored.

    Raises:
        FormatError: a section, or all pages together, are larger than the format allows.
    """
    check_contents_size(contents_size)
    sections, stored = _pack_sections(snapshot)
    return Preamble(contents_size, sections, _version_of(snapshot)), b"".join(stored)


def check_contents_size(size: int, limit: int = layout.MAX_CONTENTS_SIZE) -> None:
    """Refuse more bytes of pages than that.

    Raises:
        FormatError: says how many.
    """
    if size > limit:
        raise FormatError(f"preamble: claims {size} bytes of pages; the limit here is {limit}")


def worth(threads: int, preamble: Preamble) -> int:
    """The number of these threads that the frames are worth."""
    return threads if preamble.frame_count >= WORTH_THREADS else 1


def _version_of(snapshot: Snapshot) -> int:
    version = layout.TREE_VERSION if snapshot.is_tree else layout.VERSION
    return version + layout.DIFFERENCES if snapshot.differences else version


def encode_bytes(snapshot: Snapshot) -> bytes:
    """The file of a snapshot, in memory: for tests and for small snapshots."""
    file = io.BytesIO()
    encode(snapshot, file)
    return file.getvalue()


def _pack_sections(snapshot: Snapshot) -> tuple[tuple[Section, ...], list[bytes]]:
    """The section table, and the stored bytes of every section."""
    raw = {
        SectionKind.HEADER: canonical_state.encode_header(canonical_state.header_of(snapshot)),
        SectionKind.STATE: encoded_state(snapshot),
        SectionKind.RUNS: _pack_runs(snapshot),
        SectionKind.OUTPUT: canonical_state.encode_output(snapshot.output),
    }
    compressor = compression.own_compressor()
    sections: list[Section] = []
    stored: list[bytes] = []
    offset = layout.PREAMBLE_SIZE
    for kind, content in raw.items():
        layout.check_sizes(f"section {kind.name.lower()}", Codec.RAW, len(content), len(content), layout.SECTION_LIMITS[kind])
        # The header stays readable without a decompressor.
        codec, body = (Codec.RAW, content) if kind is SectionKind.HEADER else compression.stored(content, compressor)
        sections.append(Section(kind, codec, offset, len(body), len(content), layout.digest_of(body)))
        stored.append(bytes(body))
        offset += len(body)
    return tuple(sections), stored


def encoded_state(snapshot: Snapshot) -> bytes:
    """As `canonical_state.encode_state`; once for a position's digest and the file, whose states are the very same objects."""
    if not hasattr(_of_thread, "state"):
        _of_thread.state = Memo[bytes]()
    last: Memo[bytes] = _of_thread.state
    parts = (snapshot.machine, snapshot.clocks, snapshot.process, snapshot.threads, snapshot.vmas, snapshot.resources)
    others = (snapshot.component, snapshot.engine, snapshot.epoch, snapshot.members, snapshot.zombies)
    return last.of(*parts, *others, make=lambda: canonical_state.encode_state(snapshot))


def _pack_runs(snapshot: Snapshot) -> bytes:
    """The run table: two counts, then (start, end) of every cleared and every carried run; of trees also the copies; where there
    are any, the differences."""
    packed = _COUNTS.pack(len(snapshot.cleared), len(snapshot.runs)) + _pairs((*snapshot.cleared, *snapshot.runs))
    if snapshot.is_tree:
        copies = np.array([(copy.start, copy.end, copy.source) for copy in snapshot.copies], dtype="<u8")
        packed += _COUNT.pack(len(snapshot.copies)) + copies.tobytes()
    if snapshot.differences:
        packed += _COUNT.pack(len(snapshot.differences)) + _pairs(snapshot.differences)
    return packed


def _pairs(runs: Iterable[PageRun]) -> bytes:
    return np.array([(run.start, run.end) for run in runs], dtype="<u8").tobytes()


# Reading


Outlined: TypeAlias = tuple[Preamble, Snapshot]
"""What is known of a file that was verified, but for its pages. The preamble has the digest of every section."""


def decode(
    source: Source, max_contents_size: int = layout.MAX_CONTENTS_SIZE, *, threads: int = 1, known: Outlined | None = None
) -> Snapshot:
    """Read and verify a whole snapshot file.

    Args:
        max_contents_size: refuse a file that claims more bytes of pages than this.
        threads: that read and verify; more than one takes processors from what else runs here.
        known: of this file: its sections are not read again, as long as it begins with that preamble.

    Raises:
        FormatError: not a whole, unaltered snapshot of a version that we read; says what and where.
    """
    with opened(source) as reader:
        preamble = _read_preamble(reader)
        outline = known[1] if known is not None and known[0] == preamble else _read_outline(reader, preamble)[0]
        check_contents_size(preamble.contents_size, max_contents_size)
        contents = np.empty(preamble.contents_size, dtype=np.uint8).data

        def read(numbered: tuple[int, Frame]) -> None:
            index, frame = numbered
            target = contents[index * layout.FRAME_SIZE :][: frame.head.raw_size]
            read_frame(reader, frame, target)

        frames = enumerate(frames_of(reader, preamble))
        for _ in parallel.in_order(read, frames, worth(threads, preamble)):
            pass
    return replace(outline, contents=contents.toreadonly())


class Streamed(Struct, frozen=True):
    """A whole file that is read piece by piece, so that gigabytes of pages need no memory.

    Attributes:
        preamble, outline: all but the pages.
        digest: the digest that the position must have (`canonical_state.state_digest`), of the bytes as read.
        pieces: the bytes of the pages, in order, `layout.FRAME_SIZE` at a time: verified, and the caller's to change until the
            next piece is asked for. After the last one every byte of the file has been verified.
    """

    preamble: Preamble
    outline: Snapshot
    digest: bytes
    pieces: Iterator[memoryview]


@contextmanager
def streamed(source: Source) -> Iterator[Streamed]:
    """Open a whole file for one pass over it.

    Raises:
        FormatError: as `decode`, here or from the pieces.
    """
    with opened(source) as reader:
        preamble = _read_preamble(reader)
        outline, state = _read_outline(reader, preamble)
        check_contents_size(preamble.contents_size)
        digest = canonical_state.digest_of_state(outline.page_sum, state)
        yield Streamed(preamble, outline, digest, _pieces(reader, preamble))


def _pieces(reader: Reader, preamble: Preamble) -> Iterator[memoryview]:
    buffer = np.empty(min(preamble.contents_size, layout.FRAME_SIZE), dtype=np.uint8).data
    for frame in frames_of(reader, preamble):
        piece = buffer[: frame.head.raw_size]
        read_frame(reader, frame, piece)
        yield piece


def read_header(source: Source) -> Header:
    """Read and verify the header alone: cheap, for a file of any size.

    Raises:
        FormatError: no header of ours; the rest of the file is not looked at.
    """
    with opened(source) as reader:
        preamble = _read_preamble(reader)
        return _read_header(reader, preamble)


def read_outline(source: Source) -> Snapshot:
    """Read and verify everything but the pages: ``contents`` is empty, ``runs`` says what they would be.

    Raises:
        FormatError: as ``decode``; the pages are not looked at.
    """
    with opened(source) as reader:
        return outlined(reader)[1]


def read_state(source: Source) -> State:
    """Read and verify what a restore needs besides the pages, and which: cheap, and nothing is checked against the rest of it.

    Raises:
        FormatError: no state of ours; the rest of the file is not looked at.
    """
    with opened(source) as reader:
        preamble = _read_preamble(reader)
        state = _read_section(reader, preamble, SectionKind.STATE)
        return canonical_state.decode_state(state, is_tree=preamble.is_tree)


def is_of_several_processes(source: Source) -> bool:
    """Whether a file's preamble says so.

    Raises:
        FormatError: no file of ours; the rest of it is not looked at.
    """
    with opened(source) as reader:
        return _read_preamble(reader).is_tree


def read_pages(source: Source, wanted: Words) -> tuple[Snapshot, Flags, Rows]:
    """Read some pages of a file, and nothing of the others but the heads of their frames.

    Args:
        wanted: addresses, in order.

    Returns:
        The outline; which of the wanted pages the file tells (as a copy, perhaps, or as a difference); the bytes of those.

    Raises:
        FormatError: as ``decode``; frames without any of these pages are not looked at.
    """
    with opened(source) as reader:
        preamble, outline = outlined(reader)
        page_size = outline.machine.page_size
        found, places = _places_of(outline, wanted)
        rows = np.empty((len(places), page_size), dtype=np.uint8)
        frame_of = places * page_size // layout.FRAME_SIZE
        needed = set(frame_of.tolist())
        buffer = np.empty(layout.FRAME_SIZE, dtype=np.uint8)
        for index, frame in enumerate(frames_of(reader, preamble)):
            if index in needed:
                read_frame(reader, frame, buffer.data[: frame.head.raw_size])
                ours = frame_of == index
                rows[ours] = buffer.reshape(-1, page_size)[places[ours] - index * (layout.FRAME_SIZE // page_size)]
    return outline, found, rows


def _places_of(outline: Snapshot, wanted: Words) -> tuple[Flags, NDArray[np.intp]]:
    """Which of the wanted pages a snapshot tells, and the places of their bytes among the carried pages."""
    addresses, places = page_set.with_copied(outline.runs, outline.copies, outline.machine.page_size)
    found, at = page_set.found_among(addresses, wanted)
    return found, places[at]


def verify(source: Source) -> Header:
    """Check that every byte of a file is as it was written, without decompressing a page.

    Raises:
        FormatError: as ``decode``.
    """
    return canonical_state.header_of(verified(source)[1])


def verified(source: Source) -> Outlined:
    """The outline of a file of which every byte is as it was written; no page is decompressed.

    Raises:
        FormatError: as ``decode``.
    """
    with opened(source) as reader:
        preamble, outline = outlined(reader)
        body = np.empty(min(preamble.contents_size, layout.FRAME_SIZE), dtype=np.uint8).data  # used again: new memory costs time
        for frame in frames_of(reader, preamble):
            check_frame(reader, frame, body[: frame.head.stored_size])
    return preamble, outline


def outlined(reader: Reader) -> Outlined:
    """The preamble of a file, and what `read_outline` answers."""
    preamble = _read_preamble(reader)
    return preamble, _read_outline(reader, preamble)[0]


def _read_preamble(reader: Reader) -> Preamble:
    return Preamble.parse(reader.read(0, layout.PREAMBLE_SIZE))


def _read_header(reader: Reader, preamble: Preamble) -> Header:
    header = canonical_state.decode_header(_read_section(reader, preamble, SectionKind.HEADER))
    if header.contents_size != preamble.contents_size:
        raise FormatError(f"header: {header.contents_size} bytes of pages where the preamble says {preamble.contents_size}")
    return header


def _read_outline(reader: Reader, preamble: Preamble) -> tuple[Snapshot, bytes | memoryview]:
    """Every section, checked against one another; and the bytes of the state."""
    header = _read_header(reader, preamble)
    state = _read_section(reader, preamble, SectionKind.STATE)
    decoded = canonical_state.decode_state(state, is_tree=preamble.is_tree)
    table = _parse_runs(_read_section(reader, preamble, SectionKind.RUNS), preamble)
    output = canonical_state.decode_output(_read_section(reader, preamble, SectionKind.OUTPUT))
    snapshot = Snapshot(
        component=decoded.component,
        engine=decoded.engine,
        position=header.position,
        parent=header.parent,
        machine=decoded.machine,
        clocks=decoded.clocks,
        process=decoded.process,
        threads=decoded.threads,
        vmas=decoded.vmas,
        resources=decoded.resources,
        cleared=table.cleared,
        runs=table.runs,
        page_sum=header.page_sum,
        output=output,
        epoch=decoded.epoch,
        freeze_us=header.freeze_us,
        notes=header.notes,
        members=decoded.members,
        zombies=decoded.zombies,
        copies=table.copies,
        differences=table.differences,
    )
    if (expected := _version_of(snapshot)) != preamble.version:
        raise FormatError(f"format version {preamble.version}: its content has version {expected}")
    if canonical_state.header_of(snapshot) != header:
        raise FormatError("header: does not describe the other sections")
    check_snapshot(snapshot, contents_size=preamble.contents_size)
    return snapshot, state


def _read_section(reader: Reader, preamble: Preamble, kind: SectionKind) -> bytes | memoryview:
    """The raw bytes of one section, verified."""
    section = preamble.sections[kind - 1]
    where = f"section {kind.name.lower()}, {section.stored_size} bytes at {section.offset}"
    stored = reader.read(section.offset, section.stored_size)
    if len(stored) < section.stored_size:
        raise FormatError(f"{where}: the file ends inside it: it is cut off")
    if layout.digest_of(stored) != section.digest:
        raise FormatError(f"{where}: does not match its digest: the file was altered or damaged")
    if section.codec is Codec.RAW:
        return stored
    return compression.decompressed(stored, section.raw_size, where)


class _RunTable(Struct, frozen=True):
    """The fields of ``Snapshot`` with the same names."""

    cleared: tuple[PageRun, ...]
    runs: tuple[PageRun, ...]
    copies: tuple[PageCopy, ...]
    differences: tuple[PageRun, ...]


def _parse_runs(table: bytes | memoryview, preamble: Preamble) -> _RunTable:
    """Each list is as long as the count before it says, and nothing follows the last one."""
    cleared_count, run_count = _COUNTS.unpack(_part(table, 0, _COUNTS.size))
    end = _COUNTS.size + (cleared_count + run_count) * _RUN_SIZE
    runs = _runs(_part(table, _COUNTS.size, end))
    copied: bytes | memoryview = b""
    differing: bytes | memoryview = b""
    if preamble.is_tree:
        copied, end = _counted(table, end, _COPY_SIZE)
    if preamble.has_differences:
        differing, end = _counted(table, end, _RUN_SIZE)
    if end != len(table):
        raise FormatError(f"section runs: {len(table)} bytes cannot hold {cleared_count} cleared and {run_count} carried runs")
    rows = np.frombuffer(copied, dtype="<u8").reshape(-1, 3)
    copies = tuple(map(PageCopy, rows[:, 0].tolist(), rows[:, 1].tolist(), rows[:, 2].tolist()))
    return _RunTable(runs[:cleared_count], runs[cleared_count:], copies, _runs(differing))


def _counted(table: bytes | memoryview, offset: int, size: int) -> tuple[bytes | memoryview, int]:
    """A list of entries of one size with its count before it, and where it ends."""
    begin = offset + _COUNT.size
    end = begin + _COUNT.unpack(_part(table, offset, begin))[0] * size
    return _part(table, begin, end), end


def _part(table: bytes | memoryview, begin: int, end: int) -> bytes | memoryview:
    if end > len(table):
        raise FormatError(f"section runs: {len(table)} bytes are too few for its lists, which need {end}")
    return table[begin:end]


def _runs(packed: bytes | memoryview) -> tuple[PageRun, ...]:
    pairs = np.frombuffer(packed, dtype="<u8").reshape(-1, 2)
    return tuple(map(PageRun, pairs[:, 0].tolist(), pairs[:, 1].tolist()))
