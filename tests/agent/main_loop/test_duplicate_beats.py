"""A frame arrives once over each link of its sender; a second copy over one link is a replay."""

from __future__ import annotations

from agent.main_loop.duplicate_beats import RECENT_PARTS, Copies
from failover.core.frames.frame import Part, Reason, Refused


def beat(counter: int, boot: int = 1) -> Part:
    return Part("robot1", True, 0, 0, 0, boot, counter, 0, 0, 1, None, None, (), 0)


def again(counter: int, reason: Reason = Reason.REPLAYED) -> Refused:
    return Refused(reason, "robot1", counter)


def test_a_copy_over_another_link_proves_that_link_once() -> None:
    copies = Copies()
    copies.heard(beat(7), "eth0")
    assert copies.admit(again(7), "wlan0", 100)
    assert not copies.admit(again(7), "wlan0", 200)
    assert copies.take("robot1") == (("wlan0", 100),)
    assert copies.take("robot1") == ()


def test_what_comes_a_second_time_over_the_link_that_brought_it_is_a_replay() -> None:
    copies = Copies()
    copies.heard(beat(7), "eth0")
    assert not copies.admit(again(7), "eth0", 100)
    assert copies.take("robot1") == ()


def test_a_copy_of_a_beat_long_past_is_a_replay() -> None:
    copies = Copies()
    for counter in range(1, RECENT_PARTS + 2):
        copies.heard(beat(counter), "eth0")
    assert not copies.admit(again(1), "wlan0", 100)
    assert copies.admit(again(2), "wlan0", 100)


def test_a_new_life_of_the_sender_forgets_what_the_last_one_sent() -> None:
    copies = Copies()
    copies.heard(beat(7), "eth0")
    copies.heard(beat(1, boot=2), "eth0")
    assert not copies.admit(again(7), "wlan0", 100)


def test_only_beats_that_are_authentic_and_were_heard_prove_a_link() -> None:
    copies = Copies()
    copies.heard(beat(7), "eth0")
    assert not copies.admit(again(7, Reason.FORGED), "wlan0", 100)
    assert not copies.admit(again(8), "wlan0", 100)
    assert not copies.admit(Refused(Reason.REPLAYED, "robot2", 7), "wlan0", 100)
    assert not copies.admit(again(7), "", 100)


def test_a_frame_comes_over_one_link_by_cast_and_by_unicast_and_each_once() -> None:
    copies = Copies()
    copies.heard(beat(7), "eth0", cast=True)
    assert not copies.admit(again(7), "eth0", 100, cast=True)
    assert copies.admit(again(7), "eth0", 200)
    assert not copies.admit(again(7), "eth0", 300)


def test_each_medium_counts_by_itself() -> None:
    copies = Copies()
    copies.heard(beat(7), "eth0")
    assert not copies.admit(again(7), "wlan0", 100, medium=1)
