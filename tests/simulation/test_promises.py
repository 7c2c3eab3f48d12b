"""Each promise that ``failover status`` states (`failover.core.status.guarantee`), held against the behaviour of the rules."""

from __future__ import annotations

from dataclasses import dataclass, field

from msgspec.structs import replace

from failover.core import acts
from failover.core.events import Handover, Promote
from failover.core.types import MS, ComponentSpec, Launch, OnLoss, Rule, Rules, State, WhenAlone
from tests.simulation.coordinator import Coordination
from tests.simulation.invariants import Invariants, seen_at, state_at
from tests.simulation.teams import coordinated, elective, pair
from tests.simulation.world import Watcher, World

PART = "/team/part"
SETTLED_NS = 2_000 * MS


@dataclass(slots=True)
class Team:
    """A world: ``/team/part`` runs at robot1, robot2 is its standby. ``aside``: robots that kept a copy's state aside."""

    world: World
    invariants: Invariants
    aside: list[str] = field(default_factory=list)

    def after(self, ms: int) -> list[str]:
        """Where it acts some time later."""
        self.world.run(self.world.now_ns + ms * MS)
        return self.world.acting(PART)

    def cut(self, one: str, *others: str) -> None:
        self.world.network.cuts |= {way for other in others for way in ((one, other), (other, one))}

    def says(self, robot: str) -> str:
        """The team's promise, as a robot tells it now."""
        node = self.world.robots[robot].node
        assert node is not None
        return node.status(self.world.local(self.world.robots[robot])).promise

    def says_of_it(self, robot: str) -> str:
        return seen_at(self.world, robot, PART).promise

    def story_of_it(self, robot: str) -> list[str]:
        """The component's own promises in the journal, oldest first."""
        return [one.sentence for one in self.world.robots[robot].told if one.component and one.sentence.startswith("If ")]

    def journal(self, robot: str) -> list[str]:
        """The team's promises in the journal, oldest first."""
        said = (one.sentence for one in self.world.robots[robot].told if not one.component)
        return [sentence for sentence in said if "that vote" in sentence]


def team(
    witnesses: int = 0,
    alone: WhenAlone = WhenAlone.RUN,
    robots: int = 2,
    servers: int = 0,
    on_loss: OnLoss = OnLoss.TAKEOVER,
) -> Team:
    specs = (ComponentSpec(PART, launch=Launch(("part",)), rules=Rules(when_alone=alone, on_loss=on_loss)),)
    votes = robots + witnesses + servers > 2
    configs = elective(robots, specs, servers, witnesses) if votes else pair(specs)
    invariants = Invariants(safe={PART} if votes or alone is WhenAlone.FREEZE else set(), votes=votes)
    seen: list[str] = []
    world = World(1, configs, (invariants, kept_aside_at(seen)))
    for name in world.robots:
        world.power_on(name)
    world.run(SETTLED_NS)
    assert world.acting(PART) == ["robot1"] and seen_at(world, "robot1", PART).standby == "robot2"
    return Team(world, invariants, seen)


def kept_aside_at(robots: list[str]) -> Watcher:
    """Notes every robot that keeps a copy's state aside."""

    def watch(_: World, robot: str, what: object) -> None:
        if isinstance(what, acts.KeepAside):
            robots.append(robot)

    return watch


# rule = "pair"


def test_whoever_is_silent_is_replaced() -> None:
    two = team()
    assert "a robot that is silent for 170 ms (up to 300 where beats come late) is replaced" in two.says("robot1")
    two.world.power_off("robot1")
    assert two.after(160) == []
    assert two.after(200) == ["robot2"]


def test_a_total_cut_between_two_that_live_can_run_a_component_twice() -> None:
    two = team()
    says = two.says("robot1")
    assert "after a total cut two live robots can both run a component until they hear each other" in says
    assert "then the copy that never stopped continues" in says
    two.cut("robot1", "robot2")
    assert two.after(500) == ["robot1", "robot2"]


def test_when_they_meet_again_the_copy_that_never_stopped_goes_on_and_the_other_ones_state_is_kept_aside() -> None:
    two = team()
    two.cut("robot1", "robot2")
    two.after(500)
    two.world.network.cuts.clear()
    assert two.after(500) == ["robot1"]
    assert two.aside == ["robot2"] and state_at(two.world, "robot2", PART) is State.STANDBY
    assert seen_at(two.world, "robot1", PART).epoch == 3, "above the one that robot2 had opened"


def test_of_two_that_claimed_the_same_epoch_the_lesser_name_goes_on_and_the_others_state_is_kept_aside() -> None:
    specs = (ComponentSpec(PART, launch=Launch(("part",))),)
    aside: list[str] = []
    world = World(1, pair(specs), (kept_aside_at(aside),))
    world.network.cuts = {("robot1", "robot2"), ("robot2", "robot1")}
    for name in ("robot2", "robot1"):
        world.power_on(name)
        world.run(world.now_ns + 300 * MS)
    world.run(SETTLED_NS)
    assert world.acting(PART) == ["robot1", "robot2"]
    assert seen_at(world, "robot1", PART).epoch == seen_at(world, "robot2", PART).epoch == 1
    world.network.cuts.clear()
    world.run(world.now_ns + 300 * MS)
    assert world.acting(PART) == ["robot1"] and aside == ["robot2"]


def test_the_team_of_two_says_its_rule_and_its_promise_in_one_sentence_each() -> None:
    two = team()
    node = two.world.robots["robot1"].node
    assert node is not None
    status = node.status(two.world.local(two.world.robots["robot1"]))
    assert status.rule == "pair" and status.promise.count(".") == 1 and status.promise.endswith(".")
    promises = [one.promise for one in status.components]
    assert promises == [
        "If robot1 is silent for 170 ms (up to 300 where beats come late), robot2 runs it; "
        "it may run twice if both live on and cannot hear each other; then the copy that never stopped continues."
    ]


def test_except_where_when_alone_is_freeze_there_it_stands_still_here_first() -> None:
    two = team(alone=WhenAlone.FREEZE)
    assert "when_alone = freeze prevents that" in two.says("robot1")
    assert two.says_of_it("robot1") == (
        "If robot1 is silent for 170 ms (up to 300 where beats come late), robot2 runs it; it stands still here first."
    )
    two.cut("robot1", "robot2")
    seen = [two.after(5) for _ in range(100)]
    stood = seen.index([])
    assert all(one == ["robot1"] for one in seen[:stood]) and all(one in ([], ["robot2"]) for one in seen[stood:])
    assert seen[-1] == ["robot2"]


def test_a_robot_whose_beats_are_refused_counts_as_silent_so_it_can_run_twice_as_in_a_cut() -> None:
    two = team()
    lane = two.world.robots["robot2"].lane
    assert lane is not None
    lane.hear("robot1", b"another key, of another life")
    lane.hear("robot1", b"and one more: the old is forgotten")
    assert set(two.after(500)) == {"robot2"} or set(two.after(0)) == {"robot1", "robot2"}


def test_who_hears_nobody_says_that_nothing_is_protected() -> None:
    two = team()
    two.world.power_off("robot2")
    two.after(500)
    assert two.says("robot1") == "robot1 hears no other robot: its programs are not protected."


# rule = "majority"


def test_with_a_majority_no_component_acts_at_two_robots_at_once() -> None:
    three = team(robots=3)
    assert three.says("robot1").startswith(
        "robot1 hears 3 of 3 that vote, itself among them, and 2 are a majority: no component acts"
    )
    three.cut("robot1", "robot2", "robot3")
    seen = [three.after(5) for _ in range(100)]
    assert all(len(one) < 2 for one in seen) and seen[-1] == ["robot2"]


def test_without_a_majority_what_runs_here_stands_still_and_nothing_is_taken_over_until_more_are_heard() -> None:
    three = team(robots=2, witnesses=1)
    three.world.power_off("witness1")
    assert three.after(500) == ["robot1"]
    three.cut("robot1", "robot2")
    assert three.after(500) == [] and three.after(1_000) == []
    sentence = "1 of 3 that vote, itself among them, and 2 are a majority: its programs stand still, and it takes nothing over"
    assert sentence in three.says("robot1") and sentence in three.says("robot2")
    three.world.power_on("witness1")
    assert three.after(500) == ["robot1"]


def test_the_journal_has_the_promise_at_each_change() -> None:
    three = team(robots=2, witnesses=1)
    before = three.journal("robot1")
    three.after(500)
    assert three.journal("robot1") == before
    three.world.power_off("witness1")
    three.after(500)
    assert three.journal("robot1") == [*before, three.says("robot1")] and "hears 2 of 3" in three.says("robot1")


def test_what_on_loss_holds_is_kept_for_the_return_and_is_told_apart_from_the_teams_promise() -> None:
    two = team(on_loss=OnLoss.HOLD)
    sentence = "If robot1 is lost, robot2 keeps its newest checkpoint until robot1 is back."
    assert two.says_of_it("robot1") == sentence and seen_at(two.world, "robot1", PART).differs
    assert two.story_of_it("robot1") == [sentence]
    two.world.power_off("robot1")
    assert two.after(2_000) == []
    two.world.power_on("robot1")
    assert two.after(2_000) == ["robot1"]


def test_where_a_server_stands_by_it_gives_the_checkpoint_to_the_first_robot_that_can_run_it() -> None:
    three = team(robots=2, servers=1)
    assert not seen_at(three.world, "robot1", PART).differs and three.story_of_it("robot1") == []
    three.world.power_off("robot2")
    three.after(2_000)
    sentence = "If robot1 is lost, server1 gives its newest checkpoint to the first robot that can run it."
    assert three.says_of_it("robot1") == sentence and three.story_of_it("robot1") == [sentence]
    value = three.world.values[three.world.robots["server1"].store[PART][-1]]
    three.world.power_off("robot1")
    three.world.new_disk("robot2", vote_record=True)
    three.world.power_on("robot2")
    assert three.after(3_000) == ["robot2"]
    assert three.world.robots["robot2"].programs[PART].value >= value


def test_a_witness_votes_and_holds_nothing() -> None:
    three = team(robots=2, witnesses=1)
    assert three.says_of_it("witness1") == "witness1 votes for the robot that runs it, now robot1."
    assert not three.world.robots["witness1"].store


def test_a_server_holds_what_was_acknowledged_besides_the_standby() -> None:
    three = team(robots=2, servers=1)
    three.after(500)
    held = {name: robot.store[PART][-1].sequence for name, robot in three.world.robots.items()}
    assert held["robot1"] - held["server1"] <= 2 and held["robot1"] - held["robot2"] <= 1


def test_a_handover_at_a_robot_with_an_older_checkpoint_is_refused_and_a_promotion_is_obeyed() -> None:
    five = team(robots=3, witnesses=2)
    world = five.world
    world.power_off("robot2")
    five.after(500)
    world.power_on("robot2")
    five.after(500)
    world.power_off("robot1")
    world.power_off("robot3")
    assert five.after(1_000) == []
    world.command("robot2", Handover(world.request(), PART, "robot2"))
    assert five.after(500) == []
    assert "a newer checkpoint of /team/part may be at robot3 or robot1" in world.log[-1]
    epoch = seen_at(world, "robot2", PART).epoch
    five.invariants.split.add(PART)  # an older checkpoint than the acknowledged one is what the operator asks for
    world.command("robot2", Promote(world.request(), PART))
    assert five.after(500) == ["robot2"] and seen_at(world, "robot2", PART).epoch > epoch


# Members that do not live by the same rule


def test_two_that_decide_by_different_rules_start_and_take_over_nothing_between_them_and_say_so() -> None:
    specs = (ComponentSpec(PART, launch=Launch(("part",))),)
    one, other = pair(specs)
    world = World(1, [one, replace(other, rule=Rule.MAJORITY)])
    two = Team(world, Invariants())
    world.power_on("robot1")
    assert two.after(1_000) == ["robot1"]
    world.power_on("robot2")
    assert two.after(2_000) == ["robot1"] and state_at(world, "robot2", PART) is State.ABSENT
    sentence = "robot1 decides by rule = pair, robot2 by another: between them they start, take over, move and protect nothing"
    assert sentence in two.says("robot1") and "robot2 decides by rule = majority, robot1 by another" in two.says("robot2")
    assert any(sentence in one.sentence for one in world.robots["robot1"].told)
    world.power_off("robot1")
    assert two.after(2_000) == []


def test_the_vote_of_a_member_that_decides_by_another_rule_does_not_count() -> None:
    three = team(robots=3)
    three.world.power_off("robot3")
    three.world.robots["robot3"].config = pair(names=("robot3", "robot1", "robot2"))[0]
    three.world.power_on("robot3")
    assert three.after(1_000) == ["robot1"]
    three.world.power_off("robot1")
    assert three.after(2_000) == []
    three.world.power_on("robot1")
    assert three.after(2_000) in (["robot1"], ["robot2"])


# rule = "etcd"


def with_etcd(robots: int = 2) -> Team:
    specs = (ComponentSpec(PART, launch=Launch(("part",))),)
    invariants = Invariants(safe={PART}, votes=True)
    world = World(1, coordinated(robots, specs), (invariants,))
    for name in world.robots:
        world.power_on(name)
    world.run(SETTLED_NS)
    assert world.acting(PART) == ["robot1"] and seen_at(world, "robot1", PART).standby == "robot2"
    return Team(world, invariants)


def etcd_of(team: Team) -> Coordination:
    assert team.world.coordination is not None
    return team.world.coordination


def test_with_etcd_a_lost_robot_of_two_is_replaced_and_nothing_acts_twice() -> None:
    two = with_etcd()
    says = two.says("robot1")
    assert "hears 1 of 1 other members and reaches etcd; 2 of 3 votes decide" in says
    assert "no component acts at two robots at once; a robot that is silent is replaced after 0.2 s" in says
    two.world.power_off("robot1")
    assert two.after(160) == []
    assert two.after(600) == ["robot2"]


def test_while_etcd_is_gone_programs_run_on_and_nobody_is_taken_over() -> None:
    two = with_etcd()
    etcd_of(two).down = True
    assert two.after(60_000) == ["robot1"]
    assert "does not reach etcd: programs run on while the members hear each other" in two.says("robot1")
    assert "nobody is taken over, and who is left alone stands still, until etcd is back" in two.says("robot2")
    assert seen_at(two.world, "robot1", PART).protection == "protected"

    two.world.power_off("robot1")
    assert two.after(10_000) == []
    assert "its programs stand still until it hears more" in two.says("robot2")
    etcd_of(two).heal()
    assert two.after(600) == ["robot2"]


def test_a_primary_that_does_not_reach_etcd_runs_on_beside_its_standby_and_stands_still_alone() -> None:
    two = with_etcd()
    etcd_of(two).cut.add("robot1")
    assert two.after(10_000) == ["robot1"]
    assert seen_at(two.world, "robot1", PART).epoch == 1
    two.cut("robot1", "robot2")
    assert two.after(170) == []
    assert two.after(600) == ["robot2"]


def test_robots_that_never_hear_each_other_run_it_once() -> None:
    specs = (ComponentSpec(PART, launch=Launch(("part",))),)
    world = World(1, coordinated(2, specs), (Invariants(safe={PART}, votes=True),))
    world.network.cuts = {("robot1", "robot2"), ("robot2", "robot1")}
    for name in world.robots:
        world.power_on(name)
    world.run(5_000 * MS)
    (first,) = world.acting(PART)
    world.run(world.now_ns + 10_000 * MS)
    assert world.acting(PART) == [first]


def test_with_four_and_etcd_a_lost_robot_is_replaced_also_while_etcd_is_gone() -> None:
    four = with_etcd(4)
    etcd_of(four).down = True
    four.after(2_000)
    assert "a lost robot is replaced all the same" in four.says("robot2")
    four.world.power_off("robot1")
    assert four.after(1_000) == ["robot2"]
    assert "nobody is taken over" in four.says("robot2"), "three of five votes are left"
