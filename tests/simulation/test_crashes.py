"""A program dies at a robot that lives: resumed where it stood, then from one checkpoint before, then left with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from checkpoint.model import Position
from failover.core import acts
from failover.core.events import Handover, Stop
from failover.core.types import MS, ComponentSpec, Launch, OnCrash, Rule, Rules, State
from tests.simulation.invariants import seen_at, state_at
from tests.simulation.teams import coordinated, elective, pair
from tests.simulation.world import World

PART = "/team/part"
CRASH = 11


@dataclass(slots=True)
class Fate:
    """A world whose ``/team/part`` runs at robot1, protected by robot2. ``resumed``: from which positions, at which robots."""

    world: World
    resumed: list[tuple[str, Position]] = field(default_factory=list)

    def crash(self) -> None:
        self.world.program_ends("robot1", PART, CRASH)
        self.after(300)

    def after(self, ms: int) -> None:
        self.world.run(self.world.now_ns + ms * MS)

    def kept(self, robot: str) -> list[Position]:
        return self.world.robots[robot].store[PART]

    def positions(self) -> list[Position]:
        """The checkpoints from which robot1 can resume, oldest first."""
        return list(reversed(seen_at(self.world, "robot1", PART).positions))

    def notes(self) -> str:
        return "; ".join(seen_at(self.world, "robot1", PART).notes)


def team(rule: Rule, rules: Rules, robots: int = 2) -> Fate:
    specs = (ComponentSpec(PART, launch=Launch(("part",)), rules=rules),)
    resumed: list[tuple[str, Position]] = []

    def watch(_: World, robot: str, what: object) -> None:
        if isinstance(what, acts.Restore):
            resumed.append((robot, what.position))

    configs = {
        Rule.PAIR: pair(specs, tuple(f"robot{number + 1}" for number in range(robots))),
        Rule.MAJORITY: elective(robots, specs, witnesses=1),
        Rule.ETCD: coordinated(robots, specs),
    }
    world = World(1, configs[rule], (watch,))
    for name in world.robots:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"]
    return Fate(world, resumed)


@pytest.mark.parametrize("rule", list(Rule))
def test_a_crash_is_resumed_where_it_stood_then_from_one_checkpoint_before_then_not_again(rule: Rule) -> None:
    fate = team(rule, Rules(crash_limit=2))
    for nth in (1, 2, 3):
        before = fate.positions()
        fate.crash()
        robot, position = fate.resumed[-1]
        assert (robot, position) == ("robot1", before[-1 if nth <= 2 else -2])
        assert fate.world.acting(PART) == ["robot1"]
    fate.crash()
    assert len(fate.resumed) == 3 and fate.world.acting(PART) == []
    assert "4 crashes in 60 s; look at its logs" in fate.notes()
    fate.after(5_000)
    states = {name: state_at(fate.world, name, PART) for name in fate.world.robots}
    assert {*states.values()} == {State.FAILED} and fate.world.acting(PART) == []


@pytest.mark.parametrize("rule", list(Rule))
def test_a_program_that_fails_for_good_loses_no_checkpoint(rule: Rule) -> None:
    fate = team(rule, Rules(crash_limit=1))
    for _ in range(3):
        fate.crash()
    assert state_at(fate.world, "robot1", PART) is State.FAILED
    fate.after(5_000)
    positions = fate.positions()
    assert len(positions) > 1 and {*positions} <= {*fate.kept("robot1")} and fate.kept("robot2")


@pytest.mark.parametrize("rule", list(Rule))
def test_crashes_outside_the_window_are_forgiven(rule: Rule) -> None:
    fate = team(rule, Rules(crash_limit=1, crash_window_ms=1_000))
    for _ in range(6):
        fate.crash()
        fate.after(1_200)
        assert fate.world.acting(PART) == ["robot1"]


@pytest.mark.parametrize("rule", list(Rule))
def test_on_crash_leave_leaves_it_and_says_so(rule: Rule) -> None:
    fate = team(rule, Rules(on_crash=OnCrash.LEAVE))
    fate.crash()
    assert fate.world.acting(PART) == [] and not fate.resumed
    assert "it died by signal 11; on_crash = leave" in fate.notes()


@pytest.mark.parametrize("rule", list(Rule))
def test_a_crash_loop_does_not_wander_from_robot_to_robot_for_ever(rule: Rule) -> None:
    """Its robot dies in the middle of the loop: the next one counts its own crashes, and stops as well."""
    fate = team(rule, Rules(crash_limit=1))
    fate.crash()
    fate.crash()
    fate.world.power_off("robot1")
    fate.after(500)
    assert fate.world.acting(PART) == ["robot2"]
    for _ in range(3):
        fate.world.program_ends("robot2", PART, CRASH)
        fate.after(300)
    assert state_at(fate.world, "robot2", PART) is State.FAILED and len(fate.resumed) <= 2 * 3


@pytest.mark.parametrize("rule", list(Rule))
def test_a_takeover_whose_program_refuses_its_state_has_failed_and_status_says_why(rule: Rule) -> None:
    fate = team(rule, Rules())
    fate.world.robots["robot2"].refuses = True
    fate.world.power_off("robot1")
    fate.after(10_000)
    tries = [robot for robot, _ in fate.resumed]
    assert tries == ["robot2"] * 3 and state_at(fate.world, "robot2", PART) is State.STANDBY
    notes = seen_at(fate.world, "robot2", PART).notes
    assert notes == ("robot2 cannot run it: /team/part ended with exit code 1 before it kept anything",)


@pytest.mark.parametrize("rule", list(Rule))
def test_a_program_that_refuses_its_state_when_it_is_resumed_in_place_goes_one_checkpoint_back(rule: Rule) -> None:
    fate = team(rule, Rules(crash_limit=1))
    fate.world.robots["robot1"].refuses = True
    fate.crash()
    fate.world.robots["robot1"].refuses = False
    fate.after(300)
    (_, newest), (_, older) = fate.resumed[:2]
    assert older < newest
    assert state_at(fate.world, "robot1", PART) in (State.PRIMARY, State.FAILED)


def alone(rules: Rules) -> Fate:
    """robot2 is lost: of the pair's rule, for robot1 must hear a majority by the others."""
    fate = team(Rule.PAIR, rules)
    fate.world.power_off("robot2")
    fate.after(1_000)
    assert fate.world.acting(PART) == ["robot1"]
    return fate


@pytest.mark.parametrize("rule", list(Rule))
def test_a_restore_that_fails_once_is_no_crash_and_the_next_is_from_the_same_checkpoint_at_once(rule: Rule) -> None:
    fate = team(rule, Rules(crash_limit=1))
    newest = fate.positions()[-1]
    fate.world.robots["robot1"].failing = 1
    fate.crash()
    assert fate.resumed == [("robot1", newest)] * 2 and fate.world.acting(PART) == ["robot1"]
    node = fate.world.robots["robot1"].node
    assert node is not None and len(node._components[PART].crashes) == 1


@pytest.mark.parametrize("rule", list(Rule))
def test_where_a_restore_fails_twice_a_robot_that_holds_all_that_was_acknowledged_resumes_it(rule: Rule) -> None:
    fate = team(rule, Rules(crash_limit=1))
    acknowledged = seen_at(fate.world, "robot2", PART).positions[0]
    fate.world.robots["robot1"].failing = 99
    fate.crash()
    fate.after(1_000)
    assert [robot for robot, _ in fate.resumed] == ["robot1", "robot1", "robot2"] and fate.world.acting(PART) == ["robot2"]
    assert fate.resumed[-1][1] >= acknowledged
    fate.after(2_000)
    assert seen_at(fate.world, "robot2", PART).standby == "robot1", "which keeps checkpoints all the same"


def test_a_robot_that_is_alone_tries_to_resume_it_after_pauses_for_ever_and_from_no_older_checkpoint() -> None:
    fate = alone(Rules(crash_limit=1))
    newest = fate.positions()[-1]
    fate.world.robots["robot1"].failing = 99
    fate.crash()
    assert fate.resumed == [("robot1", newest)] * 3, "after 0, 0 and 0.2 s"
    assert "robot1 cannot run it: there is no memory; robot1 tries again in 2 s" in fate.notes()
    fate.after(1_500)
    assert fate.resumed == [("robot1", newest)] * 3
    fate.after(60_000)
    assert fate.resumed == [("robot1", newest)] * 9, "then after 2, 2 and each 12 s"
    assert fate.world.acting(PART) == [] and fate.positions()[-1] == newest
    fate.world.robots["robot1"].failing = 0
    fate.after(12_500)
    assert fate.resumed == [("robot1", newest)] * 10 and fate.world.acting(PART) == ["robot1"]


def test_an_operators_order_does_not_wait_for_the_next_try() -> None:
    fate = alone(Rules())
    newest = fate.positions()[-1]
    fate.world.robots["robot1"].failing = 3
    fate.crash()
    fate.world.command("robot1", Handover(fate.world.request(), PART))
    fate.after(200)
    assert fate.resumed == [("robot1", newest)] * 4 and fate.world.acting(PART) == ["robot1"]


def test_an_operator_whose_order_fails_is_told_at_once_and_why() -> None:
    fate = alone(Rules())
    fate.world.robots["robot1"].failing = 99
    fate.crash()
    fate.world.command("robot1", Handover(fate.world.request(), PART))
    fate.after(200)
    assert any(f"robot1 answers: robot1 cannot run {PART}: there is no memory" in line for line in fate.world.log)
    fate.world.command("robot1", Stop(fate.world.request(), PART))
    fate.after(50)
    assert f"could not resume it; failover handover {PART} tries again, failover release {PART} forgets it" in fate.world.log[-1]


def test_a_robot_that_holds_less_than_was_acknowledged_does_not_resume_what_the_primary_could_not() -> None:
    """robot1 wrote more while it was alone; robot2 comes back as the restore fails."""
    fate = alone(Rules())
    newest = fate.positions()[-1]
    fate.world.robots["robot1"].failing = 2
    fate.world.program_ends("robot1", PART, CRASH)
    fate.world.power_on("robot2")
    fate.after(4_000)
    assert fate.resumed[:3] == [("robot1", newest)] * 3 and fate.world.acting(PART) == ["robot1"]


@pytest.mark.parametrize("rule", list(Rule))
def test_a_robot_that_cannot_resume_what_it_took_over_sends_its_checkpoint_to_one_that_can(rule: Rule) -> None:
    fate = team(rule, Rules(), robots=3)
    standby = seen_at(fate.world, "robot1", PART).standby
    (other,) = {"robot2", "robot3"} - {standby}
    acknowledged = seen_at(fate.world, standby, PART).positions[0]
    fate.world.robots[standby].failing = 99
    fate.world.power_off("robot1")
    fate.after(10_000)
    assert fate.world.acting(PART) == [other] and fate.resumed[-1] == (other, acknowledged)
    assert seen_at(fate.world, other, PART).standby == standby, "which keeps checkpoints all the same"


@pytest.mark.parametrize("rule", list(Rule))
def test_a_robot_that_is_back_without_its_disk_begins_nothing_anew_of_which_another_one_holds_a_checkpoint(rule: Rule) -> None:
    """That one could not resume it: once, or at all."""
    for failing in (1, 99):
        fate = team(rule, Rules())
        acknowledged = seen_at(fate.world, "robot2", PART).positions[0]
        fate.world.power_off("robot1")
        fate.world.robots["robot2"].failing = failing
        fate.after(300)
        fate.world.new_disk("robot1", vote_record=True)
        fate.world.power_on("robot1")
        fate.after(10_000)
        assert fate.world.acting(PART) == (["robot2"] if failing == 1 else ["robot1"])
        assert all(position >= acknowledged for _, position in fate.resumed), fate.resumed


@pytest.mark.parametrize("rule", list(Rule))
def test_a_crash_whose_checkpoint_cannot_be_read_here_is_resumed_by_the_robot_that_holds_it_too(rule: Rule) -> None:
    fate = team(rule, Rules())
    newest = fate.positions()[-1]
    fate.kept("robot1").remove(newest)
    fate.crash()
    fate.after(700)
    assert [robot for robot, _ in fate.resumed] == ["robot1", "robot2"] and fate.world.acting(PART) == ["robot2"]


def test_a_checkpoint_that_no_robot_can_read_is_left_out() -> None:
    fate = alone(Rules())
    *_, older, newest = fate.positions()
    fate.kept("robot1").remove(newest)
    fate.crash()
    assert fate.resumed == [("robot1", newest), ("robot1", older)] and fate.world.acting(PART) == ["robot1"]
