"""Invariants that must hold at every instant of every simulated world, in every fault."""

from __future__ import annotations

from dataclasses import dataclass, field

from checkpoint.model import Position
from failover.core import acts
from failover.core.types import ENDED, MS, ComponentView, OnLoss, Restart, Resumption, State, VoteRecord, WhenAlone
from failover.core.wire.messages import ORDERED, Beat
from tests.simulation.deeds import epoch_of
from tests.simulation.liars import INVENTED_NAME
from tests.simulation.robots import NewDisk, vote_record_of
from tests.simulation.world import World

SURELY_UNREAD_NS = 5_000 * MS
"""Less than the time for which a sign counts, by any clock and after any leap."""


class Broken(AssertionError):
    """An invariant does not hold; the message is the story."""


@dataclass(slots=True)
class Invariants:
    """Watches one world.

    Attributes:
        safe: components that must never act twice: ``when_alone`` is freeze, or primaries are elected.
        votes: primaries are elected; ``given``: who voted for whom, of which component, in which epoch; ``cast``: the same, with
            votes that their voters have lost together with their disks: their elections still count.
        elected: component, epoch and robot that a majority of this robot's team had voted for at some instant.
        gone: positions that were on a disk that was lost.
        split: components that computed in two places at once (allowed under ``run``, after a cut).
        acknowledged: newest position that each component's primaries acknowledged while a standby held it.
        seen: how far readers have seen each component, by the epoch of what they saw.
        begun: where the copy of each epoch began.
        ordered: components and the epochs that an operator's order claimed: it may cost what was acknowledged.
        last: components whose end was reported as acknowledged.
        over: (robot, component): its program has ended by itself, and was cleared away; the component is declared, perhaps.
        former: positions of a declared component's program that had ended before the one that runs was started anew.
        forgetful: robots that lost their vote records.
        emptied: components that resumed from an older checkpoint after all disks with what was acknowledged had been lost.
        liar: a robot whose key was stolen. It may give away, end or hold back what it runs and keeps itself; so then only that is
            looked at which no robot's word may break: the others run nothing twice, vote once, and no epoch falls.
    """

    safe: set[str] = field(default_factory=set)
    votes: bool = False
    liar: str = ""
    gone: set[Position] = field(default_factory=set)
    given: dict[tuple[str, str, int], str] = field(default_factory=dict)
    cast: set[tuple[str, str, int, str]] = field(default_factory=set)
    elected: set[tuple[str, int, str]] = field(default_factory=set)
    split: set[str] = field(default_factory=set)
    epochs: dict[tuple[str, str], int] = field(default_factory=dict)
    acknowledged: dict[str, Position] = field(default_factory=dict)
    shipped: dict[str, Position] = field(default_factory=dict)
    owners: dict[tuple[str, int], str] = field(default_factory=dict)
    ordered: set[tuple[str, int]] = field(default_factory=set)
    seen: dict[str, dict[int, Position]] = field(default_factory=dict)
    begun: dict[str, dict[int, int]] = field(default_factory=dict)
    last: set[str] = field(default_factory=set)
    crashing: set[tuple[str, str]] = field(default_factory=set)
    over: set[tuple[str, str]] = field(default_factory=set)
    former: dict[str, set[Position]] = field(default_factory=dict)
    forgetful: set[str] = field(default_factory=set)
    emptied: set[str] = field(default_factory=set)

    def __call__(self, world: World, robot: str, what: object) -> None:
        """Look at one thing that happened, or (None) at the state of the world."""
        if self.liar and isinstance(what, acts.Show | acts.Acknowledge | acts.ReportExit | acts.Start | acts.Restore):
            if robot != self.liar and isinstance(what, acts.Start | acts.Restore):
                self._one_primary(world, robot, what)
            return
        match what:
            case None:
                self._one_acts(world)
            case VoteRecord():
                self._epochs_grow(world, robot, what)
                self._one_vote_an_epoch(world, robot, what)
            case NewDisk():
                self._forget(world, robot, what)
            case Beat():
                self._durable_before_said(world, robot, what)
            case acts.Capture():
                if what.component in world.robots[robot].capturing:
                    raise broken(world, f"{robot}: a second capture of {what.component} at once")
            case acts.Ship():
                self.shipped[what.component] = what.position
            case acts.Acknowledge():
                self._acknowledged(world, robot, what)
            case acts.Show():
                self._shown(world, robot, what)
            case acts.Stop():
                program = world.robots[robot].programs.get(what.component)
                if program is not None and program.exit_status is not None:
                    self.over.add((robot, what.component))
            case acts.Start():
                self._one_primary(world, robot, what)
                self._begins_anew_after_its_end(world, robot, what)
                self._nothing_is_held(world, robot, what)
                self._after_what_was_seen(world, robot, what, 0 if what.component in self.acknowledged else -1)
            case acts.Restore():
                self._one_primary(world, robot, what)
                self._silence_is_no_sound(world, robot, what)
                self._not_older(world, robot, what)
                self._after_what_was_seen(world, robot, what, world.values[what.position])
            case acts.Warm():
                if what.component in world.robots[robot].programs:
                    raise broken(world, f"{robot}: {what.component} is to wait where it runs")
            case acts.ReportExit():
                if what.acknowledged:
                    self.last.add(what.component)

    def _one_acts(self, world: World) -> None:
        copies = [name for robot in world.robots.values() for name in robot.programs]
        for component in {name for name in copies if copies.count(name) > 1}:
            where = [name for name in world.acting(component) if name != self.liar]
            if len(where) > 1:
                self.split.add(component)
                if component in self.safe:
                    raise broken(world, f"{component} acts at {' and '.join(where)} at once")

    def _nothing_waits_in_vain(self, world: World, component: str, standby: str) -> None:
        waiting = [name for name, robot in world.robots.items() if component in robot.warm]
        if waiting != ([standby] if standby else []):
            raise broken(world, f"{component} should wait at {standby or 'no robot'}: it waits at {waiting}")

    def _one_primary(self, world: World, robot: str, act: acts.Start | acts.Restore) -> None:
        others = [name for name in world.acting(act.component) if name not in (robot, self.liar)]
        if others and act.component in self.safe:
            raise broken(world, f"{robot} is to run {act.component} while the lease of {' and '.join(others)} is valid")
        owner = self.owners.setdefault((act.component, act.epoch), robot)
        if owner != robot and act.component in self.safe:
            raise broken(world, f"epoch {act.epoch} of {act.component} is {owner}'s and {robot}'s")

    def _silence_is_no_sound(self, world: World, robot: str, act: acts.Restore) -> None:
        """Under pair nothing is taken over beside a robot from which there comes what was never authenticated."""
        here = world.robots[robot]
        if self.votes or act.why is not Resumption.TAKEN_OVER:
            return
        for other, at_ns in here.unread_ns.items():
            if other not in here.read and world.now_ns - at_ns < SURELY_UNREAD_NS:
                raise broken(world, f"{robot} takes {act.component} over, and receives from {other} what it cannot authenticate")

    def _epochs_grow(self, world: World, robot: str, vote_record: VoteRecord) -> None:
        kept = {record.name: record.epoch for record in vote_record.records}
        for (name, component), epoch in self.epochs.items():
            if name == robot and kept.get(component, 0) < epoch:
                raise broken(world, f"{robot}: the epoch of {component} fell from {epoch} to {kept.get(component, 0)}")
        self.epochs.update({(robot, component): epoch for component, epoch in kept.items()})

    def _one_vote_an_epoch(self, world: World, robot: str, vote_record: VoteRecord) -> None:
        for record in vote_record.records:
            if not self.votes or not record.primary or record.state in ENDED:
                continue
            vote = (record.name, record.epoch, record.primary)
            before = self.given.setdefault((robot, *vote[:2]), record.primary)
            self._count(world, *vote)
            if before == robot and vote in self.elected:
                self.given[robot, *vote[:2]] = record.primary  # its own claim was in vain: it follows the one that was elected
            elif before != record.primary:
                story = f"{robot} votes for {before} and {record.primary} in epoch {record.epoch} of {record.name}"
                raise broken(world, story)
            self.cast.add((robot, *vote))
            self._count(world, *vote)

    def _count(self, world: World, component: str, epoch: int, primary: str) -> None:
        """Note a robot as elected once a majority of its own team, as that is now, has voted for it. Others have no vote."""
        team = world.robots[primary].config
        votes = sum((name, component, epoch, primary) in self.cast for name in (primary, *team.peers))
        if world.coordination is not None:
            votes += (component, epoch, primary) in world.coordination.etcd.votes
        if votes >= team.quorum:
            self.elected.add((component, epoch, primary))

    def _forget(self, world: World, robot: str, loss: NewDisk) -> None:
        self.gone.update(loss.lost)
        if loss.vote_record:
            self.forgetful.add(robot)
            if len(self.forgetful) >= world.robots[robot].config.quorum:
                self.owners.clear()  # a majority knows no vote of before: an epoch may be counted again
            self.epochs = {key: epoch for key, epoch in self.epochs.items() if key[0] != robot}
            self.given = {key: primary for key, primary in self.given.items() if key[0] != robot}

    def _durable_before_said(self, world: World, robot: str, beat: Beat) -> None:
        durable = {record.name: record.epoch for record in vote_record_of(world.robots[robot]).records}
        for entry in beat.entries:
            if entry.flags & ORDERED:
                self.ordered.add((entry.name, entry.epoch))
            if entry.epoch > durable.get(entry.name, 0):
                raise broken(world, f"{robot} says epoch {entry.epoch} of {entry.name} before its disk knows it")

    def _acknowledged(self, world: World, robot: str, act: acts.Acknowledge) -> None:
        elsewhere = any(
            act.position in other.store.get(act.component, []) for name, other in world.robots.items() if name != robot
        )
        elsewhere = elsewhere or act.position in self.gone
        is_told = act.is_safe and bool(world.robots[robot].config.peers)
        if not elsewhere and (is_told or self.shipped.get(act.component) == act.position):
            raise broken(world, f"{robot} acknowledges {act.position} of {act.component}, which no other robot holds")
        if elsewhere:
            before = self.acknowledged.get(act.component)
            self.acknowledged[act.component] = act.position if before is None else max(before, act.position)

    def _shown(self, world: World, robot: str, act: acts.Show) -> None:
        """Readers see what was written up to there: it is in the past of every later copy, and of every copy that there is."""
        if act.position not in world.robots[robot].store.get(act.component, []):
            raise broken(world, f"{robot} shows what {act.component} wrote up to {act.position}, which it does not hold")
        if act.position in self.former.get(act.component, ()):
            return
        epoch, value = epoch_of(act.position), world.values[act.position]
        for later, begin in self.begun.get(act.component, {}).items():
            if later > epoch and value > begin and act.component not in self.split:
                raise broken(world, f"{robot} shows {act.position} of {act.component}, which is not in the past of epoch {later}")
        seen = self.seen.setdefault(act.component, {})
        seen[epoch] = max(act.position, seen.get(epoch, act.position), key=world.values.__getitem__)

    def _after_what_was_seen(self, world: World, robot: str, act: acts.Start | acts.Restore, begin: int) -> None:
        """No copy begins before what readers have seen of earlier ones."""
        is_lost = (act.component, act.epoch) in self.ordered or act.component in self.split or begin < 0
        if is_lost:
            self.seen.pop(act.component, None)
            self.begun.pop(act.component, None)
            return
        seen = self.seen.get(act.component, {})
        for epoch, position in list(seen.items()):
            if epoch >= act.epoch or world.values[position] <= begin:
                continue
            if self._is_held(world, act.component, position):
                raise broken(world, f"{robot} begins {act.component} before {position}, of which readers have seen the output")
            del seen[epoch]  # it was lost with the disks
        self.begun.setdefault(act.component, {}).setdefault(act.epoch, begin)

    def _is_held(self, world: World, component: str, position: Position) -> bool:
        """Whether any disk still has as much as that."""
        values = [world.values[one] for other in world.robots.values() for one in other.store.get(component, [])]
        return max(values, default=-1) >= world.values[position]

    def _begins_anew_after_its_end(self, world: World, robot: str, act: acts.Start) -> None:
        """A declared program whose end the rules have taken in may begin anew: all before it is of another program."""
        if (robot, act.component) in self.over and act.spec.rules.restart is not Restart.UNDECLARED:
            kept = (one for other in world.robots.values() for one in other.store.get(act.component, []))
            self.former.setdefault(act.component, set()).update(kept)
            for facts in (self.acknowledged, self.seen, self.begun):
                facts.pop(act.component, None)
        self.over.discard((robot, act.component))

    def _nothing_is_held(self, world: World, robot: str, act: acts.Start) -> None:
        """A robot that begins anew loses no acknowledged state, but for state that was lost with its disks."""
        safe_from = self.acknowledged.get(act.component)
        if safe_from is None or (act.component, act.epoch) in self.ordered or act.component in self.split:
            return
        if self._is_held(world, act.component, safe_from):
            raise broken(world, f"{robot} begins {act.component} anew, of which {safe_from} was acknowledged")
        del self.acknowledged[act.component]

    def _not_older(self, world: World, robot: str, act: acts.Restore) -> None:
        if act.component in self.last:
            raise broken(world, f"{robot} runs {act.component} again, whose end was reported")
        if (act.component, act.epoch) in self.ordered:
            self.acknowledged.pop(act.component, None)
        safe_from = self.acknowledged.get(act.component)
        former = self.former.get(act.component, set())
        at_work = world.robots[robot].programs.get(act.component)
        if act.position in former and ((safe_from is not None and safe_from not in former) or at_work is not None):
            raise broken(world, f"{robot} resumes {act.component} from {act.position}, of a program that has ended")
        in_place = (
            any(
                record.name == act.component and record.state is State.PRIMARY and record.primary == robot
                for record in vote_record_of(world.robots[robot]).records
            )
            and (robot, act.component) in self.crashing
        )
        if safe_from is not None and not self._is_held(world, act.component, safe_from):
            del self.acknowledged[act.component]  # it was lost with the disks
            self.emptied.add(act.component)
            safe_from = None
        comparable = act.component not in self.split and not in_place
        if comparable and safe_from is not None and world.values[act.position] < world.values[safe_from]:
            raise broken(world, f"{robot} resumes {act.component} from {act.position}, older than the acknowledged {safe_from}")

    def ended_well(self, world: World) -> None:
        """After healing: each component that goes on acts at one robot, and the other protects it."""
        if self.liar:
            return
        for component in sorted({record.name for robot in world.robots.values() for record in vote_record_of(robot).records}):
            if component.startswith(INVENTED_NAME):
                continue  # there is none such
            states = {name: state_at(world, name, component) for name in world.robots}
            if any(state in (State.FINISHED, State.FAILED, State.RELEASED) for state in states.values()):
                known = {state for name, state in states.items() if not _has_a_copy_alone(world, name, component)}
                if len(known) > 1:
                    raise broken(world, f"{component} has ended for some only: {states}")
                self._nothing_waits_in_vain(world, component, "")
                continue
            self._lives_well(world, component, states)

    def _lives_well(self, world: World, component: str, states: dict[str, State]) -> None:
        primaries = [name for name, state in states.items() if state is State.PRIMARY]
        if len(primaries) != 1 or world.acting(component) != primaries:
            raise broken(world, f"{component} should act at one robot: {states}, acts at {world.acting(component)}")
        seen = seen_at(world, primaries[0], component)
        if seen.protection != "protected" or not 0 <= seen.lag_ns < 1_000_000_000:
            raise broken(
                world, f"{component} at {primaries[0]} is {seen.protection}, its checkpoint {seen.lag_ns / 1e6:.0f} ms old"
            )
        waits = _waits_at_a_standby(world, component)
        self._nothing_waits_in_vain(world, component, seen.standby if waits else "")
        if waits != seen.warm:
            raise broken(world, f"{primaries[0]} says of the standby of {component}: warm {seen.warm}")


def state_at(world: World, robot: str, component: str) -> State:
    """How the component stands at a robot, as that robot says."""
    return next((one.state for one in _views(world, robot) if one.name == component), State.ABSENT)


def _has_a_copy_alone(world: World, robot: str, component: str) -> bool:
    """Whether it has lost its checkpoints and its notes, and waits with a copy of the archive for a word of an operator."""
    node = world.robots[robot].node
    return node is not None and component in node._components and node._components[component].bare


def seen_at(world: World, robot: str, component: str) -> ComponentView:
    """All that a robot says of a component that it knows."""
    return next(one for one in _views(world, robot) if one.name == component)


def _waits_at_a_standby(world: World, component: str) -> bool:
    specs = (one.spec for robot in world.robots.values() for one in vote_record_of(robot).records if one.name == component)
    return any(spec is not None and spec.rules.on_loss is OnLoss.TAKEOVER for spec in specs)


def _views(world: World, robot: str) -> tuple[ComponentView, ...]:
    node = world.robots[robot].node
    assert node is not None, f"{robot} is down"
    return node.status(world.local(world.robots[robot])).components


def broken(world: World, sentence: str) -> Broken:
    """The sentence, and what happened before."""
    story = "\n".join(world.log[-60:])
    return Broken(f"{sentence}\n(at {world.now_ns / 1e6:.3f} ms; the story so far)\n{story}")


def safe_components(world: World) -> set[str]:
    """The configured components that must never act twice."""
    specs = (spec for robot in world.robots.values() for spec in robot.config.components)
    return {spec.name for spec in specs if spec.rules.when_alone is WhenAlone.FREEZE}
