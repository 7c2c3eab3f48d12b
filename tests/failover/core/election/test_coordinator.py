"""How etcd votes, step by step: two robots' arbiters beside one store, without a network that chooses the order."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest
from msgspec.structs import replace

from failover.core.election.consent import STATES
from failover.core.election.coordinator import (
    ROUND_SHARE,
    VOTES_MAX,
    Arbiter,
    Dialogue,
    Grant,
    KeepAlive,
    Request,
    Round,
    Said,
    Seat,
    Swap,
    Swapped,
    Word,
)
from failover.core.types import COORDINATOR, MS, Config, Rule, State
from failover.core.wire.messages import FREE, OPEN, ORDERED, Entry
from failover.errors import RulesError
from tests.simulation.coordinator import Etcd
from tests.simulation.robots import Clock

NAME = "/lab/mapper"
ROBOT1 = Config("robot1", (COORDINATOR, "robot2"), lease_ms=200, rule=Rule.ETCD, witnesses=(COORDINATOR,), patience_ms=1_000)
ROBOT2 = replace(ROBOT1, robot="robot2", peers=(COORDINATOR, "robot1"))
LOOK_MS = 40


class Site:
    """One store, and the true time. ``boots`` counts each robot's heartbeats, so that each word is a new one."""

    def __init__(self) -> None:
        self.etcd = Etcd(Clock(1.0, 0))
        self.now_ns = 0
        self.counter = 0
        self.entrusted = "robot2"
        self.arbiters = {config.robot: Arbiter(config, "lab") for config in (ROBOT1, ROBOT2)}

    def word(self, state: State, epoch: int, primary: str, sequence: int = 0, flags: int = 0, boot: int = 1) -> Word:
        self.counter += 1
        named = self.entrusted if primary == "robot1" and state in (State.CLAIMING, State.PRIMARY) else ""
        held = (1, sequence, b"") if sequence else (0, 0, b"")
        return Word(boot, self.counter, (Entry(NAME, STATES.index(state), epoch, primary, *held, named, flags=flags),))

    def wait(self, ms: int) -> None:
        self.now_ns += ms * MS

    def asked(self, steps: Round, request: Request) -> Request | Said:
        """Have etcd carry out a request of a round: the next request, or how it ended."""
        answer = self.etcd.answer(request, self.now_ns)
        assert answer is not None
        try:
            return steps.send((answer, self.now_ns))
        except StopIteration as end:
            said: Said = end.value
            return said

    def until_swap(self, steps: Round, key: str) -> Swap:
        """Play a round up to the request that puts this kind of key."""
        request: Request | Said = next(steps)
        while not (isinstance(request, Swap) and f"/{key}/" in request.puts[0].key):
            assert not isinstance(request, Said)
            request = self.asked(steps, request)
        return request

    def rest(self, steps: Round, request: Request | Said) -> Said:
        while not isinstance(request, Said):
            request = self.asked(steps, request)
        return request

    def round(self, robot: str, word: Word) -> Said:
        steps = self.arbiters[robot].round(word)
        return self.rest(steps, next(steps))

    def watch(self, robot: str, word: Word, ms: int) -> Said:
        """Rounds of one robot for a while; the last one's answer."""
        for _ in range(ms // LOOK_MS):
            said = self.round(robot, replace(word, counter=word.counter))
            self.wait(LOOK_MS)
        return said


def absent(site: Site) -> Word:
    return site.word(State.ABSENT, 0, "")


def standby(site: Site, epoch: int = 1, sequence: int = 0) -> Word:
    return site.word(State.STANDBY, epoch, "robot1", sequence)


def claims(site: Site, epoch: int, me: str = "robot2", sequence: int = 0, flags: int = 0) -> Word:
    return site.word(State.CLAIMING, epoch, me, sequence, flags)


def voted(said: Said) -> tuple[int, str]:
    (entry,) = said.entries
    return entry.epoch, entry.primary


def running(sequence: int = 0, entrusted: str = "robot2") -> Site:
    """Both have watched etcd for long enough, and robot1 runs the component by its vote."""
    site = Site()
    site.entrusted = entrusted
    for robot in ("robot1", "robot2"):
        site.watch(robot, absent(site), 280)
    assert voted(site.round("robot1", claims(site, 1, "robot1"))) == (1, "robot1")
    site.round("robot1", site.word(State.PRIMARY, 1, "robot1", sequence))
    return site


def test_an_etcd_that_is_new_to_a_robot_votes_after_a_lease_and_a_margin() -> None:
    site = Site()
    assert site.round("robot1", claims(site, 1, "robot1")).entries == ()
    assert voted(site.watch("robot1", claims(site, 1, "robot1"), 400)) == (1, "robot1")


def test_of_two_that_claim_one_epoch_one_gets_the_vote() -> None:
    site = Site()
    for robot in ("robot1", "robot2"):
        site.watch(robot, absent(site), 280)
    first, second = (site.arbiters[robot].round(claims(site, 1, robot)) for robot in ("robot1", "robot2"))
    asked = site.until_swap(first, "component"), site.until_swap(second, "component")
    said = [site.rest(steps, request) for steps, request in zip((first, second), asked, strict=True)]
    assert list(map(voted, said)) == [(1, "robot1"), (1, "robot1")]


def test_a_primary_that_renews_its_word_keeps_the_vote() -> None:
    site = running()
    for _ in range(20):
        site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
        said = site.watch("robot2", claims(site, 2), LOOK_MS)
        assert voted(said) == (1, "robot1") and not said.entries[0].flags & FREE


def test_a_silent_primary_loses_the_vote_after_its_lease_and_not_before() -> None:
    site = running()
    site.etcd.clock.jump(site.now_ns, 10_000 * MS)  # its lease at etcd is over at once
    assert voted(site.watch("robot2", claims(site, 2), 200)) == (1, "robot1")
    assert voted(site.watch("robot2", claims(site, 2), 240)) == (2, "robot2")


def test_a_robot_whose_own_clock_leaps_waits_for_the_end_of_the_lease_at_etcd() -> None:
    site = running()
    site.watch("robot2", standby(site), 80)
    arbiter = site.arbiters["robot2"]
    arbiter._watched_ns += 10_000 * MS
    assert voted(site.round("robot2", claims(site, 2))) == (1, "robot1")


def test_a_leap_of_the_own_clock_counts_as_one_look() -> None:
    site = running()
    site.etcd.clock.jump(site.now_ns, 10_000 * MS)
    site.round("robot2", standby(site))
    site.wait(10_000)
    assert voted(site.round("robot2", claims(site, 2))) == (1, "robot1")


def test_a_primary_that_is_back_while_the_vote_is_on_its_way_keeps_it() -> None:
    site = running()
    site.watch("robot2", standby(site), 600)
    steps = site.arbiters["robot2"].round(claims(site, 2))
    request = site.until_swap(steps, "component")
    assert voted(site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))) == (1, "robot1")
    assert voted(site.rest(steps, request)) == (1, "robot1")


def test_a_word_that_arrives_after_it_was_given_up_changes_nothing() -> None:
    site = running()
    steps = site.arbiters["robot1"].round(standby(site))
    late = site.until_swap(steps, "word")
    steps.close()
    site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
    answer = site.etcd.answer(late, site.now_ns)
    assert isinstance(answer, Swapped) and not answer.is_done
    assert voted(site.round("robot2", claims(site, 2))) == (1, "robot1"), "it would else say that it runs nothing"


def test_a_word_whose_answer_was_lost_is_followed_by_the_next() -> None:
    site = running()
    steps = site.arbiters["robot1"].round(site.word(State.PRIMARY, 1, "robot1"))
    site.etcd.answer(site.until_swap(steps, "word"), site.now_ns)
    steps.close()
    said = site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
    assert said.counter == site.counter and voted(said) == (1, "robot1")


def test_a_primary_that_says_it_runs_nothing_is_replaced_at_once() -> None:
    site = running(5, entrusted="")
    site.watch("robot2", standby(site), 80)
    site.round("robot1", site.word(State.STOPPING, 1, "robot1", 5))
    assert voted(site.round("robot2", claims(site, 2, flags=ORDERED))) == (1, "robot1")
    site.round("robot1", standby(site, sequence=5))
    assert voted(site.round("robot2", claims(site, 2))) == (1, "robot1"), "robot1 holds all that was acknowledged"
    assert voted(site.round("robot2", claims(site, 2, flags=ORDERED))) == (2, "robot2")


def test_a_new_life_that_knows_of_nothing_is_not_believed_before_a_lease_is_over() -> None:
    site = running()
    site.watch("robot2", standby(site), 80)
    empty = replace(absent(site), boot=2, entries=())
    for _ in range(4):
        site.round("robot1", replace(empty, counter=site.counter))
        assert voted(site.round("robot2", claims(site, 2, flags=ORDERED))) == (1, "robot1")
        site.wait(LOOK_MS)
    for _ in range(4):
        site.round("robot1", replace(empty, counter=site.counter))
        said = site.round("robot2", claims(site, 2, flags=ORDERED))
        site.wait(LOOK_MS)
    assert voted(said) == (2, "robot2")


def test_an_older_checkpoint_waits_for_the_robots_with_the_newest() -> None:
    site = running(5, entrusted="")
    said = site.watch("robot2", claims(site, 2, sequence=4), 600)
    assert voted(said) == (1, "robot1") and said.entries[0].flags & (FREE | OPEN) == FREE
    assert voted(site.watch("robot2", claims(site, 2, sequence=4), 800)) == (2, "robot2"), "patience_ms is over"


def test_the_robot_that_was_entrusted_goes_on_at_once() -> None:
    site = running(5)
    assert voted(site.watch("robot2", claims(site, 2, sequence=5), 440)) == (2, "robot2")


def test_a_robot_takes_many_over_in_one_round_and_one_that_changes_meanwhile_stops_no_other() -> None:
    site, names = running(), [f"/lab/part{number}" for number in range(2 * VOTES_MAX)]
    word = claims(site, 2)
    many = replace(word, entries=tuple(replace(word.entries[0], name=name) for name in names))
    site.watch("robot2", standby(site), 280)
    site.watch("robot1", absent(site), 280)
    steps = site.arbiters["robot2"].round(many)
    request = site.until_swap(steps, "component")
    assert len(request.puts) == VOTES_MAX
    site.round("robot1", replace(word, entries=(replace(word.entries[0], name=names[0], primary="robot1"),)))
    said = site.rest(steps, request)
    voted_for = {entry.name: entry.primary for entry in said.entries if entry.name in names}
    assert [name for name in names if voted_for.get(name) != "robot2"] == names[:1]


def test_a_round_that_takes_long_ends_so_that_a_newer_word_is_put() -> None:
    site, word = running(), claims(running(), 2)
    many = replace(word, entries=tuple(replace(word.entries[0], name=f"/lab/part{number}") for number in range(3 * VOTES_MAX)))
    site.watch("robot2", standby(site), 280)
    steps = site.arbiters["robot2"].round(many)
    request: Request | Said = site.until_swap(steps, "component")
    site.wait(ROBOT1.lease_ms // ROUND_SHARE)
    request = site.asked(steps, request)
    assert isinstance(request, Said) and len(request.entries) == 1 + VOTES_MAX


def test_whom_a_majority_elected_without_etcd_gets_its_vote() -> None:
    site = running()
    site.round("robot1", site.word(State.STANDBY, 2, "robot2"))
    assert voted(site.round("robot2", site.word(State.PRIMARY, 2, "robot2"))) == (2, "robot2")


def test_who_claimed_before_it_knew_of_an_end_puts_the_end_above_its_claim() -> None:
    site = running()
    site.watch("robot2", standby(site), 80)
    site.round("robot1", site.word(State.FINISHED, 1, "robot1"))
    (entry,) = site.round("robot2", claims(site, 2)).entries
    assert (entry.epoch, entry.primary, STATES[entry.state]) == (2, "robot1", State.FINISHED)
    assert voted(site.round("robot2", claims(site, 3))) == (3, "robot2"), "an operator has it run anew"


def test_an_etcd_that_has_lost_writes_is_watched_anew() -> None:
    site = running()
    before = site.etcd.revision, {key: kept for key, kept in site.etcd.kept.items() if "/alive/" not in key}
    for _ in range(3):
        site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
    site.watch("robot2", standby(site), 600)
    site.etcd.revision, site.etcd.kept = before
    assert voted(site.round("robot2", claims(site, 2))) == (1, "robot1")
    assert voted(site.watch("robot2", claims(site, 2), 440)) == (2, "robot2")


def deleted(etcd: Etcd) -> None:
    etcd.kept.clear()
    etcd.revision += 1


def seat_deleted(etcd: Etcd) -> None:
    etcd.kept = {key: kept for key, kept in etcd.kept.items() if "/component/" not in key}


def replaced(etcd: Etcd) -> None:
    etcd.cluster += 1


def restored(etcd: Etcd) -> None:
    """From a backup, with a revision above all that there were: the seat is as it was in epoch 1."""
    etcd.kept = {key: (value, 1 if "/component/" in key else at, lease) for key, (value, at, lease) in etcd.kept.items()}
    etcd.revision += 1_000


def word_deleted(etcd: Etcd) -> None:
    etcd.kept = {key: kept for key, kept in etcd.kept.items() if "/word/robot2" not in key}


@pytest.mark.parametrize("lose", [deleted, seat_deleted, replaced, restored, word_deleted])
def test_an_etcd_that_is_another_one_or_has_lost_keys_is_watched_anew(lose: Callable[[Etcd], None]) -> None:
    site = running()
    site.etcd.clock.jump(site.now_ns, 10_000 * MS)
    site.watch("robot2", standby(site), 600)
    assert site.arbiters["robot2"]._is_rested
    lose(site.etcd)
    said = site.round("robot2", claims(site, 2))
    assert not site.arbiters["robot2"]._is_rested and "robot2" not in [entry.primary for entry in said.entries]
    assert voted(site.watch("robot2", claims(site, 2), 440)) == (2, "robot2")


def test_a_word_of_a_former_member_is_no_vote() -> None:
    site = running()
    site.watch("robot2", standby(site), 80)
    word = replace(standby(site), entries=(replace(standby(site).entries[0], epoch=2, primary="robot2"),))
    site.etcd.revision += 1
    site.etcd.kept["failover/lab/word/robot3"] = msgspec.msgpack.encode(word), site.etcd.revision, 0
    site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
    assert voted(site.round("robot2", claims(site, 2))) == (1, "robot1")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("component/lab/other", b"\x93\x01"),
        ("component/lab/other", msgspec.msgpack.encode(Seat(1, "robot1", state=99))),
        ("component/lab/other", msgspec.msgpack.encode(Seat(1 << 40, "robot1"))),
        ("component/lab/other", msgspec.msgpack.encode(Seat(1, "r" * 64))),
        ("component/lab/other", b"\x92\x01\xa1\xff"),
        ("word/robot3", b"made by hand"),
        ("word/robot3", msgspec.msgpack.encode(Word(0, 1))),
        ("word/robot3", b"\x91" * 5_000),
    ],
)
def test_a_key_that_is_not_of_this_program_is_named(key: str, value: bytes) -> None:
    site = running()
    site.etcd.kept[f"failover/lab/{key}"] = value, site.etcd.revision, 0
    with pytest.raises(RulesError, match=f"in failover/lab/{key} .*delete that key"):
        site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))


def test_an_answer_lets_a_robot_act_from_the_heartbeat_that_it_named() -> None:
    dialogue = Dialogue(ROBOT1)
    assert not dialogue.is_due(Word(1, 0), 1), "no heartbeat has left"
    word = Word(1, 7, (Entry(NAME, 0, 1),))
    assert dialogue.is_due(word, 1)
    assert not dialogue.is_due(replace(word, counter=8), 2)
    assert dialogue.is_due(replace(word, entries=(Entry(NAME, 1, 1),)), 3), "what changed does not wait"
    assert dialogue.is_due(replace(word, entries=(Entry(NAME, 1, 1),)), dialogue.next_ns())
    beat = dialogue.beat(Said(1, 7))
    assert beat is not None and (beat.sender, beat.echoes[0].counter) == (COORDINATOR, 7)
    assert dialogue.beat(Said(0, 0)) is None, "etcd took nothing in"


def test_a_lease_that_ends_at_etcd_between_two_requests_costs_no_round() -> None:
    site = running()
    arbiter, word = site.arbiters["robot1"], site.word(State.PRIMARY, 1, "robot1")
    arbiter._alive = 0  # its lease is put
    steps = arbiter.round(word)
    request = site.until_swap(steps, "word")
    site.etcd.leases.clear()
    said = site.rest(steps, request)
    assert said.counter == word.counter and voted(said) == (1, "robot1")
    assert site.etcd.kept["failover/lab/alive/robot1"][2] in site.etcd.leases


def test_a_lease_is_put_once_and_again_when_it_is_another() -> None:
    site = running()
    revision = site.etcd.kept["failover/lab/alive/robot1"][1]
    site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
    assert site.etcd.kept["failover/lab/alive/robot1"][1] == revision
    site.etcd.clock.jump(site.now_ns, 10_000 * MS)
    site.round("robot1", site.word(State.PRIMARY, 1, "robot1"))
    assert site.etcd.kept["failover/lab/alive/robot1"][1] > revision


def test_a_lease_at_etcd_lasts_at_least_as_long_as_a_robot_watches() -> None:
    steps = Arbiter(ROBOT1, "lab").round(Word(1, 1))
    assert next(steps) == Grant(ROBOT1.loyalty_ns // MS)
    site = Site()
    site.round("robot1", absent(site))
    assert isinstance(next(site.arbiters["robot1"].round(absent(site))), KeepAlive)
