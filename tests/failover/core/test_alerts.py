"""What an operator is told, and what not: once, when it has lasted, and not a thousand times."""

from __future__ import annotations

from failover.core.alerts import HOUR_NS, OVER, Alert, Sight, Terms, Watch, teller, why_taken_over
from failover.core.event_log.decisions import Decision, Facts

S = 10**9
NAME = "/lab/robot1/mapper"
TERMS = Terms(degraded_after_ns=10 * S, recovered_after_ns=30 * S, hour_max=3)


def watched(watch: Watch, story: str, began_s: int = 1_000, step_s: int = 2) -> list[tuple[int, str]]:
    """What is told when looks find a component "b"ad, "w"ell, "o"ver or "?" not at all: (seconds since the first look, kind)."""
    sights = {"b": Sight(3, "no standby"), "w": Sight(3), "o": Sight(3, is_over=True)}
    told = []
    for number, letter in enumerate(story):
        seen = {NAME: sights[letter]} if letter in sights else {}
        told += [(number * step_s, alert.kind) for alert in watch.look(seen, (began_s + number * step_s) * S)]
    return told


def test_trouble_is_told_once_when_it_has_lasted_and_once_when_it_is_over() -> None:
    assert watched(Watch(TERMS), "w" + 30 * "b" + 40 * "w") == [(12, "degraded"), (90, "recovered")]


def test_trouble_that_passes_is_not_told() -> None:
    assert watched(Watch(TERMS), 5 * "b" + 40 * "w" + 5 * "b" + 40 * "w") == []


def test_a_component_that_flaps_is_told_of_once() -> None:
    assert watched(Watch(TERMS), 100 * "bbww" + 20 * "w") == [(18, "degraded"), (824, "recovered")]


def test_what_cannot_be_seen_is_neither_well_nor_worse() -> None:
    assert watched(Watch(TERMS), "bbb???????????bbbb") == [(32, "degraded")]


def test_trouble_ends_with_the_component() -> None:
    watch = Watch(TERMS)
    assert watched(watch, 10 * "b" + "o" + 10 * "o") == [(10, "degraded"), (20, "recovered")]
    assert watched(Watch(TERMS), "bbo" + 10 * "o") == [], "it was not told of"
    watch.look({NAME: Sight(4, "no standby")}, 5_000 * S)
    watch.look({NAME: Sight(4, "no standby")}, 5_010 * S)
    assert watch.look({NAME: Sight(4, is_over=True)}, 5_012 * S) == [Alert("recovered", NAME, 4, OVER)]


def test_a_machine_that_slept_has_not_seen_trouble_last() -> None:
    watch = Watch(Terms(60 * S, 30 * S, 3))
    assert watch.look({NAME: Sight(3, "no standby")}, 1_000 * S) == []
    assert watch.look({NAME: Sight(3, "no standby")}, 9_000 * S) == []


def test_no_more_than_so_many_are_told_within_an_hour_and_the_next_one_says_how_many_were_not() -> None:
    watch = Watch(TERMS)
    told = [watch.happened("takeover", NAME, epoch, "robot1 is silent", epoch * 60 * S) for epoch in range(1, 60)]
    assert [one.epoch for one in told if one is not None] == [1, 2, 3]
    later = watch.happened("takeover", NAME, 90, "robot1 is silent", HOUR_NS + 61 * S)
    assert later is not None and later.left_out == 56
    other = watch.happened("takeover", "/lab/robot1/camera", 2, "robot1 is silent", 3_000 * S)
    assert other is not None and other.left_out == 0, "each component has its own"


def test_trouble_that_was_not_told_because_too_much_was_is_told_later_and_its_end_only_then() -> None:
    watch = Watch(TERMS)
    told = watched(watch, 4 * (10 * "b" + 20 * "w"))
    assert [kind for _, kind in told] == 3 * ["degraded", "recovered"]
    told = watched(watch, 10 * "b", began_s=1_240)
    assert told == []
    assert [kind for _, kind in watched(watch, 10 * "b", began_s=6_000)] == ["degraded"]


def test_a_life_that_knows_what_was_told_does_not_tell_it_again() -> None:
    before, after = Watch(TERMS), Watch(TERMS)
    assert watched(before, 10 * "b") == [(10, "degraded")]
    after.troubles = before.troubles
    assert watched(after, 10 * "b" + 20 * "w") == [(48, "recovered")]


def test_one_robot_tells() -> None:
    team = ("robot2", "robot10", "server")
    assert teller("robot2", ("robot10",), team, team) == "robot2"
    assert teller("robot1", ("robot10", "robot2"), team, team) == "robot2", "the robot that ran it is lost"
    assert teller("", ("server",), team, team) == "server"
    assert teller("", (), team, team) == "robot2"
    assert teller("robot1", (), (), team) == ""


def test_a_takeover_is_told_with_the_silence_before_it() -> None:
    silent = Decision(99 * S, "", "robot1 was silent for 220 ms on every link: it counts as dead")
    claim = Decision(100 * S, NAME, "robot2 claims epoch 4", Facts(epoch=4))
    runs = Decision(101 * S, NAME, "it resumes from checkpoint 8 at robot2, epoch 4", Facts(epoch=4))
    before = Decision(98 * S, NAME, "robot2 is its standby", Facts(epoch=3))
    other = Decision(100 * S, "/lab/robot1/camera", "robot2 claims epoch 4", Facts(epoch=4))
    expected = f"{silent.sentence}; {claim.sentence}; {runs.sentence}"
    assert why_taken_over((silent, before, claim, other, runs), NAME, 4) == expected
    old = Decision(9 * S, "", "robot3 was silent for 220 ms on every link: it counts as dead")
    assert why_taken_over((old, claim), NAME, 4) == claim.sentence
    assert why_taken_over((), NAME, 4) == ""
