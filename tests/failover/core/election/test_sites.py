"""Single rules of components that an operator recovered at another site, one event at a time."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from failover.core import acts
from failover.core.events import (
    Event,
    Handover,
    Promote,
    Recovered,
    Release,
    Restored,
    Run,
    SitesHeard,
    Started,
    Stopped,
    TeamChanged,
)
from failover.core.peer_claims import EPOCHS_AWAY_MAX
from failover.core.types import SPAN, ComponentView, Config, Held, Record, Rule, State, VoteRecord
from failover.core.wire.messages import FREE, HOLDS, OPEN
from tests.failover.core.election.test_majority import NAME, NEWEST, SPEC, Talk, entry

FAR = {"robot3": "hall"}
ALONE = Config("robot1", grace_ms=300, boot_patience_ms=5_000, far=FAR)
THREE = Config(
    "robot1", ("robot2", "witness1"), rule=Rule.MAJORITY, witnesses=("witness1",), grace_ms=300, far={"robot3": "hall"}
)
PAIR = Config("robot2", ("robot1",), grace_ms=300, far=FAR)
HELD = (Held(NAME, (NEWEST,)),)
RAN_HERE = Record(NAME, 1, "robot1", State.PRIMARY, spec=SPEC, begun=True)
THERE = Recovered(NAME, SPAN + 1, "robot3")


def booted(*records: Record, config: Config = ALONE) -> Talk:
    """A robot after a loss of power: with its disk, and no program."""
    return Talk(config, VoteRecord(records), HELD)


def view(talk: Talk) -> ComponentView:
    (one,) = talk.node.status(talk.now_ns).components
    return one


def tell(talk: Talk, *events: Event) -> acts.Ready:
    for event in events:
        ready = talk.node.step(event, talk.now_ns)
        talk.readies.append(ready)
    return ready


def refusal(ready: acts.Ready) -> str:
    (answer,) = (act for act in ready.act if isinstance(act, acts.Answer))
    assert not answer.ok
    return answer.sentence


def running() -> Talk:
    talk = Talk(ALONE)
    tell(talk, Run(1, SPEC), Started(NAME, 1))
    return talk


def test_a_robot_that_boots_waits_until_each_other_site_has_told() -> None:
    talk = booted(RAN_HERE)
    talk.tick(4_000)
    assert not talk.orders(acts.Restore) and "claims it in 1 s (boot_patience_s)" in " ".join(view(talk).notes)
    tell(talk, SitesHeard())
    talk.tick(1_000)
    assert talk.orders(acts.Restore), "nothing was recovered elsewhere"


def test_where_no_word_of_the_other_site_comes_it_goes_on_after_the_patience() -> None:
    talk = booted(RAN_HERE)
    talk.tick(6_000)
    assert talk.orders(acts.Restore)


def test_a_declared_program_begins_on_a_new_disk_once_the_other_site_has_told_that_it_has_it_not() -> None:
    config = replace(ALONE, components=(SPEC,))
    first, second = Talk(config), Talk(config)
    for talk in (first, second):
        talk.tick(4_000)
        assert not talk.orders(acts.Start) and "starts it in 1 s (boot_patience_s)" in " ".join(view(talk).notes)
    tell(first, SitesHeard())
    tell(second, THERE, SitesHeard())
    for talk in (first, second):
        talk.tick(1_000)
    assert first.orders(acts.Start) and not second.orders(acts.Start)


def test_what_an_operator_has_just_recovered_here_waits_for_nobody() -> None:
    talk = booted(Record(NAME, SPAN, state=State.STANDBY, spec=SPEC, begun=True))
    talk.tick(1_000)
    assert talk.orders(acts.Restore) and view(talk).epoch == SPAN + 1


def test_a_robot_that_boots_runs_nothing_that_was_recovered_elsewhere_also_after_another_boot() -> None:
    talk = booted(RAN_HERE)
    talk.tick(400)
    tell(talk, THERE, SitesHeard())
    talk.tick(20_000)
    assert not talk.orders(acts.Restore)
    assert (view(talk).primary, view(talk).epoch, view(talk).state) == ("robot3", SPAN + 1, State.STANDBY)
    assert "an operator recovered it at robot3" in " ".join(view(talk).notes)
    kept = [ready.persist for ready in talk.readies if ready.persist is not None][-1]
    again = Talk(ALONE, kept, HELD)
    again.tick(20_000)
    assert not again.orders(acts.Restore), "it is on record"


def test_a_copy_that_acts_is_stopped_and_its_state_kept_aside() -> None:
    talk = running()
    tell(talk, THERE)
    assert talk.orders(acts.KeepAside) and talk.orders(acts.Stop)
    tell(talk, Stopped(NAME, SPAN + 1))
    talk.tick(20_000)
    assert view(talk).state is State.STANDBY and not talk.orders(acts.Restore)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (Recovered(NAME, SPAN - 1, "robot3"), "the span is ours"),
        (Recovered(NAME, SPAN + 1, "robot2"), "it is of no other site"),
        (Recovered(NAME, EPOCHS_AWAY_MAX + 2 * SPAN, "robot3"), "no operator can have recovered it so often"),
    ],
)
def test_a_word_that_is_none_stops_nothing(said: Recovered, why: str) -> None:
    talk = running()
    tell(talk, said)
    talk.tick(1_000)
    assert view(talk).state is State.PRIMARY, why


def test_whom_it_was_brought_back_from_gives_it_up_and_who_has_the_later_span_does_not() -> None:
    record = Record(NAME, 2 * SPAN, state=State.STANDBY, spec=SPEC, begun=True)
    talk = booted(record)
    talk.tick(1_000)
    restores = talk.orders(acts.Restore)
    tell(talk, THERE)
    talk.tick(1_000)
    assert restores and view(talk).epoch == 2 * SPAN + 1 and not talk.orders(acts.KeepAside)


def test_the_word_of_a_robot_of_our_own_site_that_another_site_has_it_counts_for_nothing() -> None:
    talk = Talk(PAIR)
    talk.tick(400)
    tell(talk, Run(1, SPEC), Started(NAME, 1))
    talk.hear("robot1", entry(State.STANDBY, SPAN + 1, "robot3", NEWEST))
    talk.tick(20)
    assert view(talk).state is State.CLAIMING or view(talk).primary == "robot2"
    assert view(talk).epoch < SPAN


def test_votes_elect_no_robot_for_what_another_site_has() -> None:
    record = Record(NAME, 1, "robot1", State.PRIMARY, spec=SPEC, begun=True)
    talk = Talk(THREE, VoteRecord((record,)), HELD)
    tell(talk, THERE, SitesHeard())
    for _ in range(100):
        talk.hear("robot2", entry(State.STANDBY, 1, "robot1", NEWEST, flags=FREE | OPEN))
        talk.hear("witness1", entry(State.STANDBY, 1, "robot1", flags=FREE | OPEN))
        talk.tick(17)
    assert view(talk).primary == "robot3" and view(talk).epoch == SPAN + 1


def test_orders_of_its_former_site_are_refused_with_the_cure_but_release_forgets_it() -> None:
    talk = booted(RAN_HERE)
    tell(talk, THERE, SitesHeard())
    talk.tick(400)
    assert "to bring it back: failover-agent recover /lab/x" in refusal(tell(talk, Promote(1, NAME)))
    assert "to bring it back: failover-agent recover /lab/x" in refusal(tell(talk, Handover(2, NAME)))
    assert "robot3, of another site, has it; choose another name, or failover release" in refusal(tell(talk, Run(3, SPEC)))
    tell(talk, Release(4, NAME), Run(5, SPEC))
    tell(talk, THERE)
    assert view(talk).primary == "robot1" and view(talk).epoch == SPAN + 2, "its operator has begun another one of that name"


def test_a_robot_that_has_it_may_leave_its_team_and_the_lost_site_claims_nothing() -> None:
    talk = booted(RAN_HERE, config=replace(ALONE, far={"robot3": "hall", "robot4": "hall"}))
    tell(talk, THERE, SitesHeard())
    talk.tick(1_000)
    tell(talk, Recovered(NAME, SPAN + 2, "robot4"))  # handed over there
    assert (view(talk).primary, view(talk).epoch) == ("robot4", SPAN + 2)
    tell(talk, TeamChanged(replace(ALONE, far=FAR)))
    talk.tick(20_000)
    assert not talk.orders(acts.Restore) and "an operator recovered it at robot4" in " ".join(view(talk).notes)
    assert "recover /lab/x" in refusal(tell(talk, Promote(1, NAME)))
    tell(talk, Recovered(NAME, SPAN + 3, "robot3"))
    assert (view(talk).primary, view(talk).epoch) == ("robot3", SPAN + 3)


def test_what_ended_at_a_robot_that_is_of_another_site_now_is_not_there() -> None:
    record = Record(NAME, 3, "robot3", State.STANDBY, spec=SPEC, begun=True)
    talk = booted(record)
    tell(talk, SitesHeard())
    talk.tick(6_000)
    assert talk.orders(acts.Restore) and not record.is_elsewhere


def test_a_robot_of_its_former_site_that_boots_hears_from_no_neighbour_that_it_is_free() -> None:
    """The robot that had it has left the team; the neighbour knows of a later epoch there."""
    config = replace(PAIR, far={"robot4": "hall"})
    talk = Talk(config, VoteRecord((Record(NAME, SPAN + 1, "robot3", State.STANDBY, spec=SPEC, elsewhere=1),)), HELD)
    for _ in range(300):
        talk.hear("robot1", entry(State.STANDBY, SPAN + 2, "robot3", NEWEST))
        talk.tick(20)
    assert view(talk).epoch == SPAN + 1 and not talk.orders(acts.Restore)
    unknown = Talk(config, VoteRecord(), HELD)
    unknown.hear("robot1", entry(State.STANDBY, SPAN + 2, "robot3", NEWEST, flags=HOLDS))
    tell(unknown, Recovered(NAME, SPAN + 2, "robot4"))
    assert "an operator recovered it at robot4" in " ".join(view(unknown).notes)


@pytest.mark.parametrize(("ours", "is_first"), [("dock", True), ("mill", False)])
def test_of_two_sites_where_it_was_recovered_the_one_whose_name_sorts_first_goes_on(ours: str, *, is_first: bool) -> None:
    talk = booted(Record(NAME, SPAN, state=State.STANDBY, spec=SPEC, begun=True), config=replace(ALONE, site=ours))
    tell(talk, Recovered(NAME, SPAN + 3, "robot3"))
    talk.tick(1_000)
    assert f"the site of {'robot1' if is_first else 'robot3'}, whose name sorts first, goes on" in " ".join(view(talk).notes)
    tell(talk, Restored(NAME, SPAN + 1, NEWEST, 0), Recovered(NAME, SPAN + 3, "robot3"))
    talk.tick(1_000)
    assert view(talk).state is State.PRIMARY and view(talk).epoch == (2 * SPAN + 1 if is_first else SPAN + 1)
    assert is_first == ("two copies may act" not in " ".join(view(talk).notes))
    assert sum("whose name sorts first" in one.sentence for ready in talk.readies for one in ready.told) == 1
    if not is_first:
        tell(talk, Recovered(NAME, 2 * SPAN + 1, "robot3"))
        assert talk.orders(acts.KeepAside) and view(talk).primary == "robot3"


def test_what_began_anew_after_a_release_is_no_other_copy_of_it() -> None:
    talk = booted(RAN_HERE)
    tell(talk, THERE, SitesHeard(), Release(4, NAME), Run(5, SPEC), Started(NAME, SPAN + 2))
    tell(talk, replace(THERE, epoch=SPAN + 9))
    talk.tick(1_000)
    assert view(talk).epoch == SPAN + 2 and not view(talk).recovered and view(talk).state is State.PRIMARY
    assert "operator" not in " ".join(view(talk).notes)


def test_what_began_anew_at_a_neighbour_after_a_release_and_ended_there_is_not_elsewhere() -> None:
    talk = Talk(PAIR, VoteRecord((Record(NAME, SPAN + 1, "robot3", State.STANDBY, spec=SPEC, elsewhere=1),)), HELD)
    talk.hear("robot1", entry(State.FINISHED, SPAN + 2, "robot1"))
    assert view(talk).state is State.FINISHED and "operator" not in " ".join(view(talk).notes)
    tell(talk, Recovered(NAME, SPAN + 5, "robot3"))
    assert view(talk).primary == "robot1"
