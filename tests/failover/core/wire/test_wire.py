"""The bytes of the replication link, and sizes and ranges of heartbeats; their frames: tests/failover/core/frames."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.beat_builder import Speaker
from failover.core.frames.frame import beat_size_max
from failover.core.wire import codec
from failover.core.wire.messages import Beat, Chunk, Echo, Entry

ENTRY = Entry("/lab/robot1/mapper", 3, 7, "robot1", 449, 12, bytes(16), "robot2")
SAMPLE = Beat("robot1", 3, 41, 40, 1, 1, (Echo("robot2", 9, 1000),), (ENTRY,), 2)
PROTOCOL = Path(codec.__file__).with_name("PROTOCOL.md")


def test_the_sample_of_the_protocol_is_what_we_send() -> None:
    text = PROTOCOL.read_text()
    block = text[text.index("## 4. Sample") :].split("```")[1]
    assert bytes.fromhex("".join(block.split())) == msgspec.msgpack.encode(SAMPLE)


@pytest.mark.parametrize(
    "beat",
    [
        Beat("robot1", 0, 1),
        Beat("robot1", 1, 0),
        Beat("robot1", 1, 1, 2),
        Beat("robot1", 1, 1, total=-1),
        Beat("robot1", 1 << 62, 1),
        Beat("robot1", 1, 1, entries=(Entry("/x", 3, 1 << 63, "robot1"),)),
        Beat("robot1", 1, 1, entries=(Entry("/x", 3, 1, "r" * 64),)),
        Beat("robot1", 1, 1, entries=(Entry("/x", 3, 1, digest=bytes(33)),)),
    ],
)
def test_numbers_beyond_all_sense_are_refused(beat: Beat) -> None:
    assert codec.is_sound(SAMPLE)
    assert not codec.is_sound(beat)


@given(st.binary(max_size=1300))
def test_no_bytes_make_the_decoder_raise(body: bytes) -> None:
    codec.decode_bulk(body)


def test_many_components_are_told_of_in_turn_and_each_beat_fits_a_frame() -> None:
    entries = {
        f"/lab/robot1/part{index:03}": Entry(f"/lab/robot1/part{index:03}", 3, 1, "robot1", 64, 9, bytes(16))
        for index in range(100)
    }
    speaker, heard = Speaker("robot1", 1), set()
    for _ in range(12):
        beat = speaker.beat(entries, (Echo("robot2", 9, 1000),))
        assert codec.beat_size(beat) <= beat_size_max(2)
        heard |= {entry.name for entry in beat.entries}
    assert heard == set(entries)


def test_a_bulk_message_survives_the_wire() -> None:
    assert codec.decode_bulk(codec.encode_bulk(Chunk(1, 0, b"content"))) == Chunk(1, 0, b"content")
