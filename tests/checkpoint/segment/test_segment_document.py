"""SEGMENT.md is normative: a reader written from the document alone reads what our writer writes."""

from __future__ import annotations

import os
import re
from pathlib import Path

from checkpoint.segment import layout as segment_layout
from checkpoint.segment.writer import SegmentWriter
from tests.checkpoint.segments import layout, source

DOCUMENT = (Path(segment_layout.__file__).parent / "SEGMENT.md").read_text()


def number(content: bytes, offset: int, size: int = 8) -> int:
    return int.from_bytes(content[offset : offset + size], "little")


def whole(size: int) -> int:
    return -(-size // 4096) * 4096


def test_a_reader_written_from_the_document_reads_what_was_committed() -> None:
    writer = SegmentWriter(layout(100, 3 * 4096))
    writer.commit([source(b"first"), source(b"a" * 3 * 4096)])
    writer.commit([source(b"second"), source(b"a" * 4096 + b"b" * 2 * 4096)])
    content = os.pread(writer.descriptor, 1 << 30, 0)
    writer.close()
    assert content[:8] == bytes.fromhex("89464f5345470d0a")
    assert (number(content, 8, 4), number(content, 12, 4)) == (1, 4096)
    regions, banks, pages = number(content, 16, 4), number(content, 20, 4), number(content, 24)
    assert (regions, banks, pages, number(content, 32)) == (2, 3, 4, len(content))
    commit, bank = divmod(number(content, 256), 256)
    assert commit == 2 and number(content, 512 + 64 * bank) == 2
    versions = 4096 + whole(256 * regions) + bank * whole(8 * pages)
    assert [number(content, versions + 8 * page) for page in range(pages)] == [2, 1, 2, 2]
    start = 4096 + whole(256 * regions) + banks * whole(8 * pages) + bank * 4096 * pages
    assert content[start : start + 6] == b"second" and content[start + 4096 : start + 8192] == b"a" * 4096
    second = 4096 + 256
    assert (number(content, second, 4), number(content, second + 16), number(content, second + 24)) == (2, 3 * 4096, 1)
    assert content[second + 32 :][: number(content, second + 4, 4)] == b"region 1"


def test_the_limits_in_the_document_are_those_of_the_code() -> None:
    assert f"1 to {segment_layout.MAX_REGIONS}" in DOCUMENT
    assert f"at most {segment_layout.MAX_PAGES}" in DOCUMENT
    assert f"3 to {segment_layout.MAX_BANKS}" in DOCUMENT
    assert f"1 to {segment_layout.MAX_NAME_SIZE}" in DOCUMENT
    assert bytes.fromhex(re.search(r"magic `([0-9a-f ]+)`", DOCUMENT)[1].replace(" ", "")) == segment_layout.MAGIC  # type: ignore[index]
    assert (segment_layout.MAX_PLACES, segment_layout.STRIDE) == (1 << 20, 1 << 37)
