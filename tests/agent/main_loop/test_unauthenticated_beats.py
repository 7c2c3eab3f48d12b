"""Unauthenticated heartbeats count as signs of the member from whose address they come, and as no more."""

from __future__ import annotations

import pytest

from agent.main_loop.unauthenticated_beats import TOLD_EVERY_NS, UnreadBeats
from failover.core.events import Unread
from failover.core.frames.frame import Reason, Refused

THERE = ("10.0.0.2", 7420)
BEATS = {"robot2": ("10.0.0.2:7420", "10.0.1.2:7420"), "robot3": ("10.0.0.3:7420",)}


@pytest.mark.parametrize("reason", [Reason.UNKNOWN_KEY, Reason.FORGED, Reason.TEAM, Reason.VERSION])
@pytest.mark.parametrize("sender", [THERE, ("10.0.1.2", 7420), ("::ffff:10.0.0.2", 7420), ("10.0.1.2", 50_000)])
def test_a_beat_that_is_not_believed_is_a_sign_of_the_robot_whose_address_it_comes_from(
    reason: Reason, sender: tuple[str, int]
) -> None:
    sign = UnreadBeats(BEATS).of_beat(Refused(reason), sender, 1)
    assert sign is not None and sign.robot == "robot2"


def test_robots_that_share_an_address_are_told_apart_by_their_ports() -> None:
    unread = UnreadBeats({"robot2": ("127.0.0.1:7001",), "robot3": ("127.0.0.1:7002",)})
    assert unread.of_beat(Refused(Reason.FORGED), ("127.0.0.1", 7002), 1) == Unread("robot3")
    assert unread.of_beat(Refused(Reason.FORGED), ("127.0.0.1", 7003), 1) == Unread("")


def test_an_unknown_address_is_somebodys_only_where_the_frame_names_our_team() -> None:
    unread = UnreadBeats(BEATS)
    assert unread.of_beat(Refused(Reason.TEAM), ("10.9.9.9", 7420), 1) is None
    assert unread.of_beat(Refused(Reason.VERSION), ("10.9.9.9", 7420), 1) is None
    assert unread.of_beat(Refused(Reason.UNKNOWN_KEY), ("10.9.9.9", 7420), 1) == Unread("")


@pytest.mark.parametrize("reason", [Reason.REPLAYED, Reason.EARLIER_LIFE, Reason.NOT_OURS])
def test_what_was_believed_before_or_is_no_beat_is_no_sign(reason: Reason) -> None:
    assert UnreadBeats(BEATS).of_beat(Refused(reason, "robot2"), THERE, 1) is None


def test_a_flood_of_them_is_told_once_a_second() -> None:
    unread = UnreadBeats(BEATS)
    signs = [unread.of_beat(Refused(Reason.UNKNOWN_KEY), THERE, 1 + n * TOLD_EVERY_NS // 10) for n in range(30)]
    assert len([sign for sign in signs if sign is not None]) == 3
    assert unread.of_beat(Refused(Reason.UNKNOWN_KEY), ("10.0.0.3", 7420), 2) == Unread("robot3"), "each robot for itself"


def test_a_frame_with_the_right_code_is_its_senders_wherever_it_comes_from() -> None:
    sign = UnreadBeats(BEATS).of_beat(Refused(Reason.MALFORMED, "robot3"), THERE, 1)
    assert sign is not None and sign.robot == "robot3" and "release" in sign.why
