"""The slots' arithmetic to the nanosecond, odd frames, any schedule of arrivals. Whole teams: ``tests/simulation``."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.frames.roster import pack_seen, roster, word
from failover.core.frames.slots import SMOOTHED, Slots
from failover.core.frames.terms import US, Own, Said, Seen, SlotView, Terms
from failover.core.types import MS

TEAM = roster(f"robot{number}" for number in range(1, 7))
T_NS = 50 * MS
C_NS = 2 * MS
START_NS = 10**18


def frame(rank: int, members: set[int], counter: int = 1, boot: int = 1, **said: Any) -> SlotView:
    """Of a robot that runs all members of its set."""
    views = pack_seen([Seen.RUN if other in members else Seen.NOT for other in range(len(TEAM))])
    fields = {"t_tup_us": 50_000, "set": word(members), "set_round": 1, "views": views, "echo": ()} | said
    return SlotView(rank, boot, counter, Said(**fields))


class Bench:
    """One robot whose peers are made up; its timer is exact."""

    def __init__(self, me: int, members: set[int], **terms: Any) -> None:
        self.slots = Slots(me, TEAM, Terms(**terms), START_NS)
        self.me, self.members, self.sends, self.counter = me, members, [], 0

    def until(self, instant_ns: int) -> None:
        """Sends whatever is due before."""
        while self.slots.next_ns() < instant_ns:
            now_ns = self.slots.next_ns()
            if self.slots.due(now_ns):
                self.slots.says(now_ns)
                self.counter += 1
                self.slots.sent(now_ns, self.counter)
                self.sends.append(now_ns)

    def hears(self, rank: int, left_ns: int, **said: Any) -> None:
        """A frame that left then and travelled for as long as is assumed."""
        self.until(left_ns + C_NS)
        self.slots.heard(frame(rank, self.members, **said), left_ns + C_NS)

    def settled(self, rounds: int = 6) -> int:
        """Peers send in their slots, counted from 100 ms on, until all run; the reference's phase in the last round."""
        others = sorted(self.members - {self.me})
        phase_ns = START_NS + 100 * MS if self.me != min(self.members) else self._own_phase()
        for number in range(rounds):
            for rank in others:
                place = sorted(self.members).index(rank)
                self.hears(rank, phase_ns + number * T_NS + place * T_NS // len(self.members))
        if self.me == min(self.members):
            self.until(self.slots.next_ns() + 1)
            return self.sends[-1]
        return phase_ns + (rounds - 1) * T_NS

    def _own_phase(self) -> int:
        self.until(START_NS + 100 * MS)
        return self.sends[-1]


# --- The start -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rank", range(6))
def test_robots_that_start_together_begin_at_different_times(rank: int) -> None:
    slots = Slots(rank, TEAM, Terms(), START_NS)
    assert slots.own is Own.LISTENING
    assert slots.next_ns() == START_NS + T_NS + rank * T_NS // 6
    assert not slots.due(slots.next_ns() - 1)
    assert slots.due(slots.next_ns())
    assert slots.own is Own.RUNNING


def test_a_robot_that_hears_a_team_begins_in_the_middle_of_a_gap() -> None:
    bench = Bench(4, {0, 1})
    bench.hears(0, START_NS + 10 * MS)
    bench.hears(1, START_NS + 35 * MS)
    assert bench.slots.next_ns() == START_NS + 60 * MS + T_NS // 4


def test_a_robot_that_hears_one_that_is_alone_begins_by_rank_after_it() -> None:
    bench = Bench(3, {0})
    bench.hears(0, START_NS + 20 * MS)
    assert bench.slots.next_ns() == START_NS + 20 * MS + T_NS // 2 + T_NS


# --- The reference ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("delay_us", "followed_us"), [(0, 0), (1_000, 0), (1_001, 1_001), (8_332, 8_332), (8_334, 0), (-3_000, 0)]
)
def test_the_reference_follows_delays_between_delta_min_and_two_thirds_of_a_slot(delay_us: int, followed_us: int) -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    assert bench.slots.view().count == 4
    bench.hears(2, sent_ns + T_NS // 2 + delay_us * 1_000)
    assert bench.slots.next_ns() == sent_ns + T_NS + followed_us * 1_000
    assert bench.slots.view().outside == (delay_us == 8_334)
    assert bench.slots.view().peers[1].offset_us == delay_us


def test_the_reference_follows_the_longest_delay_of_a_round() -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    for rank, late_ms in ((1, 2), (2, 5), (3, 3)):
        bench.hears(rank, sent_ns + rank * T_NS // 4 + late_ms * MS)
    assert bench.slots.next_ns() == sent_ns + 55 * MS
    bench.until(sent_ns + 56 * MS)
    assert bench.slots.next_ns() == sent_ns + 105 * MS, "a delay counts once"
    assert bench.slots.view().followed == 1


def test_a_frame_that_left_before_ours_and_came_after_it_counts_from_the_round_before() -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    bench.hears(3, sent_ns - 1 * MS)
    assert bench.slots.view().peers[2].offset_us == pytest.approx(50_000 - 1_000 - 37_500)


def test_the_reference_follows_nobody_outside_its_set() -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    bench.hears(5, sent_ns + 5 * MS, set=word({5}))
    assert bench.slots.next_ns() == sent_ns + T_NS


def test_a_lone_robot_keeps_its_round() -> None:
    bench = Bench(2, {2})
    bench.until(START_NS + 1_000 * MS)
    assert {after - before for before, after in zip(bench.sends, bench.sends[1:], strict=False)} == {T_NS}


# --- A follower ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("me", [1, 2, 3])
def test_a_follower_sends_its_place_after_the_reference(me: int) -> None:
    bench = Bench(me, {0, 1, 2, 3})
    phase_ns = bench.settled()
    bench.hears(0, phase_ns + T_NS + 700_000)
    bench.until(phase_ns + 2 * T_NS)
    assert bench.sends[-1] == phase_ns + T_NS + 700_000 + me * T_NS // 4


def test_a_follower_that_misses_the_reference_goes_on_in_its_phase() -> None:
    bench = Bench(2, {0, 1, 2, 3})
    phase_ns = bench.settled()
    bench.until(phase_ns + 3 * T_NS)
    assert bench.sends[-2:] == [phase_ns + T_NS + T_NS // 2, phase_ns + 2 * T_NS + T_NS // 2]


def test_a_follower_that_has_spoken_already_speaks_a_round_later() -> None:
    bench = Bench(1, {0, 1, 2, 3})
    phase_ns = bench.settled()
    bench.until(phase_ns + T_NS + T_NS // 4 + 1)
    bench.hears(0, phase_ns + T_NS + 11 * MS)
    assert bench.slots.next_ns() == phase_ns + 2 * T_NS + 11 * MS + T_NS // 4


def test_on_a_medium_slower_than_a_round_nobody_sends_twice_in_one() -> None:
    bench = Bench(1, {0, 1, 2, 3})
    phase_ns = bench.settled(rounds=12)
    echo = ((1, bench.counter - 9, 0),)
    bench.hears(0, phase_ns + T_NS, echo=echo)
    assert bench.slots.view().peers[0].transit_us > 200_000
    bench.hears(0, phase_ns + T_NS + 3 * MS, echo=echo)
    assert bench.slots.next_ns() - bench.sends[-1] >= T_NS // 2


def test_all_change_the_count_at_one_frame_of_the_reference() -> None:
    bench = Bench(3, {0, 1, 2, 3})
    phase_ns = bench.settled()
    bench.hears(0, phase_ns + T_NS, set=word({0, 2, 3}), set_round=9)
    assert bench.slots.next_ns() == phase_ns + T_NS + 2 * (T_NS // 3)
    assert (bench.slots.set_round, bench.slots.view().place) == (9, 2)


# --- What people see ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("me", "rank"), [(0, 2), (1, 3), (3, 1)])
def test_a_frame_is_measured_against_its_slot_by_the_reference_and_by_followers(me: int, rank: int) -> None:
    bench = Bench(me, {0, 1, 2, 3})
    phase_ns = bench.settled()
    peer = bench.slots.peers[rank]
    assert abs(peer.offset_ns) < US and abs(peer.jitter_ns) < US
    if me != 0:
        phase_ns += T_NS
        bench.hears(0, phase_ns)
    bench.hears(rank, phase_ns + rank * T_NS // 4 + 3 * MS)
    (seen,) = (one for one in bench.slots.view().peers if one.robot == TEAM.names[rank])
    assert seen.offset_us in (2_999, 3_000) and seen.jitter_us == 3_000 // SMOOTHED


def test_of_the_reference_the_offset_is_how_much_its_round_was_stretched_and_others_count_from_it() -> None:
    bench = Bench(2, {0, 1, 2, 3})
    phase_ns = bench.settled()
    bench.hears(0, phase_ns + T_NS + 4 * MS)
    bench.hears(1, phase_ns + T_NS + 4 * MS + T_NS // 4)
    first, second = bench.slots.view().peers[:2]
    assert (first.offset_us, second.offset_us) == (4_000, 0)
    bench.until(phase_ns + 2 * T_NS)
    view = bench.slots.view()
    assert (view.round_us, view.offset_us) == (54_000, 0), "it follows, and so is in its slot"


def test_the_reference_tells_how_long_its_round_was() -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    bench.hears(1, sent_ns + T_NS // 4 + 5 * MS)
    bench.until(sent_ns + T_NS + 6 * MS)
    view = bench.slots.view()
    assert (view.round_us, view.offset_us, view.reference) == (55_000, 5_000, "robot1")


def test_frames_that_do_not_come_are_counted_of_those_that_were_awaited() -> None:
    bench = Bench(0, {0, 1, 2})
    sent_ns = bench.settled(rounds=8)
    before = {rank: (peer.awaited, peer.lost) for rank, peer in bench.slots.peers.items()}
    assert all(lost == 0 and awaited > 3 for awaited, lost in (before[1], before[2])) and before[4] == (0, 0)
    for number in range(2):
        bench.hears(1, sent_ns + number * T_NS + T_NS // 3)
    bench.until(sent_ns + 2 * T_NS + 1)
    peers = bench.slots.view().peers
    assert [(one.awaited - before[rank][0], one.lost) for rank, one in enumerate(peers[:2], 1)] == [(2, 0), (2, 2)]


def test_whom_a_member_hears_is_what_it_says() -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    views = pack_seen([Seen.RUN, Seen.RUN, Seen.REMOVE, Seen.INSERT, Seen.NOT, Seen.NOT])
    bench.hears(1, sent_ns + T_NS // 4, views=views)
    peers = bench.slots.view().peers
    assert peers[0].hears == ("robot1", "robot4") and peers[4].hears == ()


# --- Odd frames ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "said",
    [
        {"set": word({0, 2})},
        {"set": word({1, 40})},
        {"set": 0},
        {"views": ()},
        {"views": (0, 0)},
        {"views": (1 << 20,)},
        {"views": (1 << 64,)},
        {"t_tup_us": 60_000},
    ],
)
def test_a_frame_that_fits_no_roster_of_ours_is_counted_and_changes_nothing(said: dict[str, Any]) -> None:
    bench = Bench(0, {0, 1})
    sent_ns = bench.settled()
    bench.hears(1, sent_ns + T_NS // 2 + 3 * MS, **said)
    assert (bench.slots.ignored, bench.slots.next_ns()) == (1, sent_ns + T_NS)


@pytest.mark.parametrize("rank", [0, 6, 63, -1])
def test_a_frame_of_ourselves_or_of_nobody_changes_nothing(rank: int) -> None:
    bench = Bench(0, {0, 1})
    sent_ns = bench.settled()
    bench.slots.heard(frame(rank, {0, 1}) if rank >= 0 else SlotView(-1, 1, 1, frame(1, {1}).said), sent_ns + 10 * MS)
    assert bench.slots.next_ns() == sent_ns + T_NS


def test_a_frame_of_an_earlier_life_changes_nothing() -> None:
    bench = Bench(0, {0, 1})
    sent_ns = bench.settled()
    bench.hears(1, sent_ns + T_NS // 2 + 3 * MS, boot=0)
    assert bench.slots.next_ns() == sent_ns + T_NS


def test_a_higher_boot_makes_the_old_slot_void_at_once() -> None:
    bench = Bench(0, {0, 1, 2})
    sent_ns = bench.settled()
    assert bench.slots.peers[2].seen is Seen.RUN
    bench.hears(2, sent_ns + 20 * MS, boot=2, set=word({2}))
    assert bench.slots.peers[2].seen is Seen.INSERT


def test_a_transit_is_half_of_the_least_round_trip() -> None:
    bench = Bench(0, {0, 1})
    sent_ns = bench.settled()
    for hold_us, expected_us in ((20_000, 3_500), (21_000, 3_000), (10_000, 3_000), (40_000, 3_000)):
        bench.slots.heard(frame(1, {0, 1}, echo=((0, bench.counter, hold_us), (1, 1, 1))), sent_ns + 27 * MS)
        assert bench.slots.view().peers[0].transit_us == expected_us


def test_what_is_said_names_whom_it_heard_and_how_long_ago() -> None:
    bench = Bench(0, {0, 1, 2, 3})
    sent_ns = bench.settled()
    bench.hears(2, sent_ns + 25 * MS, counter=17)
    said = bench.slots.says(sent_ns + 40 * MS)
    assert (said.t_tup_us, said.set) == (50_000, word({0, 1, 2, 3}))
    assert said.views == pack_seen([2, 2, 2, 2, 0, 0])
    assert (2, 17, 13_000) in said.echo


# --- Any schedule ----------------------------------------------------------------------------------------------------

ARRIVALS = st.lists(
    st.tuples(
        st.integers(0, 70_000),  # µs since the one before
        st.integers(0, 6),  # rank
        st.integers(1, 3),  # boot
        st.integers(0, 63),  # set, besides the sender
        st.integers(0, (1 << 12) - 1),  # views
        st.sampled_from([50_000] * 8 + [60_000]),
        st.integers(0, 100_000),  # hold
        st.integers(0, 9),  # frames of ours since the one that is echoed
    ),
    max_size=120,
)


@given(st.integers(0, 5), ARRIVALS, st.lists(st.integers(0, 900), min_size=1, max_size=20), st.booleans())
def test_whatever_comes_no_robot_sends_twice_in_half_a_slot_or_pauses_for_more_than_two_rounds(
    me: int, arrivals: list[tuple[int, ...]], late_us: list[int], spread: bool
) -> None:
    slots, now_ns, wakes, counter = Slots(me, TEAM, Terms(spread=spread), START_NS), START_NS, 0, 0
    sent_ns: int | None = None
    for pause_us, rank, boot, members, views, t_tup_us, hold_us, back in [*arrivals, (200_000, 6, 1, 0, 0, 0, 0, 0)]:
        now_ns += pause_us * 1_000
        while slots.next_ns() <= now_ns:
            wakes += 1
            at_ns = slots.next_ns() + late_us[wakes % len(late_us)] * 1_000
            if slots.due(at_ns):
                counter += 1
                if sent_ns is not None:
                    assert T_NS // slots.set.bit_count() // 2 <= at_ns - sent_ns <= 2 * T_NS + 1 * MS
                said = slots.says(at_ns)
                assert said.set >> me & 1 and said.set <= TEAM.everybody
                slots.sent(at_ns, counter)
            sent_ns = at_ns if slots.own is Own.RUNNING else None  # another round is used there: it keeps silent
            assert slots.next_ns() > at_ns
        echo = ((me, counter - back, hold_us),)
        slots.heard(SlotView(rank, boot, counter, Said(t_tup_us, members | 1 << rank, 1, (views,), echo)), now_ns)
        assert slots.view().count >= 1
