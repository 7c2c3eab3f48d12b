"""When frames leave over a robot's links, and which of them begin a round of its board. Sockets are real, on the loopback."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agent.config import Config, MediumConfig, Settings
from agent.main_loop.beat_sockets import BeatLane
from agent.main_loop.media import HEARD_NS, TRY_AGAIN_NS, Media
from agent.main_loop.messages import LinkNow
from agent.system import clock
from failover.config.team import Robot, Team
from failover.core.board.ages import effective_round_ns
from failover.core.frames.lane import FrameLane
from failover.core.frames.lanes import FrameLanes
from failover.core.frames.media import RETRY_ROUNDS, Cast, Casting
from failover.core.frames.terms import Own
from tests.agent.main_loop.test_beat_sockets import robot

ROUND_NS = 50_000_000
Make = Callable[..., Media]


@pytest.fixture
def media(tmp_path: Path) -> Iterator[Make]:
    """Of robot1, of which the named links have slots."""
    opened: list[BeatLane] = []

    def make(*names: str, slots: tuple[str, ...]) -> Media:
        me, other = robot(len(names)), robot(len(names))
        team = Team("team", {"robot1": me, "robot2": other, "robot3": Robot(other.beats, other.bulk)})
        config = Config("robot1", media={name: MediumConfig(slots=name in slots) for name in names})
        settings = Settings(tmp_path / "agent.toml", config, team, "")
        opened.append(BeatLane(settings.me, settings.peers, "team"))
        lanes = FrameLanes(lambda medium: FrameLane("robot1", "team", team.roster(), 1, 20_000, medium))
        for peer in settings.peers:
            lanes.speak(peer, bytes(16))
        made = Media(settings, opened[-1], lanes, team.roster())
        made.take([LinkNow(name, 1) for name in names], clock.now_ns())
        return made

    yield make
    for beats in opened:
        beats.close()


def own(media: Media, *states: Own) -> None:
    """What the slots of each link are in now."""
    for link, state in zip(media._slotted, states, strict=True):
        assert link.slots is not None
        link.slots.own = state


def test_a_robot_without_any_slot_paces_its_board_by_the_frames_that_leave_without_one(media: Make) -> None:
    both = media("radio0", "radio1", slots=("radio0", "radio1"))
    own(both, Own.SILENT, Own.LISTENING)
    now_ns = clock.now_ns()
    assert both.paces(now_ns)
    both.send(None, (), now_ns, 1)
    assert not both.paces(now_ns + ROUND_NS // 5), "no frame would leave"
    assert both.paces(now_ns + ROUND_NS)
    own(both, Own.SILENT, Own.RUNNING)
    assert not both.paces(now_ns + ROUND_NS), "its slot does"


def test_a_heartbeat_waits_where_no_link_takes_it_at_once(media: Make) -> None:
    both = media("radio0", "radio1", slots=("radio0", "radio1"))
    now_ns = clock.now_ns()
    own(both, Own.RUNNING, Own.RUNNING)
    assert both.all_wait(now_ns)
    own(both, Own.RUNNING, Own.LISTENING)
    assert not both.all_wait(now_ns)
    both.send(None, (), now_ns, 1)
    assert both.all_wait(now_ns + ROUND_NS // 5), "a robot that listens speaks once in a round"
    cable = media("radio0", "cable0", slots=("radio0",))
    own(cable, Own.RUNNING)
    assert not cable.all_wait(now_ns)


def test_what_leaves_over_a_medium_with_slots_counts_among_its_frames_also_without_a_slot(media: Make) -> None:
    """A member that hears that medium only would count the frames of the others as lost."""
    both = media("radio0", "cable0", slots=("radio0",))
    own(both, Own.LISTENING)
    now_ns = clock.now_ns()
    for passed in range(10):
        both.send(None, (), now_ns + passed * ROUND_NS // 2, passed)
    radio, cable = both._lanes.lane(1).counter, both._lanes.lane(0).counter
    assert (radio, cable) == (5, 10)


def test_the_first_link_on_which_a_robot_has_a_slot_paces_its_board(media: Make) -> None:
    both = media("radio0", "radio1", slots=("radio0", "radio1"))
    for states, first in (
        ((Own.RUNNING, Own.RUNNING), [True, False]),
        ((Own.SILENT, Own.RUNNING), [False, True]),
        ((Own.SILENT, Own.LISTENING), [False, False]),
    ):
        own(both, *states)
        assert [both.is_first(link) for link in both._links] == first


def test_a_link_without_slots_paces_the_board_whatever_the_others_are(media: Make) -> None:
    both = media("radio0", "cable0", slots=("radio0",))
    for state in (Own.SILENT, Own.RUNNING):
        own(both, state)
        assert both.paces(clock.now_ns())


def test_when_another_way_to_cast_is_tried_members_get_unicast_besides_at_once(
    media: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel's part is left out: no broadcast leaves the loopback."""
    monkeypatch.setattr(BeatLane, "cast", lambda *_: "")
    one = media("cable0", slots=())
    (link,), casts = one._links, one._lanes.lane(0).casts
    assert casts is not None
    link.casting, link.reached = Casting(Cast.AUTO), frozenset({"robot2", "robot3"})
    link.casting.now, link.casting._rounds = Cast.BROADCAST, RETRY_ROUNDS - 3
    now_ns = clock.now_ns()
    by_unicast = []
    for _ in range(4):
        one.send(None, (), now_ns, 1)
        by_unicast.append((link.by_unicast, link.casting.now))
        said = one._lanes.lane(0).counter.to_bytes(2, "little") * 3
        if len(by_unicast) < 4:
            for rank in (1, 2):
                casts.told(rank, (said,))
    both = ("robot2", "robot3")
    assert by_unicast == [(both, Cast.BROADCAST), ((), Cast.BROADCAST), ((), Cast.MULTICAST), (both, Cast.MULTICAST)]


def test_the_round_of_a_member_is_that_of_the_fastest_link_over_which_it_is_heard(media: Make) -> None:
    both = media("radio0", "cable0", slots=("radio0",))
    now_ns = 10 * HEARD_NS
    longest_ns = effective_round_ns(ROUND_NS, 3)
    assert longest_ns > ROUND_NS
    both.heard("robot2", "radio0", 100, now_ns)
    both.heard("robot3", "radio0", 100, now_ns)
    both.heard("robot3", "cable0", 100, now_ns - HEARD_NS // 2)
    assert [both.round_of(peer, now_ns) for peer in ("robot2", "robot3")] == [longest_ns, 20_000_000]
    assert both.round_of("robot3", now_ns + HEARD_NS // 2) == longest_ns
    assert both.round_of("robot3", now_ns + 2 * HEARD_NS) == both.round_ns == 20_000_000


def test_the_bytes_of_each_member_and_of_this_robot_are_counted_by_link(media: Make) -> None:
    both = media("radio0", "cable0", slots=())
    now_ns = clock.now_ns()
    for size in (300, 200):
        both.heard("robot2", "radio0", size, now_ns)
    both.heard("robot3", "cable0", 70, now_ns)
    both.heard("robot3", "gone0", 70, now_ns)
    both.send(None, (), now_ns, 1)
    radio, cable = (view.bytes for view in both.views())
    sent = sum(len(datagram) for sealed in both._lanes.lane(0).seal(None, (), now_ns)[0] for datagram in sealed.datagrams)
    assert sent and radio == {"robot2": 500, "robot1": 2 * sent} and cable == {"robot3": 70, "robot1": 2 * sent}


def test_what_the_kernel_refused_is_tried_again_after_a_minute(media: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the links do not change nothing else would."""
    refusals = ["the kernel refused to open the link to multicast: Cannot allocate memory"]
    monkeypatch.setattr(BeatLane, "open_to_casts", lambda *_: refusals[-1])
    monkeypatch.setattr(BeatLane, "reached", lambda *_: ("robot2", "robot3"))
    monkeypatch.setattr(BeatLane, "cast", lambda *_: "")
    one = media("cable0", slots=())
    (link,), began_ns = one._links, clock.now_ns()
    assert link.casting is None and link.why == refusals[0]
    refusals.append("")
    one.send(None, (), began_ns + TRY_AGAIN_NS // 2, 1)
    assert link.casting is None
    one.send(None, (), began_ns + TRY_AGAIN_NS, 2)
    assert link.casting is not None and link.casting.now is Cast.MULTICAST
    one.send(None, (), began_ns + 3 * TRY_AGAIN_NS, 3)
    assert link.try_again_ns == 0
