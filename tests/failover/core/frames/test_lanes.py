"""The lanes of one robot: each medium counts by itself, and a lane that comes later has all keys."""

from __future__ import annotations

import pytest

from failover.core.frames.frame import MAGIC, MAGIC_BEFORE, VERSION, Portion, Reason, Refused
from failover.core.frames.lane import FrameLane, Heard
from failover.core.frames.lanes import MEDIA_MAX, FrameLanes, medium_of
from failover.core.frames.roster import roster

TEAM = roster(["robot1", "robot2"])
ITEM = Portion(0, 0, 1, b"value")


def lanes(me: str, other: str) -> FrameLanes:
    made = FrameLanes(lambda medium: FrameLane(me, "team", TEAM, 1, 20_000, medium))
    for number in (1, 2, 3):
        made.speak(other, f"key {number} of {me} to {other}".encode())
        made.hear(other, f"key {number} of {other} to {me}".encode())
    return made


def datagram(by: FrameLanes, medium: int) -> bytes:
    ((sealed,), placed) = by.lane(medium).seal(None, (ITEM,), 1_000)
    assert placed == 1
    return sealed.datagrams[0]


def test_a_lane_that_is_made_for_the_first_frame_of_a_medium_reads_it_with_the_keys_of_before() -> None:
    first, second = lanes("robot1", "robot2"), lanes("robot2", "robot1")
    frame = datagram(first, 3)
    assert medium_of(frame) == 3
    heard = second.open(frame, 2_000)
    assert isinstance(heard, Heard)
    assert (heard.part.medium, heard.part.counter, heard.items) == (3, 1, (ITEM,))
    assert len(second.all()) == 2


def test_each_medium_counts_by_itself_and_a_frame_is_taken_once() -> None:
    first, second = lanes("robot1", "robot2"), lanes("robot2", "robot1")
    frames = [datagram(first, medium) for medium in (0, 1, 0, 1)]
    counters = [heard.part.counter for frame in frames if isinstance(heard := second.open(frame, 2_000), Heard)]
    assert counters == [1, 1, 2, 2]
    refused = [second.open(frame, 2_000) for frame in frames]
    assert [one.reason for one in refused if isinstance(one, Refused)] == [Reason.REPLAYED] * 4


def test_a_frame_under_the_number_of_another_medium_is_no_authentic_one() -> None:
    first, second = lanes("robot1", "robot2"), lanes("robot2", "robot1")
    frame = datagram(first, 0)
    moved = second.open(frame[:6] + b"\1\0" + frame[8:], 2_000)
    assert isinstance(moved, Refused) and moved.reason is Reason.FORGED


def test_a_peer_whose_older_keys_are_forgotten_is_believed_by_the_newest_on_each_medium() -> None:
    second = lanes("robot2", "robot1")
    older, newest = (FrameLanes(lambda medium: FrameLane("robot1", "team", TEAM, 1, 20_000, medium)) for _ in range(2))
    older.speak("robot2", b"key 2 of robot1 to robot2")
    newest.speak("robot2", b"key 3 of robot1 to robot2")
    assert isinstance(second.open(datagram(older, 1), 2_000), Heard)
    second.forget_older("robot1")
    assert isinstance(second.open(datagram(older, 1), 2_000), Refused)
    assert isinstance(second.open(datagram(older, 2), 2_000), Refused), "a lane that is made later"
    assert isinstance(second.open(datagram(newest, 2), 2_000), Heard)


@pytest.mark.parametrize("medium", [b"\0\0", b"\1\0", b"\x09\0", b"\xa5\xff"])
@pytest.mark.parametrize("begin", [MAGIC_BEFORE + b"\4\0", MAGIC + bytes([VERSION + 1, 0])])
def test_a_heartbeat_of_another_release_is_told_from_what_is_no_frame_whatever_bytes_it_has(begin: bytes, medium: bytes) -> None:
    second = lanes("robot2", "robot1")
    assert second.open(begin + b"??" + medium + bytes(range(200)), 2_000) == Refused(Reason.VERSION)


def test_a_number_beyond_all_media_makes_no_lane() -> None:
    second = lanes("robot2", "robot1")
    frame = datagram(lanes("robot1", "robot2"), 0)
    beyond = second.open(frame[:6] + (MEDIA_MAX + 1).to_bytes(2, "little") + frame[8:], 2_000)
    assert isinstance(beyond, Refused) and beyond.reason is Reason.NOT_OURS
    assert len(second.all()) == 1
