"""Members whose key was stolen: honest rules, false messages. Each lie changes a heartbeat on its way to one peer."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from failover.core.election.consent import STATES
from failover.core.frames.frame import beat_size_max
from failover.core.types import COMPONENTS_MAX, EPOCH_MAX, State
from failover.core.wire.codec import beat_size
from failover.core.wire.messages import FREE, OPEN, ORDERED, STARTS, WANTS, Beat, Echo, Entry

if TYPE_CHECKING:
    from tests.simulation.world import World

Lie = Callable[["World", Beat, str], Beat]
"""(world, the honest beat, to whom) → what is sent instead."""

INVENTED: Final = 8
"""Names in one beat of a liar that invents components."""

INVENTED_NAME: Final = "/team/invented"
"""How they begin."""


def _of_each(change: Callable[[World, Beat, Entry, str], Entry]) -> Lie:
    def lie(world: World, beat: Beat, to: str) -> Beat:
        return replace(beat, entries=tuple(change(world, beat, entry, to) for entry in beat.entries))

    lie.__name__ = change.__name__
    return lie


def _says(state: State, entry: Entry, epoch: int, primary: str, flags: int = FREE | OPEN) -> Entry:
    return Entry(entry.name, STATES.index(state), epoch, primary, flags=flags)


def _highest(world: World, component: str) -> int:
    """The highest epoch that any robot has on its disk or in its head."""
    return max(_epoch_at(world, name, component) for name in world.robots)


def _epoch_at(world: World, robot: str, component: str) -> int:
    node = world.robots[robot].node
    known = node._components.get(component) if node is not None else None
    return known.epoch if known is not None else 0


def _robot(world: World, sender: str, index: int = 0) -> str:
    robots = [name for name, robot in world.robots.items() if robot.config.runs(name) and name != sender]
    return robots[index % len(robots)]


def _by_order(world: World, sender: str) -> int:
    """An operator's order is behind it, says a member that runs nothing; a robot may give orders, and its claim needs none."""
    return FREE | OPEN if world.robots[sender].config.runs(sender) else ORDERED


@_of_each
def finishes(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It is finished, one epoch above, at the robot that runs it."""
    return _says(State.FINISHED, entry, _highest(world, entry.name) + 1, entry.primary)


@_of_each
def finished_now(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It is finished, in the epoch in which it runs."""
    return _says(State.FINISHED, entry, _highest(world, entry.name), entry.primary)


@_of_each
def finished_here(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """The liar itself has run it to its end."""
    return _says(State.FINISHED, entry, _highest(world, entry.name) + 1, beat.sender)


@_of_each
def finished_elsewhere(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """Another robot has run it to its end."""
    return _says(State.FINISHED, entry, _highest(world, entry.name) + 1, _robot(world, beat.sender, 1))


@_of_each
def fails(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It has failed."""
    return _says(State.FAILED, entry, _highest(world, entry.name) + 1, entry.primary)


@_of_each
def releases(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """An operator has released it."""
    return _says(State.RELEASED, entry, _highest(world, entry.name) + 1, beat.sender)


@_of_each
def runs(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """The liar runs it, one epoch above."""
    return _says(State.PRIMARY, entry, _highest(world, entry.name) + 1, beat.sender, _by_order(world, beat.sender))


@_of_each
def claims(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """The liar claims it, one epoch above."""
    return _says(State.CLAIMING, entry, _highest(world, entry.name) + 1, beat.sender, _by_order(world, beat.sender))


@_of_each
def huge_epoch(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """The last epoch that a beat can carry."""
    return _says(State.STANDBY, entry, EPOCH_MAX - 1, entry.primary)


@_of_each
def huge_claim(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """The liar claims the last epoch that a beat can carry."""
    return _says(State.CLAIMING, entry, EPOCH_MAX - 1, beat.sender, _by_order(world, beat.sender))


@_of_each
def huge_end(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It is finished, in an epoch that nobody can have opened."""
    return _says(State.FINISHED, entry, 1 << 35, entry.primary)


@_of_each
def climbs(world: World, beat: Beat, entry: Entry, to: str) -> Entry:
    """The robot that does not run it has opened one epoch above, in each beat."""
    return _says(State.STANDBY, entry, _highest(world, entry.name) + 1, _robot(world, beat.sender, 1))


@_of_each
def votes_above(world: World, beat: Beat, entry: Entry, to: str) -> Entry:
    """The robot that hears it has opened one epoch above, in each beat."""
    return _says(State.STANDBY, entry, _highest(world, entry.name) + 1, to)


@_of_each
def votes_twice(world: World, beat: Beat, entry: Entry, to: str) -> Entry:
    """It votes for whoever hears it."""
    return _says(State.STANDBY, entry, _epoch_at(world, to, entry.name), to)


@_of_each
def keeps(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It keeps a checkpoint newer than any that there is."""
    return replace(entry, generation=entry.epoch * 64 + 63, sequence=1 << 40, digest=b"forged")


@_of_each
def keeps_from_the_future(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It keeps a checkpoint of an epoch that nobody can have opened."""
    return replace(entry, generation=(1 << 39) * 64, sequence=1, digest=b"forged")


@_of_each
def orders(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """An operator wants the liar to run it, and it would start it anew."""
    return replace(entry, flags=entry.flags | WANTS | ORDERED | STARTS)


@_of_each
def denies(world: World, beat: Beat, entry: Entry, _: str) -> Entry:
    """It has never voted for anybody."""
    return _says(State.STANDBY, entry, 0, "", 0)


def silent(world: World, beat: Beat, to: str) -> Beat:
    """It has more to tell than it ever tells."""
    return replace(beat, total=COMPONENTS_MAX, settled=beat.counter, entries=())


def deaf(world: World, beat: Beat, to: str) -> Beat:
    """It hears nobody."""
    return replace(beat, echoes=())


def echoes_ahead(world: World, beat: Beat, to: str) -> Beat:
    """It has heard what was not said yet."""
    return replace(beat, echoes=tuple(Echo(one.robot, one.boot, 1 << 40) for one in beat.echoes))


def invents(world: World, beat: Beat, to: str) -> Beat:
    """There are components of which nobody has ever heard."""
    names = (f"{INVENTED_NAME}{beat.counter * INVENTED + number}" for number in range(INVENTED))
    entries = tuple(Entry(name, STATES.index(State.STANDBY), 1, _robot(world, beat.sender)) for name in names)
    return replace(beat, total=len(entries), entries=entries)


def others_name(world: World, beat: Beat, to: str) -> Beat:
    """The liar is the robot that runs it, and has finished it."""
    return replace(finishes(world, beat, to), sender=_robot(world, beat.sender))


def fitting(beat: Beat, members: int) -> Beat:
    """As much of it as a frame holds: a longer one nobody reads."""
    while beat.entries and beat_size(beat) > beat_size_max(members):
        beat = replace(beat, entries=beat.entries[:-1])
    return beat


def by_name(name: str) -> Lie:
    """Of a scenario."""
    lie: Lie = globals()[name.replace("-", "_")]
    return lie


LIES: Final[tuple[Lie, ...]] = (
    finishes,
    finished_now,
    finished_here,
    finished_elsewhere,
    fails,
    releases,
    runs,
    claims,
    huge_epoch,
    huge_claim,
    huge_end,
    climbs,
    votes_above,
    keeps,
    keeps_from_the_future,
    orders,
    denies,
    silent,
    deaf,
    invents,
    others_name,
)
"""Whatever else goes wrong meanwhile, these cost a member's vote, or a server's checkpoints, and nothing else."""

ROBOTS_LIES: Final = tuple(lie for lie in LIES if lie is not orders)
"""Of a robot in a team that votes; it may give orders."""

FALSE_GRANTS: Final[tuple[Lie, ...]] = (votes_twice, echoes_ahead)
"""Together with a robot that is cut off, or stands still and comes back, these can have a component run twice."""
