"""Where the time goes between a power cut and the next output at the other robot, with beats every 10 ms."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks import keepalived
from benchmarks.figures import Absent, Figure, Findings
from benchmarks.running import BenchmarkError
from failover.cli.demo.robots import Pace, RobotMachine, Stage, means
from failover.errors import FailoverError

BEAT_MS: Final = 10
LEASE_MS: Final = 40
"""Four beats, the least that the rules allow."""

WHOLE: Final = "power cut to next output"
OTHERS_CUTS: Final = 20
"""Of keepalived."""

NAME: Final = "count"
COMPONENT: Final = "/demo/robot1/count"
CHAIN_ALONE: Final = f'[components."{COMPONENT}"]\nready_copy = false\n'
COUNTING: Final = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
"""Prints every 10 ms."""

SNAPSHOTS: Final = 15
PATIENCE_S: Final = 60.0
IN_FLIGHT_S: Final = 0.02
"""A snapshot that was on its way at the cut may still lengthen the standby's log so much later."""

POLL_S: Final = 0.0005
STAGE: Final = re.compile(r"(.+?) (\d+(?:\.\d+)?) ms(?:[,;] |$)")
"""One stage of a takeover, as the standby tells it."""

ACTS_AGAIN: Final = "it acts again"
DEAD: Final = "it counts as dead"
"""As the standby tells them."""

EARLY: Final = "taken over before its power was cut"
EARLY_SHARE: Final = 0.2
"""Of the cuts: with more, this machine stands still too often for such a lease, and a figure would mean nothing."""

PHASES: Final = ("until it counts as dead", "decision, vote record and order", "from the order to its output")


@dataclass(frozen=True, slots=True)
class Case:
    """One way of taking over.

    Attributes:
        settings: lines added to both robots' configurations.
        cuts, quick_cuts: how often the power is cut.
    """

    name: str
    settings: str
    ready: bool
    cuts: int
    quick_cuts: int


CASES: Final = (Case("with a ready copy", "", True, 100, 3), Case("from the checkpoints alone", CHAIN_ALONE, False, 20, 2))


@dataclass(frozen=True, slots=True)
class Cut:
    """One takeover, in milliseconds: the whole, its phases as in `PHASES`, and the stages of its resume by name."""

    whole: float
    phases: tuple[float, ...]
    stages: Mapping[str, float]


def cuts(quick: bool, directory: Path) -> Findings:
    """Cut a robot's power again and again; where the time goes, by the standby's own story."""
    figures: list[Figure] = []
    for case in CASES:
        found, early = _cuts(case, case.quick_cuts if quick else case.cuts, directory)
        figures += [*_figures(case.name, found), Figure(EARLY, case.name, "", (float(early),))]
    absent = _beside(quick, directory / "keepalived", figures)
    return Findings(
        "From a power cut to the next output",
        f"Two robots on this machine, in namespaces of their own where root allows; beats each {BEAT_MS} ms, a lease of "
        f"{LEASE_MS} ms. Every process of the primary stands still from one instant on, and is killed once its program has "
        "gone on. The program prints each 10 ms; the phases are read off the standby's story (`failover why`), and the stages of "
        "its resume below them; the last one ends after its first output. keepalived, with adverts as often as our beats, brings "
        "an address to the other machine; the program that answers there must run already, and knows nothing. A primary that "
        "stood still for longer than its lease before the cut, as its machine may have, was taken over already: it is counted, "
        "and cut no more.",
        tuple(figures),
        absent,
    )


def _beside(quick: bool, directory: Path, figures: list[Figure]) -> tuple[Absent, ...]:
    """What moves an address alone, put in after ours; or why it was not measured."""
    if why := keepalived.why_absent():
        return (Absent(keepalived.WHO, why),)
    ours = CASES[0]
    values = keepalived.outages(ours.quick_cuts if quick else OTHERS_CUTS, directory)
    figures.insert(1, Figure(WHOLE, ours.name, "ms", values, keepalived.WHO))
    return ()


def _figures(case: str, found: list[Cut]) -> list[Figure]:
    """The whole, its phases, and those stages that every cut had."""
    figures = [Figure(WHOLE, case, "ms", tuple(one.whole for one in found))]
    for number, phase in enumerate(PHASES):
        figures.append(Figure(f"… {phase}", case, "ms", tuple(one.phases[number] for one in found)))
    stages = [stage for stage in found[0].stages if all(stage in one.stages for one in found)]
    figures += [Figure(f"… … {stage}", case, "ms", tuple(one.stages[stage] for one in found)) for stage in stages]
    return figures


def _cuts(case: Case, count: int, directory: Path) -> tuple[list[Cut], int]:
    """So many cuts; and how many robots were taken over before theirs.

    Raises:
        BenchmarkError: these were too many.
    """
    found: list[Cut] = []
    early = 0
    while len(found) < count:
        one = _cut(case, directory / f"cut-{case.ready:d}-{len(found) + early}")
        if one is not None:
            found.append(one)
            continue
        early += 1
        if early > count * EARLY_SHARE + 1:
            raise BenchmarkError(f"{case.name}: of {len(found) + early} robots, {early} were {EARLY}: this machine is too busy")
    return found, early


def _cut(case: Case, directory: Path) -> Cut | None:
    """One pair of robots, one program, one cut; None: it was taken over before."""
    with Stage(directory, means(), case.settings, pace=Pace(BEAT_MS, LEASE_MS)) as stage:
        stage.directory.mkdir()
        stage.start()
        primary, standby = stage.robots
        with primary.control() as link:
            argv = [sys.executable, "-S", "-c", COUNTING]
            link.ask("run", argv=argv, name=NAME, cwd="/", wait=False, engine="ptrace")
        if not _is_protected(standby, case):
            return None
        log = next((standby.directory / "state" / "logs").glob("*/stdout.log"))
        cut = time.time()
        primary.freeze()
        output = _next_output(log, cut, standby)
        story = _story(standby)
        primary.end()
        return None if _acts_again(story, until=cut) else told(story, cut, output)


def _story(standby: RobotMachine) -> list[dict[str, Any]]:
    """What the standby tells, once it tells that the program goes on: that may come after its output."""
    deadline = time.monotonic() + PATIENCE_S
    with standby.control() as link:
        while True:
            story: list[dict[str, Any]] = link.ask("why", name=COMPONENT, robot=standby.name)["story"]
            if _acts_again(story) or time.monotonic() > deadline:
                return story
            time.sleep(0.02)


def _acts_again(story: Iterable[Mapping[str, Any]], until: float = math.inf) -> bool:
    """Whether the program went on before that instant."""
    return any(str(line["did"]).startswith(ACTS_AGAIN) and float(line["at"]) < until for line in story)


def _is_protected(standby: RobotMachine, case: Case) -> bool:
    """Wait until it is; False: the standby has taken it over instead."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        for one in standby.status()["components"]:
            if one["role"] == "primary":
                return False
            is_ready = bool((one.get("ready_copy") or {}).get("ready"))
            if (one["snapshots"] or 0) >= SNAPSHOTS and is_ready == case.ready:
                return True
        time.sleep(0.02)
    raise BenchmarkError(f"{case.name}: {standby.name} did not get {SNAPSHOTS} snapshots: {standby.last_words()}")


def _next_output(log: Path, cut: float, standby: RobotMachine) -> float:
    """When the standby's log grew again after the cut, by the calendar."""
    size = log.stat().st_size
    while (now := time.time()) < cut + PATIENCE_S:
        grown = log.stat().st_size
        if grown > size and now > cut + IN_FLIGHT_S:
            return now
        size = grown
        time.sleep(POLL_S)
    raise BenchmarkError(f"the program did not go on at {standby.name}: {standby.last_words()}")


def told(story: Iterable[Mapping[str, Any]], cut: float, output: float) -> Cut:
    """The phases between a cut and an output (seconds since 1970), from the standby's story.

    Raises:
        FailoverError: the story does not tell of a takeover.
    """
    lines = [(float(line["at"]), str(line["did"])) for line in story if float(line["at"]) >= cut]
    dead = next((at for at, did in lines if DEAD in did), None)
    acts = next(((at, did) for at, did in lines if did.startswith(ACTS_AGAIN)), None)
    if dead is None or acts is None:
        raise FailoverError(f"the standby's story tells of no takeover: {'; '.join(did for _, did in lines) or 'nothing'}")
    stages = {name.strip(): float(took) for name, took in STAGE.findall(acts[1].partition(": ")[2])}
    stages.pop("silence", None)
    stages = {re.sub(r"opening \d+ snapshots", "opening the snapshots", name): took for name, took in stages.items()}
    detection, decision = (dead - cut) * 1e3, (acts[0] - dead) * 1e3 - sum(stages.values())
    whole = (output - cut) * 1e3
    return Cut(whole, (detection, decision, whole - detection - decision), stages)
