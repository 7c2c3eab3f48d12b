"""Lives of a team, from seeds: no fault in any of them breaks a promise."""

from __future__ import annotations

import os

import pytest

from failover.core.types import Restart
from tests.simulation import planned
from tests.simulation.__main__ import FAULTS_A_LIFE, RESTARTS_A_LIFE, play
from tests.simulation.chaos import TEAMS, life
from tests.simulation.invariants import Broken, Invariants
from tests.simulation.mutants import (
    APART_MUTANTS,
    ARCHIVE_MUTANTS,
    AS_THE_SEED_SAYS,
    CAUGHT_BY,
    ELECTIVE_MUTANTS,
    ETCD_MUTANTS,
    FAILING_MUTANTS,
    MUTANTS,
    Mutant,
    mistaken,
)
from tests.simulation.world import World

SEEDS = int(os.environ.get("FAILOVER_SEEDS", "100"))
APART_SHARE = 3
BLOCK = 50
"""Seeds a test, so that a failure names a narrow range and the story names the seed."""

RESTARTING = SEEDS // 8
RESTARTING_AGENTS, RESTARTING_BLOCK = SEEDS // 50, 4
SEEDS_TO_CATCH = 650
LONG_LIVES_TO_CATCH = 60
ONCE_BROKEN = (98, 161, 368)
"""A robot whose store was lost after a claim in vain began a program anew, of which another one that was just away had all."""

APART_ONCE_BROKEN = (330, 436, 821, 1342)
"""What had ended ran again; a standby with a new disk, and a robot that hears, or heard, one with more, resumed an older copy."""

ARCHIVE_ONCE_BROKEN = (99, 359, 607, 651)
"""What was acknowledged was lost to an older copy, after a restart and beside a server; what had ended ran again; none acted."""

ETCD_ONCE_BROKEN = (590, 1061, 1565, 2859, 1792, 3257)
"""An end came beside a claim; a robot with a new disk and an older copy of the archive counted as one that holds all that was
acknowledged: its standby, or, heard of after that copy had come, its primary (2859); a voter that learned that a component runs
anew left what had ended there; an operator's handover came before the look into the archive."""

FAILING_KINDS = ("", "etcd", "archive", "apart")

PAIR = TEAMS[0]
VOTERS = tuple(team for team in TEAMS if team != PAIR)


@pytest.mark.parametrize("first", range(0, SEEDS, BLOCK))
def test_every_promise_holds_whatever_goes_wrong(first: int) -> None:
    for seed in range(first, first + BLOCK):
        try:
            life(seed)
        except Broken as story:
            raise Broken(f"seed {seed} (again: python -m tests.simulation --first {seed} --seeds 1): {story}") from None


@pytest.mark.parametrize("first", range(0, SEEDS, BLOCK))
def test_every_promise_holds_whatever_goes_wrong_with_etcd(first: int) -> None:
    for seed in range(first, first + BLOCK):
        try:
            life(seed, etcd=True)
        except Broken as story:
            raise Broken(f"seed {seed} (again: python -m tests.simulation --etcd --first {seed} --seeds 1): {story}") from None


@pytest.mark.parametrize("seed", ETCD_ONCE_BROKEN)
def test_a_life_with_etcd_in_which_a_promise_was_once_broken_keeps_them_now(seed: int) -> None:
    life(seed, etcd=True)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("mutant", "first"), ETCD_MUTANTS, ids=lambda one: getattr(one, "__name__", ""))
def test_a_mistake_in_the_rule_of_etcd_is_caught_by_some_seed(mutant: Mutant, first: int) -> None:
    with mistaken(mutant):
        for seed in sorted(range(SEEDS_TO_CATCH), key=lambda seed: (seed != first, seed)):
            try:
                life(seed, etcd=True)
            except AssertionError:
                return
    pytest.fail(f"{SEEDS_TO_CATCH} seeds found nothing wrong with: {mutant.__doc__}")


@pytest.mark.parametrize("first", range(0, SEEDS // APART_SHARE, BLOCK))
def test_every_promise_holds_where_robots_share_only_etcd_and_an_archive(first: int) -> None:
    for seed in range(first, first + BLOCK):
        try:
            life(seed, apart=True)
        except Broken as story:
            raise Broken(f"seed {seed} (again: python -m tests.simulation --apart --first {seed} --seeds 1): {story}") from None


@pytest.mark.parametrize("seed", APART_ONCE_BROKEN)
def test_a_life_with_an_archive_that_broke_a_promise_once_keeps_it_now(seed: int) -> None:
    life(seed, apart=True)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("mutant", "first"), APART_MUTANTS, ids=lambda one: getattr(one, "__name__", ""))
def test_a_takeover_from_an_older_copy_than_the_archive_had_is_caught_by_some_seed(mutant: Mutant, first: int) -> None:
    with mistaken(mutant):
        for seed in sorted(range(SEEDS_TO_CATCH), key=lambda seed: (seed != first, seed)):
            _, story = play(seed, 0, apart=True)
            if "when etcd would vote for it" in story:
                return
    pytest.fail(f"{SEEDS_TO_CATCH} seeds found nothing wrong with: {mutant.__doc__}")


@pytest.mark.parametrize("first", range(0, SEEDS // APART_SHARE, BLOCK))
def test_every_promise_holds_where_voters_go_on_from_an_archive_after_their_disks_are_lost(first: int) -> None:
    emptied = 0
    for seed in range(first, first + BLOCK):
        try:
            emptied += len(invariants_of(life(seed, archive=True)).emptied)
        except Broken as story:
            raise Broken(f"seed {seed} (again: python -m tests.simulation --archive --first {seed} --seeds 1): {story}") from None
    assert emptied, "in no life did a component go on from a copy in the archive"


@pytest.mark.parametrize("seed", ARCHIVE_ONCE_BROKEN)
def test_a_life_of_voters_with_an_archive_that_broke_a_promise_once_keeps_it_now(seed: int) -> None:
    life(seed, archive=True)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("mutant", "first"), ARCHIVE_MUTANTS, ids=lambda one: getattr(one, "__name__", ""))
def test_a_mistake_about_a_copy_of_the_archive_is_caught_by_some_seed(mutant: Mutant, first: int) -> None:
    with mistaken(mutant):
        for seed in sorted(range(SEEDS_TO_CATCH), key=lambda seed: (seed != first, seed)):
            if play(seed, 0, archive=True)[1]:
                return
    pytest.fail(f"{SEEDS_TO_CATCH} seeds found nothing wrong with: {mutant.__doc__}")


@pytest.mark.parametrize("kind", FAILING_KINDS)
def test_every_promise_holds_where_restores_fail(kind: str) -> None:
    for seed in range(SEEDS // len(FAILING_KINDS)):
        _, story = play(seed, 0, failing=True, **({kind: True} if kind else {}))
        again = f"python -m tests.simulation --failing {f'--{kind} ' if kind else ''}--first {seed} --seeds 1"
        assert not story, f"seed {seed} (again: {again}): {story}"


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("mutant", "first"), FAILING_MUTANTS, ids=lambda one: getattr(one, "__name__", ""))
def test_a_mistake_about_what_could_not_be_resumed_is_caught_by_some_seed(mutant: Mutant, first: int) -> None:
    with mistaken(mutant):
        for seed in sorted(range(SEEDS_TO_CATCH), key=lambda seed: (seed != first, seed)):
            if play(seed, 0, failing=True)[1]:
                return
    pytest.fail(f"{SEEDS_TO_CATCH} seeds found nothing wrong with: {mutant.__doc__}")


@pytest.mark.parametrize("seed", ONCE_BROKEN)
def test_a_long_life_that_broke_a_promise_once_keeps_it_now(seed: int) -> None:
    life(seed, faults=FAULTS_A_LIFE)


@pytest.mark.parametrize("restart", [Restart.ALWAYS, Restart.ON_FAILURE], ids=str)
def test_every_promise_holds_where_programs_are_started_anew_after_their_ends(restart: Restart) -> None:
    for seed in range(RESTARTING):
        try:
            life(seed, restart=restart)
        except Broken as story:
            raise Broken(f"seed {seed}: {story}") from None


@pytest.mark.parametrize("first", range(0, RESTARTING_AGENTS, RESTARTING_BLOCK))
def test_agents_restart_as_planned_in_peace_unnoticed_and_beside_all_other_faults(first: int) -> None:
    for seed in range(first, first + RESTARTING_BLOCK):
        try:
            planned.calm(seed) if seed == first else life(seed, restarts=RESTARTS_A_LIFE)
        except Broken as story:
            raise Broken(f"seed {seed}: {story}") from None


@pytest.mark.timeout(900)
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.__name__)
def test_a_mistake_in_the_rules_of_a_pair_is_caught_by_some_seed(mutant: Mutant) -> None:
    _catch(mutant, (PAIR,))


@pytest.mark.sampled(2)
@pytest.mark.timeout(900)
@pytest.mark.parametrize("mutant", ELECTIVE_MUTANTS, ids=lambda mutant: mutant.__name__)
def test_a_mistake_in_the_rules_of_voters_is_caught_by_some_seed(mutant: Mutant) -> None:
    _catch(mutant, VOTERS)


def _catch(mutant: Mutant, teams: tuple[tuple[int, int, int], ...]) -> None:
    faults, first = CAUGHT_BY.get((mutant.__name__, teams == (PAIR,)), (AS_THE_SEED_SAYS, 0))
    seeds = LONG_LIVES_TO_CATCH if faults else SEEDS_TO_CATCH
    with mistaken(mutant):
        for seed in sorted(range(seeds), key=lambda seed: (seed != first, seed)):
            try:
                life(seed, team=teams[seed % len(teams)], faults=faults)
            except AssertionError:
                return
    pytest.fail(f"{seeds} seeds found nothing wrong with: {mutant.__doc__}")


def invariants_of(world: World) -> Invariants:
    """What watched it."""
    return next(watcher for watcher in world._watchers if isinstance(watcher, Invariants))


def test_a_seed_tells_the_same_story_twice() -> None:
    assert life(7).log == life(7).log
