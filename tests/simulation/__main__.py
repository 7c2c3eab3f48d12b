"""``python -m tests.simulation``: play more seeds than the tests do, or longer lives, and stop at the first that breaks."""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

from tests.simulation import planned
from tests.simulation.chaos import life

FAULTS_A_LIFE = 150
"""Of a long life."""

RESTARTS_A_LIFE = 12
"""Of a life with planned restarts beside faults."""


def main() -> int:
    """Play the seeds; 1 if one broke, with its story."""
    arguments = _parser().parse_args()
    if arguments.restarts:
        return _play_restarts(arguments.restarts, arguments.first)
    lives = -(-arguments.faults // FAULTS_A_LIFE) or arguments.seeds
    each = FAULTS_A_LIFE if arguments.faults else 0
    began, broken, faults = time.monotonic(), 0, 0
    for seed, (happened, story) in _played(
        range(arguments.first, arguments.first + lives),
        each,
        arguments.jobs,
        liars=arguments.liars,
        etcd=arguments.etcd,
        apart=arguments.apart,
        archive=arguments.archive,
        failing=arguments.failing,
    ):
        faults += happened
        if story:
            broken += 1
            print(f"seed {seed}: {story if not arguments.keep_going else story.splitlines()[0]}", flush=True)
            if not arguments.keep_going:
                return 1
    print(f"{lives} seeds, {faults} faults in {time.monotonic() - began:.1f} s, {broken} broken")
    return 1 if broken else 0


def play(
    seed: int,
    faults: int,
    liars: bool = False,
    etcd: bool = False,
    apart: bool = False,
    archive: bool = False,
    failing: bool = False,
) -> tuple[int, str]:
    """One life: how many faults there were, and the story if it broke a promise."""
    try:
        lived = life(seed, faults=faults, liars=liars, etcd=etcd, apart=apart, archive=archive, failing=failing)
        return lived.faults, ""
    except AssertionError as story:
        return 0, str(story) or repr(story)


def _play_restarts(count: int, first: int) -> int:
    """Planned restarts, as many in lives of peace as in lives beside faults; 1 if one broke a promise."""
    began, calm, beside, promised = time.monotonic(), 0, 0, 0
    for seed in itertools.count(first):
        is_calm = calm <= beside
        try:
            world = planned.calm(seed) if is_calm else life(seed, restarts=RESTARTS_A_LIFE)
        except AssertionError as story:
            print(f"seed {seed}, {'in peace' if is_calm else 'beside faults'}: {story}")
            return 1
        calm, beside = calm + len(world.restarts) * is_calm, beside + len(world.restarts) * (not is_calm)
        promised += sum(waited_for for _, waited_for in world.restarts)
        if calm + beside >= count:
            break
    took_s = time.monotonic() - began
    print(f"{calm} restarts in peace: no move, no pause; {beside} beside faults; {promised} waited for; {took_s:.0f} s, 0 broken")
    return 0


def _played(
    seeds: range, faults: int, jobs: int, *, liars: bool, etcd: bool, apart: bool, archive: bool, failing: bool
) -> Iterator[tuple[int, tuple[int, str]]]:
    if jobs == 1:
        yield from ((seed, play(seed, faults, liars, etcd, apart, archive, failing)) for seed in seeds)
        return
    with ProcessPoolExecutor(jobs) as pool:
        fixed = (itertools.repeat(value) for value in (faults, liars, etcd, apart, archive, failing))
        yield from zip(seeds, pool.map(play, seeds, *fixed, chunksize=8), strict=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=1_000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument(
        "--faults", type=int, default=0, help=f"instead: long lives of {FAULTS_A_LIFE} faults, until there were as many"
    )
    parser.add_argument("--restarts", type=int, default=0, help="instead: lives with planned restarts, until there were as many")
    parser.add_argument("--liars", action="store_true", help="an attacker lies by the key of a member of a team that votes")
    parser.add_argument("--etcd", action="store_true", help="robots that decide by the rule etcd, and an etcd with faults")
    parser.add_argument("--apart", action="store_true", help="such robots that never hear each other, and an archive with faults")
    parser.add_argument("--archive", action="store_true", help="a team that votes, goes on from an archive, and loses its disks")
    parser.add_argument("--failing", action="store_true", help="beside these: restores fail, some of them several times in a row")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--keep-going", action="store_true", help="do not stop at the first that breaks")
    return parser


if __name__ == "__main__":
    sys.exit(main())
