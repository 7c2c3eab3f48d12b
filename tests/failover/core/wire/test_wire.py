"""Frames of heartbeats: which are believed, and which are refused by value."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.beat_builder import Speaker
from failover.core.wire import codec
from failover.core.wire.codec import Reason, Receiver, Refused, seal
from failover.core.wire.messages import Beat, Chunk, Echo, Entry

KEY = bytes(range(32))
OTHER_KEY = bytes(reversed(range(32)))
ENTRY = Entry("/lab/robot1/mapper", 3, 7, "robot1", 449, 12, bytes(16), "robot2")
SAMPLE = Beat("robot1", 3, 41, 40, 1, 1, (Echo("robot2", 9, 1000),), (ENTRY,), 2)
PROTOCOL = Path(codec.__file__).with_name("PROTOCOL.md")


def receiver() -> Receiver:
    opened = Receiver("team")
    opened.accept("robot1", KEY)
    return opened


def test_a_beat_survives_the_wire() -> None:
    assert receiver().open(seal(SAMPLE, "team", KEY)) == SAMPLE


def test_the_sample_of_the_protocol_is_what_we_send() -> None:
    text = PROTOCOL.read_text()
    block = text[text.index("## 4. Sample") :].split("```")[1]
    assert bytes.fromhex("".join(block.split())) == seal(SAMPLE, "team", KEY)


def test_a_frame_is_believed_once() -> None:
    opened, frame = receiver(), seal(SAMPLE, "team", KEY)
    opened.open(frame)
    assert opened.open(frame) == Refused(Reason.REPLAYED, "robot1")


def test_late_frames_inside_the_window_are_believed_and_older_ones_are_not() -> None:
    opened = receiver()
    opened.open(seal(Beat("robot1", 1, 100), "team", KEY))
    assert opened.open(seal(Beat("robot1", 1, 37), "team", KEY)) == Beat("robot1", 1, 37)
    assert opened.open(seal(Beat("robot1", 1, 36), "team", KEY)) == Refused(Reason.REPLAYED, "robot1")


def test_an_earlier_life_is_refused_and_a_later_one_begins_anew() -> None:
    opened = receiver()
    opened.open(seal(Beat("robot1", 5, 100), "team", KEY))
    assert opened.open(seal(Beat("robot1", 4, 101), "team", KEY)) == Refused(Reason.EARLIER_LIFE, "robot1")
    assert opened.open(seal(Beat("robot1", 6, 1), "team", KEY)) == Beat("robot1", 6, 1)
    assert opened.open(seal(Beat("robot1", 5, 102), "team", KEY)) == Refused(Reason.EARLIER_LIFE, "robot1")


def test_a_forged_boot_count_does_not_reset_the_window() -> None:
    opened, frame = receiver(), seal(Beat("robot1", 5, 100), "team", KEY)
    opened.open(frame)
    forged = bytearray(seal(Beat("robot1", 9, 1), "team", KEY))
    forged[20] ^= 1
    assert opened.open(bytes(forged)) == Refused(Reason.FORGED)
    assert opened.open(frame) == Refused(Reason.REPLAYED, "robot1")


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (b"", Reason.NOT_OURS),
        (bytes(1201), Reason.NOT_OURS),
        (seal(SAMPLE, "team", OTHER_KEY), Reason.UNKNOWN_KEY),
        (seal(SAMPLE, "neighbours", KEY), Reason.TEAM),
        (b"fB\x02" + seal(SAMPLE, "team", KEY)[3:], Reason.VERSION),
    ],
)
def test_strangers_are_refused_by_name(frame: bytes, reason: Reason) -> None:
    assert receiver().open(frame) == Refused(reason)


def test_one_robot_cannot_speak_for_another() -> None:
    assert receiver().open(seal(Beat("robot2", 1, 1), "team", KEY)) == Refused(Reason.SENDER, "robot1")


def test_numbers_beyond_all_sense_are_refused() -> None:
    mad = Beat("robot1", 1, 1, entries=(Entry("/x", 3, 1 << 63, "robot1"),))
    assert receiver().open(seal(mad, "team", KEY)) == Refused(Reason.MALFORMED, "robot1")


def test_the_key_before_the_present_one_stays_valid_and_the_one_before_that_does_not() -> None:
    opened = receiver()
    keys = [bytes([number]) * 32 for number in (1, 2)]
    for key in keys:
        opened.accept("robot1", key)
    assert isinstance(opened.open(seal(Beat("robot1", 1, 1), "team", keys[0])), Beat)
    assert isinstance(opened.open(seal(Beat("robot1", 1, 2), "team", keys[1])), Beat)
    assert opened.open(seal(Beat("robot1", 1, 3), "team", KEY)) == Refused(Reason.UNKNOWN_KEY)


@given(st.binary(max_size=1300))
def test_no_bytes_make_the_receiver_raise(frame: bytes) -> None:
    assert isinstance(receiver().open(frame), Refused)
    codec.decode_bulk(frame)


@given(st.binary(max_size=200))
def test_an_authentic_body_of_any_bytes_is_refused_by_value(body: bytes) -> None:
    header = seal(SAMPLE, "team", KEY)[:16]
    assert isinstance(receiver().open(header + codec._code(KEY, header, body) + body), Refused)


@given(st.integers(0, 10_000))
def test_one_changed_bit_is_always_refused(where: int) -> None:
    frame = bytearray(seal(SAMPLE, "team", KEY))
    frame[where // 8 % len(frame)] ^= 1 << where % 8
    assert isinstance(receiver().open(bytes(frame)), Refused)


def test_many_components_are_told_of_in_turn_and_each_frame_fits() -> None:
    entries = {
        f"/lab/robot1/part{index:03}": Entry(f"/lab/robot1/part{index:03}", 3, 1, "robot1", 64, 9, bytes(16))
        for index in range(100)
    }
    speaker, heard = Speaker("robot1", 1), set()
    for _ in range(12):
        beat = speaker.beat(entries, (Echo("robot2", 9, 1000),))
        assert len(seal(beat, "team", KEY)) <= codec.FRAME_SIZE_MAX
        heard |= {entry.name for entry in beat.entries}
    assert heard == set(entries)


def test_a_bulk_message_survives_the_wire() -> None:
    assert codec.decode_bulk(codec.encode_bulk(Chunk(1, 0, b"content"))) == Chunk(1, 0, b"content")
