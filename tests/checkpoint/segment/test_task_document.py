"""TASK.md is normative: packets written and read by the document alone are those of the code, and nothing else is taken."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checkpoint.errors import TaskPacketError
from checkpoint.segment import task_messages
from checkpoint.segment.task_messages import REASONS, Begin, FromGuard, Hello, Keeps, Kept, Origin, Packet, Refused, Safe
from failover.core.types import Resumption

DOCUMENT = (Path(task_messages.__file__).parent / "TASK.md").read_text()
BEGIN = Begin("/lab/heater", 3, (100, 101))
RESUMED = Begin("/lab/heater", 4, (102, 103), Origin("robot1", 129, "taken over", 250_000_000))
FROM_GUARD: tuple[FromGuard, ...] = (BEGIN, RESUMED, Refused("another process keeps it"), Safe(42), Kept(43))
FROM_PROGRAM = (Hello(), Keeps())
HEAD = [(0, 4), (4, 4)]


def cells(line: str) -> list[str]:
    return [cell.strip().strip("`") for cell in line.strip("|").split("|")]


def kinds() -> dict[str, tuple[int, int]]:
    """Name → (kind, size), of the table."""
    rows = [cells(line) for line in DOCUMENT.splitlines() if re.match(r"\| \d \| `\w+` \|", line)]
    return {name: (int(kind), int(size)) for kind, name, _, size, _ in rows}


def fields(packet: str) -> list[tuple[int, int]]:
    """(offset, size) of each field of a packet, its head included."""
    part = DOCUMENT.partition(f"\n### {packet}\n")[2].partition("\n#")[0]
    rows = [cells(line) for line in part.splitlines() if re.match(r"\| \d+ \|", line)]
    return HEAD + [(int(offset), int(size)) for offset, size, _ in rows]


def in_fields(packet: Packet) -> list[int | bytes]:
    """What the document says that a packet's bytes mean: numbers, and fields of text."""
    content = task_messages.encode(packet)
    parts = [content[offset : offset + size] for offset, size in fields(type(packet).__name__)]
    return [int.from_bytes(part, "little") if len(part) <= 8 else part for part in parts]


@pytest.mark.parametrize("packet", [*FROM_GUARD, *FROM_PROGRAM], ids=lambda packet: type(packet).__name__)
def test_kind_version_and_size_are_those_of_the_document(packet: Packet) -> None:
    content = task_messages.encode(packet)
    kind, size = kinds()[type(packet).__name__]
    assert (int.from_bytes(content[:4], "little"), int.from_bytes(content[4:8], "little"), len(content)) == (kind, 1, size)
    assert [offset for offset, _ in fields(type(packet).__name__)][1:] + [size] == [
        offset + length for offset, length in fields(type(packet).__name__)
    ], "fields follow one another without a gap, to the end"


def test_every_field_means_what_the_document_says() -> None:
    begun = b"/lab/heater".ljust(256, b"\0")
    assert in_fields(BEGIN) == [2, 1, 3, 100, 101, 0, 0, 0, 0, begun, bytes(64)]
    assert in_fields(RESUMED) == [2, 1, 4, 102, 103, 2, 0, 129, 250_000_000, begun, b"robot1".ljust(64, b"\0")]
    assert in_fields(Refused("no")) == [3, 1, b"no".ljust(504, b"\0")]
    assert in_fields(Safe(42)) == [5, 1, 42]
    assert in_fields(Kept(42)) == [6, 1, 42]
    told = re.search(r"why it goes on from a state: 0 it does not, it begins; (.*) \|", DOCUMENT)
    assert told is not None
    assert told[1] == "; ".join(f"{number} {why}" for number, why in enumerate(REASONS, 1))
    assert tuple(Resumption) == REASONS


def test_the_example_in_the_document_is_what_we_send() -> None:
    example = DOCUMENT.partition("## Bytes")[2]
    shown = re.findall(r"^(Hello|Begin|Keeps|Safe) ((?: +[0-9a-f]{2})+(?:\n {9}[0-9a-f ]+)?)", example, re.MULTILINE)
    packets = {"Hello": Hello(), "Begin": BEGIN, "Keeps": Keeps(), "Safe": Safe(42)}
    assert {name for name, _ in shown} == set(packets)
    for name, text in shown:
        assert task_messages.encode(packets[name]).rstrip(b"\0") == bytes.fromhex(text).rstrip(b"\0")


def test_the_limits_of_the_document_are_those_of_the_code() -> None:
    assert f"at most {task_messages.PACKET_SIZE_MAX} bytes" in DOCUMENT
    assert max(size for _, size in kinds().values()) == task_messages.PACKET_SIZE_MAX
    assert f"{task_messages.VARIABLE}={task_messages.NAME_PREFIX}0123456789abcdef" in DOCUMENT


@pytest.mark.parametrize("packet", FROM_GUARD, ids=lambda packet: type(packet).__name__)
def test_a_program_understands_what_a_guard_says(packet: FromGuard) -> None:
    assert task_messages.from_guard(task_messages.encode(packet)) == packet


def test_a_guard_understands_what_a_program_says() -> None:
    assert [task_messages.from_program(task_messages.encode(packet)) for packet in FROM_PROGRAM] == list(FROM_PROGRAM)


def test_each_side_takes_only_what_the_other_may_say() -> None:
    for packet in FROM_GUARD:
        with pytest.raises(TaskPacketError, match="none that programs send"):
            task_messages.from_program(task_messages.encode(packet))
    for answer in FROM_PROGRAM:
        with pytest.raises(TaskPacketError, match="none that guards send"):
            task_messages.from_guard(task_messages.encode(answer))


@pytest.mark.parametrize(
    ("offset", "put", "sentence"),
    [
        (4, b"\x02", "version 2"),
        (32, b"\x04", "reason 4"),
        (36, b"\x01", "reason 2 and 1"),
        (56, bytes(256), "without the name"),
        (56, b"a" * 256, "no text that ends with zeros"),
        (56, b"a\0b", "no text that ends with zeros"),
        (56, b"\xff", "not UTF-8"),
        (32, b"\x00", "an origin and without a reason"),
    ],
)
def test_a_beginning_that_contradicts_the_document_is_refused_with_its_reason(offset: int, put: bytes, sentence: str) -> None:
    content = bytearray(task_messages.encode(RESUMED))
    content[offset : offset + len(put)] = put
    with pytest.raises(TaskPacketError, match=sentence):
        task_messages.from_guard(bytes(content))


@pytest.mark.parametrize("packet", [*FROM_GUARD, *FROM_PROGRAM], ids=lambda packet: type(packet).__name__)
def test_a_packet_that_is_cut_or_longer_is_refused(packet: Packet) -> None:
    content = task_messages.encode(packet)
    read = task_messages.from_program if isinstance(packet, Hello | Keeps) else task_messages.from_guard
    for wrong in (*(content[:size] for size in range(len(content))), content + b"\0"):
        with pytest.raises(TaskPacketError):
            read(wrong)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=600) | st.tuples(st.integers(0, 6), st.binary(max_size=520)).map(lambda drawn: named(*drawn)))
def test_whatever_comes_is_a_packet_or_refused(content: bytes) -> None:
    for read in (task_messages.from_program, task_messages.from_guard):
        try:
            packet = read(content)
        except TaskPacketError:
            continue
        assert task_messages.encode(packet) == content, "what is taken says nothing that was not understood"


def named(kind: int, body: bytes) -> bytes:
    """Bytes that begin as a packet of our version does, of about the right size."""
    size = dict(kinds().values()).get(kind, len(body) + 8)
    return kind.to_bytes(4, "little") + (1).to_bytes(4, "little") + body[: size - 8].ljust(size - 8, b"\0")


def test_a_reason_that_is_too_long_is_cut_and_still_text() -> None:
    said = task_messages.from_guard(task_messages.encode(Refused("ö" * 600)))
    assert said == Refused("ö" * 251)
