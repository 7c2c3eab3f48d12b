"""Two robots' lanes in virtual time: what one says the other hears, and how long it can have been on its way."""

from __future__ import annotations

from failover.core.frames.frame import Portion, Reason, Refused
from failover.core.frames.lane import ECHOED_NS, FrameLane, Heard
from failover.core.frames.roster import Roster, roster
from failover.core.wire.messages import Beat, Echo

MS = 1_000_000
TEAM = roster(["robot1", "robot2"])
APART_NS = 94_608_000_000 * MS
"""The second robot's clock is so much ahead: three years."""


def key(sender: str, receiver: str) -> bytes:
    return f"the key of {sender} to {receiver}".encode()


def lane(me: str, boot: int = 1, team: Roster = TEAM, *, bounds_ways: bool = True) -> FrameLane:
    made = FrameLane(me, "team", team, boot, 20_000, bounds_ways=bounds_ways)
    for other in team.names:
        if other != me:
            made.speak(other, key(me, other))
            made.hear(other, key(other, me))
    return made


class Talk:
    """Robot1 and robot2 send in turn, each 10 ms after the other; a way takes a millisecond."""

    def __init__(self) -> None:
        self.first, self.second = lane("robot1"), lane("robot2")
        self.boots = {"robot1": 1, "robot2": 1}
        self.now_ns = 1_000 * MS
        self.beats = 0

    def restart(self) -> None:
        """Robot1's agent begins another life."""
        self.boots["robot1"] += 1
        self.first = lane("robot1", self.boots["robot1"])

    def there(self, items: tuple[Portion, ...] = (), way_ns: int = MS) -> Heard:
        return self._say("robot1", self.first, self.second, 0, APART_NS, items, way_ns)

    def back(self, items: tuple[Portion, ...] = (), way_ns: int = MS, knows: int = 0) -> Heard:
        return self._say("robot2", self.second, self.first, APART_NS, 0, items, way_ns, knows)

    def _say(
        self,
        me: str,
        by: FrameLane,
        to: FrameLane,
        ours_ns: int,
        theirs_ns: int,
        items: tuple[Portion, ...],
        way_ns: int,
        knows: int = 0,
    ) -> Heard:
        other = "robot2" if me == "robot1" else "robot1"
        self.now_ns += 10 * MS
        self.beats += 1
        beat = Beat(me, self.boots[me], self.beats, echoes=(Echo(other, knows or self.boots[other], 1),))
        ((sealed,), placed) = by.seal(beat, items, self.now_ns + ours_ns)
        assert (sealed.to, placed) == ((other,), len(items))
        found = [to.open(datagram, self.now_ns + way_ns + theirs_ns) for datagram in sealed.datagrams]
        assert all(isinstance(one, Heard) for one in found)
        last = found[-1]
        assert isinstance(last, Heard)
        return last


def test_the_first_frame_that_echoes_ours_bounds_its_way_by_the_round_trip() -> None:
    talk = Talk()
    assert talk.there().way_ns is None
    way_ns = talk.back(way_ns=3 * MS).way_ns
    assert way_ns is not None
    assert 4 * MS <= way_ns <= 4 * MS + 100_000  # one there, three back


def test_without_a_board_frames_say_nothing_of_ways() -> None:
    talk = Talk()
    with_ways = talk.there().part.slots
    talk.first, talk.second = (lane(name, bounds_ways=False) for name in ("robot1", "robot2"))
    for _ in range(3):
        assert (talk.there().part.slots, talk.back().way_ns) == (None, None)
    assert with_ways is not None


def test_a_frame_that_waits_is_told_to_have_waited() -> None:
    talk = Talk()
    for _ in range(5):
        talk.there()
        talk.back()
    talk.there()
    way_ns = talk.back(way_ns=50 * MS).way_ns
    assert way_ns is not None
    assert 50 * MS <= way_ns <= 51 * MS + 400_000


def test_an_item_comes_whole_in_as_many_parts_as_it_needs() -> None:
    talk = Talk()
    item = Portion(3, 12, 7, bytes(range(256)) * 20)
    assert list(talk.there((item,)).items) == [Portion(3, 12, 7, item.value)]


def test_echoes_of_an_earlier_life_are_no_round_trips_of_this_one() -> None:
    talk = Talk()
    for _ in range(3):
        talk.there()
        talk.back()
    talk.restart()
    for _ in range(5):  # lost: robot2 has heard nothing of this life, and echoes counters of the last
        talk.first.seal(None, (), talk.now_ns + MS)
    for _ in range(3):
        assert talk.back(knows=1, way_ns=50 * MS).way_ns is None
    talk.there()
    assert talk.back().way_ns is not None


def test_a_peer_that_was_silent_for_long_is_not_echoed() -> None:
    talk = Talk()
    talk.there()
    talk.now_ns += ECHOED_NS
    heard = talk.back()
    assert heard.part.slots is not None
    assert heard.part.slots.echo == ()


def test_a_key_that_was_not_handed_over_is_no_key() -> None:
    silent = FrameLane("robot1", "team", TEAM, 1, 20_000)
    made, _ = silent.seal(Beat("robot1", 1, 1), (), MS)
    assert made[0].to == ()
    assert lane("robot2").open(made[0].datagrams[0], MS) == Refused(Reason.UNSEALED)


def test_a_large_team_gets_a_datagram_each_and_all_of_them_have_one_counter() -> None:
    team = roster([f"robot{number}" for number in range(1, 31)])
    talker = lane("robot1", team=team)
    made, _ = talker.seal(Beat("robot1", 1, 1), (), MS)
    assert sorted(sealed.to for sealed in made) == sorted((name,) for name in team.names if name != "robot1")
    for sealed in made:
        heard = lane(sealed.to[0], team=team).open(sealed.datagrams[0], MS)
        assert isinstance(heard, Heard)
        assert heard.part.counter == 1


def test_in_a_large_team_all_are_echoed_in_turn() -> None:
    team = roster([f"robot{number}" for number in range(1, 31)])
    listener = lane("robot1", team=team)
    for name in team.names:
        if name != "robot1":
            other = lane(name, team=team)
            made, _ = other.seal(Beat(name, 1, 1), (), MS)
            (datagram,) = next(sealed.datagrams for sealed in made if sealed.to == ("robot1",))
            listener.open(datagram, MS)
    echoed = set()
    for _ in range(8):
        made, _ = listener.seal(None, (), 2 * MS)
        heard = lane("robot2", team=team).open(made[0].datagrams[0], 3 * MS)
        assert isinstance(heard, Heard)
        assert heard.part.slots is not None
        echoed |= {rank for rank, _, _ in heard.part.slots.echo}
    assert echoed == set(range(30)) - {team.ranks["robot1"]}


def said(by: FrameLane, counter: int) -> bytes:
    ((sealed,), _) = by.seal(Beat("robot" + str(by._rank + 1), 1, counter, 0), (), counter * MS)
    return sealed.datagrams[0]


def test_members_join_and_leave_in_the_midst_of_a_life() -> None:
    three = roster(["robot1", "robot2", "robot3"])
    first, second = lane("robot1"), lane("robot2")
    before = said(first, 1)
    assert isinstance(second.open(before, 0), Heard)
    first = first.changed(three)
    heard = second.open(said(first, 2), 0)
    assert isinstance(heard, Heard) and not heard.part.alike, (
        "its heartbeats are read by a member that has not heard of the change"
    )
    assert heard.part.counter == 2, "its parts are counted on"
    second = second.changed(three)
    heard = second.open(said(first, 3), 0)
    assert isinstance(heard, Heard) and heard.part.alike
    assert second.open(before, 0) == Refused(Reason.REPLAYED, "robot1", 1), "what was seen is remembered"
    second = second.changed(roster(["robot2", "robot3"]))
    assert second.open(said(first, 4), 0) == Refused(Reason.UNKNOWN_KEY), "one that was taken out is not heard any more"
