"""A paper fleet: how bytes, processor time and stores grow from 2 robots to 1,000, and where a team ends.

A robot sends heartbeats to each other member of its team, and none to members of other teams: what grows with a team ends with
it, and a fleet is teams side by side. Heartbeats and takeovers are those of the agents' own rules and frames in virtual time;
names are those of the drivers' own rules; processor time, memory and stores are measured on real agents on this machine.

Larger teams than were measured are computed: frames by their number, which the team's size gives, and what a frame takes by a
straight line through the measured teams, as a frame tells of every member. Such values are marked.
"""

from __future__ import annotations

import contextlib
import itertools
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from benchmarks.costs import parts_of, pss_mb, used_s
from benchmarks.figures import OURS, Figure, Findings
from benchmarks.interference import NO_COPY
from benchmarks.main_loop import TeamStage, until
from benchmarks.running import PROGRAMS, BenchmarkError
from failover.cli.demo.robots import Pace, RobotMachine
from failover.config.team import ROBOT_LIMIT
from failover.core.types import MS, ComponentSpec, Config, Launch, Rules
from tests.failover.core.naming.town import Town
from tests.simulation.invariants import seen_at
from tests.simulation.robots import Robot
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

TEAMS: Final = (2, 4, 8, 12, 16)
QUICK_TEAMS: Final = (2, 4, 6)
COMPUTED: Final = (16, 32, 64)
REAL_TEAMS: Final = (2, 4, 8)
QUICK_REAL_TEAMS: Final = (2, 4)
FLEETS: Final = (10, 100, 1_000)

BEAT_MS: Final = 20
LEASE_MS: Final = 200
"""As agents have them where no file says otherwise."""

HEADERS: Final = 42
"""Bytes of Ethernet, IPv4 and UDP around a frame."""

STEP_MS: Final = 100
SNAPSHOTS_MS: Final = 400
"""Until a standby has some."""

WATCH_MS: Final = 500
DEATHS: Final = 5
SETTLE_MS_MAX: Final = 10_000

NAMES: Final = 50
NAMES_SETTLE_S: Final = 60.0
NAMES_WATCH_S: Final = 100.0

PROGRAM: Final = "small"
RESIDENT_MB: Final = 16
DIRTY_KB: Final = 100
SNAPSHOT_MS: Final = 500
SPAN_S: Final = 30.0
QUICK_SPAN_S: Final = 8.0
PATIENCE_S: Final = 300.0

LINE: Final = "computed"


def fleet(quick: bool, directory: Path) -> Findings:
    """Teams in virtual time, real teams on this machine, and what follows for fleets of such teams."""
    sizes = QUICK_TEAMS if quick else TEAMS
    settled = {size: _settled(size, 1) for size in sizes}
    sent_kb = {size: _sent_kb(world) for size, world in settled.items()}
    all_kb = sent_kb | {size: _by_frames(sent_kb, size) for size in COMPUTED if size not in sent_kb}
    figures = [
        *_figures("sent by a robot: heartbeats", "kB/s", {size: (kb,) for size, kb in sent_kb.items()}),
        *(Figure(f"sent by a robot: {NAMES} names", _case(size), "kB/s", (_names_kb(size),)) for size in sizes),
        *(
            Figure("from a robot's loss to its program elsewhere", _case(size), "ms", _takeovers_ms(size, quick))
            for size in sizes
        ),
    ]
    real = {
        size: _real(size, QUICK_SPAN_S if quick else SPAN_S, directory) for size in (QUICK_REAL_TEAMS if quick else REAL_TEAMS)
    }
    figures += _figures("processor time of a main loop", "% of a core", {size: one.loop for size, one in real.items()})
    for name, unit, of_all in (
        ("processor time of a robot's other processes", "% of a core", {size: one.others for size, one in real.items()}),
        ("memory of a main loop", "MB", {size: one.memory_mb for size, one in real.items()}),
        ("checkpoints on a robot's disk", "MB", {size: one.disk_mb for size, one in real.items()}),
    ):
        figures += [Figure(name, _case(size), unit, tuple(values)) for size, values in of_all.items()]
    for count in FLEETS:
        for size, kb in all_kb.items():
            if size <= count:
                case = f"{count:,} robots in teams of {size}"
                figures.append(
                    Figure("heartbeats of a fleet", case, "MB/s", (count * kb / 1_000,), OURS if size in sent_kb else LINE)
                )
    return Findings(
        "A paper fleet",
        f"One component a robot: {RESIDENT_MB} MB, of which it writes {DIRTY_KB} KB each 50 ms. In virtual time: heartbeats each "
        f"{BEAT_MS} ms, with headers of {HEADERS} bytes; a lease of {LEASE_MS} ms; a network of 1 to 2 ms. Real: agents on the "
        f"loopback of this machine, snapshots each {SNAPSHOT_MS} ms, without a ready copy. {LINE.capitalize()}: larger teams, by "
        f"what a frame takes in the measured ones. A team has {ROBOT_LIMIT} members at most; teams share nothing.",
        tuple(figures),
    )


def _figures(name: str, unit: str, values: dict[int, Sequence[float]]) -> list[Figure]:
    """Of the measured teams, and of larger ones."""
    medians = {size: statistics.median(of_team) for size, of_team in values.items()}
    return [
        *(Figure(name, _case(size), unit, tuple(of_team)) for size, of_team in values.items()),
        *(Figure(name, _case(size), unit, (_by_frames(medians, size),), LINE) for size in COMPUTED if size not in values),
    ]


def _by_frames(values: dict[int, float], size: int) -> float:
    """Of a larger team: what a frame takes follows a straight line over the team's size.

    Where a frame took less in larger teams, as the processor's time does that several frames share a wake-up, it takes in all
    larger ones what it took in the largest that was measured.
    """
    a_frame = {measured: value / (measured - 1) for measured, value in values.items()}
    slope, start = statistics.linear_regression(list(a_frame), list(a_frame.values()))
    each = start + slope * size if slope > 0 else a_frame[max(a_frame)]
    return each * (size - 1)


def _case(size: int) -> str:
    return f"a team of {size}"


# --- In virtual time --------------------------------------------------------------------------------------------------


class CountedWorld(World):
    """Counts what robots send."""

    def __init__(self, seed: int, configs: list[Config]) -> None:
        super().__init__(seed, configs)
        self.size = 0

    def transmit(self, sender: str, to: Robot, frame: bytes) -> None:
        self.size += len(frame) + HEADERS
        super().transmit(sender, to, frame)


def _configs(size: int) -> list[Config]:
    names = tuple(f"robot{number}" for number in range(1, size + 1))
    parts = tuple(ComponentSpec(f"/team/{name}", launch=Launch(("part",)), rules=Rules(prefer=name)) for name in names)
    team = pair(parts, names) if size == 2 else elective(size, parts)
    return [replace(one, beat_ms=BEAT_MS, lease_ms=LEASE_MS) for one in team]


def _settled(size: int, seed: int) -> CountedWorld:
    """Each component computes at a robot, and has a standby."""
    configs = _configs(size)
    world = CountedWorld(seed, configs)
    for name in world.robots:
        world.power_on(name)
    _run_until(world, lambda: all(world.acting(spec.name) and _standby(world, spec.name) for spec in configs[0].components))
    world.run(world.now_ns + SNAPSHOTS_MS * MS)
    return world


def _standby(world: World, component: str) -> str | None:
    return seen_at(world, world.acting(component)[0], component).standby


def _run_until(world: World, holds: Callable[[], bool], step_ms: int = STEP_MS) -> None:
    end_ns = world.now_ns + SETTLE_MS_MAX * MS
    while not holds():
        if world.now_ns > end_ns:
            raise BenchmarkError(f"{len(world.robots)} simulated robots did not come so far in {SETTLE_MS_MAX} ms")
        world.run(world.now_ns + step_ms * MS)


def _sent_kb(world: CountedWorld) -> float:
    """A second, by one robot."""
    world.size = 0
    world.run(world.now_ns + WATCH_MS * MS)
    return world.size / len(world.robots) / WATCH_MS


def _takeovers_ms(size: int, quick: bool) -> tuple[float, ...]:
    """From the loss of a robot's power until its component computes at another one."""
    found = []
    for seed in range(1, 2 if quick or size > 8 else DEATHS + 1):
        world = _settled(size, seed)
        component = world.robots["robot1"].config.components[0].name
        world.power_off(world.acting(component)[0])
        lost_ns = world.now_ns
        _run_until(world, lambda: bool(world.acting(component)), 1)  # noqa: B023  called at once
        found.append((world.now_ns - lost_ns) / MS)
    return tuple(found)


def _names_kb(size: int) -> float:
    names = [f"robot{number}" for number in range(1, size + 1)]
    town = Town(1, names, names=NAMES)
    town.run(NAMES_SETTLE_S)
    town.sent.clear()
    town.run(NAMES_WATCH_S)
    return sum(town.sent.values()) / size / NAMES_WATCH_S / 1_000


# --- Real agents ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Real:
    """Of each robot of a team: shares of a core in percent, memory of the main loop, checkpoints on the disk."""

    loop: list[float]
    others: list[float]
    memory_mb: list[float]
    disk_mb: list[float]


def _real(size: int, span_s: float, directory: Path) -> Real:
    place = directory / f"team-{size}"
    argv = ["/usr/bin/python3", str(PROGRAMS / "resident.py"), str(RESIDENT_MB), str(DIRTY_KB)]
    with TeamStage(place, size, "", f"snapshot_period_ms = {SNAPSHOT_MS}\n{NO_COPY}", Pace(BEAT_MS, LEASE_MS)) as stage:
        place.mkdir()
        stage.start()
        for robot in stage.robots:
            with robot.control() as link:
                link.ask("run", argv=argv, name=PROGRAM, cwd="/", wait=False)
        for robot in stage.robots:
            until(lambda robot=robot: _is_protected(robot), f"{robot.name} to protect its program", PATIENCE_S)
        before, began = [_used_s(robot) for robot in stage.robots], time.monotonic()
        time.sleep(span_s)
        after, took_s = [_used_s(robot) for robot in stage.robots], time.monotonic() - began
        percent = [
            {process: (s - earlier.get(process, 0)) / took_s * 100 for process, s in later.items()}
            for earlier, later in zip(before, after, strict=True)
        ]
        loops = [parts_of(robot)["main loop"] for robot in stage.robots]
        return Real(
            [sum(one[pid] for pid in loop) for one, loop in zip(percent, loops, strict=True)],
            [sum(one.values()) - sum(one[pid] for pid in loop) for one, loop in zip(percent, loops, strict=True)],
            [sum(map(pss_mb, loop)) for loop in loops],
            [_disk_mb(robot.directory / "state") for robot in stage.robots],
        )


def _used_s(robot: RobotMachine) -> dict[int, float]:
    """Of each process of the agent; some come and go."""
    found = {}
    for pid in itertools.chain(*parts_of(robot).values()):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            found[pid] = used_s(pid)
    return found


def _is_protected(robot: RobotMachine) -> bool:
    own = [one for one in robot.status()["components"] if one["name"].endswith(f"/{robot.name}/{PROGRAM}")]
    return any(one["protection"] == "protected" and one["snapshots"] for one in own)


def _disk_mb(directory: Path) -> float:
    return sum(path.lstat().st_blocks for path in directory.rglob("*")) * 512 / 1e6
