"""Declared programs end: pauses that grow, a limit that is told, a window that forgets, and a state that is kept."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from msgspec.structs import replace

from failover.core import acts
from failover.core.component import Component
from failover.core.events import ActFailed, Exited, Run, Started, Stop, Tick
from failover.core.types import MS, ComponentSpec, Launch, Restart, Rule, Rules, State, WhenAlone
from tests.simulation.invariants import seen_at, state_at
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

PART = "/team/part"
FAILS = 1 << 8


@dataclass(slots=True)
class Service:
    """A world whose ``/team/part`` runs at robot1. ``begun``: what began it, and when."""

    world: World
    begun: list[tuple[type[acts.Start | acts.Restore], int]] = field(default_factory=list)

    def fail(self, status: int = FAILS) -> int:
        """Until it has failed, and is started anew: after how many milliseconds that was ordered."""
        count, at_ns = len(self.begun), self.world.now_ns
        self.world.program_ends("robot1", PART, status)
        while len(self.begun) == count and self.world.now_ns < at_ns + 30_000 * MS:
            self.world.run(self.world.now_ns + 10 * MS)
        assert len(self.begun) > count, self.notes()
        self.world.run(self.world.now_ns + 400 * MS)
        return (self.begun[-1][1] - at_ns) // MS

    def notes(self) -> str:
        return "; ".join(seen_at(self.world, "robot1", PART).notes)


def at_robot1(one: Service) -> Component:
    node = one.world.robots["robot1"].node
    assert node is not None
    return node._components[PART]


def service(rule: Rule, rules: Rules) -> Service:
    specs = (ComponentSpec(PART, launch=Launch(("part",)), rules=rules),)
    begun: list[tuple[type[acts.Start | acts.Restore], int]] = []

    def watch(world: World, _: str, what: object) -> None:
        if isinstance(what, acts.Start | acts.Restore):
            begun.append((type(what), world.now_ns))

    world = World(1, elective(2, specs, witnesses=1) if rule is Rule.MAJORITY else pair(specs), (watch,))
    for name in world.robots:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"]
    return Service(world, begun)


@pytest.mark.parametrize("rule", [Rule.PAIR, Rule.MAJORITY], ids=str)
def test_each_pause_is_twice_as_long_and_after_the_limit_it_has_failed(rule: Rule) -> None:
    one = service(rule, Rules(restart=Restart.ON_FAILURE, restart_limit=4))
    pauses = [one.fail() for _ in range(4)]
    for pause, wanted in zip(pauses, (100, 200, 400, 800), strict=True):
        assert wanted <= pause < 2 * wanted, pauses
    one.world.program_ends("robot1", PART, FAILS)
    one.world.run(one.world.now_ns + 2_000 * MS)
    assert [state_at(one.world, name, PART) for name in ("robot1", "robot2")] == [State.FAILED, State.FAILED]
    assert "it ended with exit status 1; it was started anew 4 times in 60 s, as often as restart_limit allows" in one.notes()
    assert f"failover start {PART} starts it" in one.notes()


def test_after_the_limit_a_good_end_of_a_program_that_is_always_to_run_is_a_failure() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ALWAYS, restart_limit=1))
    one.fail(0)
    one.world.program_ends("robot1", PART, 0)
    one.world.run(one.world.now_ns + 2_000 * MS)
    assert [state_at(one.world, name, PART) for name in ("robot1", "robot2")] == [State.FAILED, State.FAILED]
    assert "it ended with exit status 0; it was started anew 1 times in 60 s, as often as restart_limit allows" in one.notes()
    assert f"failover start {PART} starts it" in one.notes()


def test_a_program_that_was_protected_has_no_command_to_start_anew() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ALWAYS))
    component = at_robot1(one)
    assert component.spec is not None
    component.spec = replace(component.spec, launch=Launch(pid=7))
    one.world.program_ends("robot1", PART, 0)
    one.world.run(one.world.now_ns + 500 * MS)
    assert state_at(one.world, "robot1", PART) is State.FINISHED


def test_a_stop_while_it_is_started_anew_ends_it_for_good() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ALWAYS))
    one.world.program_ends("robot1", PART, FAILS)
    while state_at(one.world, "robot1", PART) is not State.STARTING:
        one.world.run(one.world.now_ns + 1 * MS)
    one.world.command("robot1", Stop(one.world.request(), PART, 9))
    one.world.run(one.world.now_ns + 2_000 * MS)
    assert state_at(one.world, "robot1", PART) is State.FINISHED
    assert len(one.begun) == 2


@pytest.mark.parametrize("restart", [Restart.NEVER, Restart.ON_FAILURE], ids=str)
def test_an_operators_start_that_fails_is_a_failure_and_forgets_nothing(restart: Restart) -> None:
    rules = Rules(restart=restart)
    one = service(Rule.PAIR, rules)
    one.world.command("robot1", Stop(one.world.request(), PART))
    one.world.run(one.world.now_ns + 1_000 * MS)
    robot = one.world.robots["robot1"]
    node = robot.node
    assert node is not None
    now_ns = one.world.local(robot)
    spec = ComponentSpec(PART, launch=Launch(("part",)), rules=rules)
    robot.life += 1  # its agent carries out nothing more
    node.step(Run(99, spec), now_ns)
    epoch = node.status(now_ns).components[0].epoch
    for step in range(40):
        node.step(Tick(), now_ns + step * 25 * MS)
    ready = node.step(ActFailed(PART, epoch, "no such file: part"), now_ns + 1_000 * MS)
    assert [act.sentence for act in ready.act if isinstance(act, acts.Answer) and not act.ok] == ["no such file: part"]
    view = node.status(now_ns + 1_001 * MS).components[0]
    assert view.state is State.FAILED
    assert f"failover start {PART} starts it" in "; ".join(view.notes)


def test_an_agent_that_is_back_resumes_nothing_from_before_a_fresh_start() -> None:
    """Of the program that has ended; its numbers are not used again."""
    one = service(Rule.PAIR, Rules(restart=Restart.ON_FAILURE))
    robot = one.world.robots["robot1"]
    before = set(robot.store[PART])
    robot.slow = 20  # no checkpoint yet of the program that is started anew
    one.world.program_ends("robot1", PART, FAILS)
    while state_at(one.world, "robot1", PART) is not State.PRIMARY or not one.world.acting(PART):
        one.world.run(one.world.now_ns + 1 * MS)
    one.world.agent_dies("robot1")
    robot.slow = 1
    one.world.power_on("robot1")
    one.world.run(one.world.now_ns + 5 * MS)
    assert robot.node is not None
    assert not before & set(robot.node._components[PART].held)
    one.world.run(one.world.now_ns + 1_000 * MS)
    assert state_at(one.world, "robot1", PART) is State.PRIMARY
    numbers = [(position.generation, position.sequence) for position in robot.store[PART]]
    assert len(numbers) == len(set(numbers))


def test_the_status_tells_of_a_start_that_failed_and_of_the_robot_that_must_hear_this_one() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ON_FAILURE, when_alone=WhenAlone.FREEZE))
    one.world.program_ends("robot1", PART, FAILS)
    while state_at(one.world, "robot1", PART) is not State.STARTING:
        one.world.run(one.world.now_ns + 1 * MS)
    robot = one.world.robots["robot1"]
    one.world.feed(robot, ActFailed(PART, seen_at(one.world, "robot1", PART).epoch, "no such file: part"))
    one.world.network.cuts |= {("robot1", "robot2"), ("robot2", "robot1")}
    one.world.run(one.world.now_ns + 20 * MS)
    assert "no such file: part; it is started anew in 0.2 s" in one.notes()
    one.world.run(one.world.now_ns + 210 * MS)
    assert "no such file: part; it is started anew as soon as another robot hears this one" in one.notes()


def test_a_fresh_start_lost_nothing() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ON_FAILURE))
    component = at_robot1(one)
    component.resumed_ns, component.lost_ns = 1, 9_000 * MS
    one.fail()
    assert (component.resumed_ns, component.lost_ns) == (-1, -1)
    assert "lost" not in one.notes()


def test_while_it_waits_the_status_says_so() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ALWAYS))
    one.world.program_ends("robot1", PART, 3 << 8)
    one.world.run(one.world.now_ns + 20 * MS)
    view = seen_at(one.world, "robot1", PART)
    assert view.restarting
    assert view.protection == "none"
    assert (
        "it ended with exit status 3; it is started anew in 0.1 s, start 1 of 5 in 60 s; failover stop ends that" in one.notes()
    )


def test_a_start_that_is_done_too_late_counts_for_nothing() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ON_FAILURE))
    one.world.program_ends("robot1", PART, FAILS)
    one.world.run(one.world.now_ns + 20 * MS)
    one.world.feed(one.world.robots["robot1"], Started(PART, seen_at(one.world, "robot1", PART).epoch))
    one.world.run(one.world.now_ns + 20 * MS)
    assert state_at(one.world, "robot1", PART) is State.RECOVERING
    one.world.run(one.world.now_ns + 1_000 * MS)
    assert one.world.acting(PART) == ["robot1"]


def test_starts_before_the_window_count_no_more() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ON_FAILURE, restart_limit=1, restart_window_ms=1_000))
    for _ in range(3):
        assert one.fail() < 200
        one.world.run(one.world.now_ns + 1_000 * MS)


def test_without_a_limit_a_pause_is_ten_seconds_at_most() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ALWAYS, restart_limit=0, restart_window_ms=3_600_000))
    pauses = [one.fail(0) for _ in range(9)]
    assert 9_900 <= pauses[-1] <= 10_500, pauses


def test_an_operators_start_counts_anew() -> None:
    rules = Rules(restart=Restart.ON_FAILURE, restart_limit=1)
    one = service(Rule.PAIR, rules)
    one.fail()
    one.world.program_ends("robot1", PART, FAILS)
    one.world.run(one.world.now_ns + 1_000 * MS)
    assert state_at(one.world, "robot1", PART) is State.FAILED
    one.world.command("robot1", Run(one.world.request(), ComponentSpec(PART, launch=Launch(("part",)), rules=rules)))
    one.world.run(one.world.now_ns + 1_000 * MS)
    assert one.fail() < 200


def test_a_program_that_keeps_its_state_first_goes_on_from_it() -> None:
    one = service(Rule.PAIR, Rules(restart=Restart.ON_FAILURE, crash_limit=1))
    kinds = []
    for _ in range(3):
        robot = one.world.robots["robot1"]
        program = robot.programs[PART]
        program.exit_status = FAILS
        one.world.feed(robot, Exited(PART, program.epoch, FAILS, keeps_state=True))
        one.world.run(one.world.now_ns + 600 * MS)
        kinds.append(one.begun[-1][0])
    assert kinds == [acts.Restore, acts.Restore, acts.Start], "its newest state, the one before, then none"
