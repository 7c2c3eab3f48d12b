"""BOARD.md is normative: a reader written from the document alone reads the sample, and what our layout writes is the sample."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from failover.core.board import layout
from tests.failover.core.board.board_bytes import SAMPLE, sample

DOCUMENT = (Path(layout.__file__).parent / "BOARD.md").read_text()


def number(content: bytes, offset: int, size: int = 8) -> int:
    return int.from_bytes(content[offset : offset + size], "little")


def text(content: bytes, offset: int) -> str:
    return content[offset + 2 : offset + 2 + number(content, offset, 2)].decode()


def test_a_reader_written_from_the_document_reads_the_sample() -> None:
    content = SAMPLE.read_bytes()
    assert content[:8] == bytes.fromhex("89464f4252440d0a")
    assert [number(content, offset, 4) for offset in (8, 12, 24, 28)] == [1, 2 + 8, 2, 2]
    assert (number(content, 16), number(content, 32), content[40:56]) == (6, len(content), bytes(range(16)))
    assert (content[64:128].rstrip(b"\0"), number(content, 136, 4), number(content, 140, 4)) == (b"robot1", 0, 2)
    assert (number(content, 4096, 4), number(content, 4100, 4)) == (4711, 1000)
    assert content[4104:4160].rstrip(b"\0") == b"/lab/robot1/vision"
    ball, plan = 20480, 20480 + 192
    assert [number(content, ball + offset, 2) for offset in (4, 6)] == [1, 2]
    assert [number(content, plan + offset, 2) for offset in (4, 6)] == [2, 4]
    assert [number(content, plan + offset, 4) for offset in (0, 16, 20, 24, 28)] == [1, 512, 576, 5, 2]
    assert (number(content, ball + 32), number(content, ball + 48)) == (0x1122334455667788, 120_000_000)
    name = number(content, ball + 40)
    assert (text(content, name), text(content, name + 2 + 4)) == ("ball", "{x:f4,y:f4,seen:u4}")
    assert (number(content, ball + 64), number(content, plan + 64), number(content, ball + 76, 4)) == (3, 0, 4711)
    offset, stride = number(content, ball + 8), number(content, ball + 20, 4)
    assert offset % 64 == 0 and stride == 64
    bank = offset + 3 % 2 * stride
    assert struct.unpack_from("<QQQII", content, bank) == (3, 3_000_000_000, 0, 12, 3)
    assert struct.unpack_from("<ffI", content, bank + 32) == (3.0, 2.5, 103)


def test_our_layout_writes_the_sample() -> None:
    assert sample() == SAMPLE.read_bytes()


def test_our_layout_reads_the_sample() -> None:
    content = SAMPLE.read_bytes()
    header = layout.read_header(content)
    assert (header.robot, header.generation, header.count, header.state) == ("robot1", 6, 2, layout.RUN)
    ball, plan = layout.read_records(content, header)
    assert (ball.name, ball.text, ball.size, ball.index) == ("ball", "{x:f4,y:f4,seen:u4}", 12, 0)
    assert (plan.name, plan.banks, plan.period, plan.phase) == ("plan", 4, 5, 2)
    assert layout.read_user(content, 0) == (4711, 1000, "/lab/robot1/vision")


def test_the_limits_in_the_document_are_those_of_the_code() -> None:
    assert bytes.fromhex(re.search(r"magic `([0-9A-F ]+)`", DOCUMENT)[1]) == layout.MAGIC  # type: ignore[index]
    assert (layout.ITEMS_MAX, layout.ITEM_SIZE_MAX, layout.BLOCK_SIZE_MAX, layout.USERS_MAX) == (1024, 65536, 16 << 20, 256)
    assert "capacity: records for which there is room, 1 to 1024" in DOCUMENT and "at most 16 MiB" in DOCUMENT
    assert "most bytes of a value, 1 to 65536" in DOCUMENT and "banks, 2 to 8" in DOCUMENT
    fields = dict(re.findall(r"^\| (\d+) \| \d \| (.+?)[;:,.(]? ", DOCUMENT, flags=re.MULTILINE))
    assert fields["64"] in ("name", "**newest**")
    assert (layout.USERS_AT, layout.RECORDS_AT, layout.RECORD_SIZE) == (4096, 4096 + 64 * 256, 192)
    assert (layout.USER_LOCKS, layout.WRITER_LOCKS, layout.TABLE_LOCK) == (2**40, 2**41, 2**62)
