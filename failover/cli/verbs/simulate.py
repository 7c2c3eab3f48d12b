"""simulate: robots that are not there, for programs that are."""

from __future__ import annotations

import argparse
import sys
from typing import Final

import msgspec

from failover.cli.ending import ended_by_signals
from failover.cli.output import render
from failover.errors import SimulationError
from failover.simulators.files import read
from failover.simulators.run import Simulation, Summary
from failover.simulators.world import parts
from failover.simulators.world.parts import GUESTS_MAX, LABS_MAX, World

PACE_MAX_NEEDS: Final = "--pace max runs without real time, so it needs --for: how many seconds of the world"


def simulate(arguments: argparse.Namespace) -> int:
    """Simulate until the time is over, or Ctrl-C. Exit status 1: a controller missed a deadline.

    Raises:
        SimulationError: it cannot begin, or not go on.
        FileMistakeError: the world file is missing or mistaken.
    """
    world = _world(arguments)
    if not arguments.pace and not arguments.span_s:
        raise SimulationError(PACE_MAX_NEEDS)
    with Simulation(world, arguments.pace, arguments.span_s or 0, arguments.board or "") as simulation:
        with ended_by_signals(simulation.stop):
            if not arguments.json:
                print(_begun(world, arguments), file=sys.stderr, flush=True)
            summary = simulation.run()
    if arguments.json:
        render.as_json(msgspec.to_builtins(summary))
    else:
        for line in _lines(summary):
            print(line, flush=True)
    return 1 if summary.missed else 0


def _world(arguments: argparse.Namespace) -> World:
    robots, labs = arguments.robots or 1, arguments.labs or 1
    if arguments.world:
        if arguments.robots or arguments.labs:
            raise SimulationError("--world says which robots and labs there are: leave out --robots and --labs")
        return read(arguments.world, arguments.seed)
    if robots > GUESTS_MAX or labs > LABS_MAX or labs > robots:
        raise SimulationError(
            f"{robots} robots in {labs} labs cannot be simulated: up to {GUESTS_MAX} robots in {LABS_MAX} labs are possible, "
            "and one robot at least in each lab"
        )
    return parts.usual(robots, labs, 1 if arguments.seed is None else arguments.seed)


def _begun(world: World, arguments: argparse.Namespace) -> str:
    """What a person sees first."""
    robots = f"{len(world.robots)} robot{'s' * (len(world.robots) > 1)} in {len(world.labs)} lab{'s' * (len(world.labs) > 1)}"
    if not arguments.pace:
        return f"{robots}, without real time"
    first = world.place_of(world.robots[0])
    return render.spoken(f"{robots}; the first is {first}; programs with FAILOVER_WORLD={world.prefix} find it; Ctrl-C ends")


def _lines(summary: Summary) -> list[str]:
    """The figures as text."""
    lines = [
        f"{summary.robots} robots, {summary.world_s:g} s of the world in {summary.seconds:g} s, {summary.processes} processes: "
        f"{summary.cores:.2f} cores, {summary.memory_mb:.0f} MB"
    ]
    if summary.late_ms is not None and summary.took_ms is not None:
        late, took = summary.late_ms, summary.took_ms
        lines += [
            f"{summary.activations:,} activations of controllers, {summary.missed:,} deadlines missed",
            f"began late by {late['p50']:.1f} ms (half), {late['p99']:.1f} ms (99 of 100), {late['max']:.1f} ms at most; "
            f"took {took['p50']:.1f}, {took['p99']:.1f}, {took['max']:.1f} ms",
        ]
    return [*lines, f"digest of all values {summary.digest} (seed {summary.seed})"]
