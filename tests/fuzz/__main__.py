"""Tries hostile bytes at every decoder that bytes of others reach: ``python -m tests.fuzz MINUTES [TARGET…]``.

Each target (`tests/fuzz/targets`) runs in a process of its own. A finding is a case with any outcome but a value or a refusal in
words: another exception, 256 MB of memory, two seconds of processor time, a hang, a crash. It is written as a file, with the
command that plays it again. The same seed makes the same cases.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import random
import signal
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from tests.fuzz import child, targets
from tests.fuzz.child import Finding, Plan, Report, Shared
from tests.fuzz.target import TARGETS, Target, scratch_root

WHERE: Final = Path("fuzz-findings")


class Kept(Struct, frozen=True):
    """A finding as a file."""

    target: str
    seed: int
    number: int
    what: str
    again: str
    content: bytes
    trace: str = ""


class Run(Struct):
    """One target under way. ``deaths``: what ended its processes before."""

    target: Target
    plan: Plan
    shared: Shared
    pipe: int = -1
    began: float = 0
    reports: list[Report] = []
    deaths: list[Finding] = []


def main(argv: list[str]) -> int:
    """Exit status: 0 nothing found, 1 something, 2 a mistake in the command."""
    arguments = _arguments(argv)
    if arguments.list:
        for one in TARGETS.values():
            print(f"{one.name:24} {one.bytes_of}")
        return 0
    with scratch_root():
        return play(Path(arguments.play)) if arguments.play else chosen_run(arguments)


def chosen_run(arguments: argparse.Namespace) -> int:
    """Run what was asked for; the exit status."""
    words, minutes = list(arguments.words), 0.0
    if words and words[0].replace(".", "", 1).isdigit():
        minutes = float(words.pop(0))
    if unknown := [name for name in words if name not in TARGETS]:
        print(f"fuzz: there is no target {unknown[0]}; --list shows all", file=sys.stderr)
        return 2
    if bool(minutes) == bool(arguments.cases):
        print("fuzz: say how many MINUTES, or --cases N of each target", file=sys.stderr)
        return 2
    seed = random.SystemRandom().randrange(1 << 32) if arguments.seed is None else arguments.seed
    chosen = [TARGETS[name] for name in words or TARGETS]
    able = [one for one in chosen if not one.needs or importlib.util.find_spec(one.needs)]
    for one in chosen:
        if one not in able:
            print(f"{one.name}: left out: the library {one.needs} is not installed")
    jobs = max(1, min(arguments.jobs, len(able)))
    each_s = minutes * 60 * jobs / max(len(able), 1)
    print(f"seed {seed}, {len(able)} targets", flush=True)
    kept = run_all(able, Plan(seed, count=arguments.cases, follows=not arguments.cases), each_s, jobs, Path(arguments.findings))
    if kept:
        print(f"fuzz: {len(kept)} findings; each of these plays one again:", file=sys.stderr)
        print("\n".join(f"  ./run fuzz --play {path}" for path in kept), file=sys.stderr)
        return 1
    print("nothing found")
    return 0


def _arguments(argv: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("./run fuzz", description=__doc__)
    parser.add_argument("words", nargs="*", metavar="MINUTES TARGET", help="so long for all targets together; only these targets")
    parser.add_argument("--cases", type=int, default=0, help="so many of each target, instead of MINUTES; lines are not followed")
    parser.add_argument("--seed", type=int, help="of the dice; else one is drawn and printed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    parser.add_argument("--findings", default=str(WHERE), help=f"the directory for findings ({WHERE})")
    parser.add_argument("--list", action="store_true", help="the targets, and whose bytes reach them")
    parser.add_argument("--play", metavar="FILE", help="play a finding again")
    return parser.parse_args(argv)


def run_all(chosen: Iterable[Target], plan: Plan, each_s: float, jobs: int, where: Path) -> list[Path]:
    """Run the targets, some at a time; the files of what they found.

    Args:
        each_s: seconds of each target; 0: as many cases as the plan says.
    """
    waiting = [Run(one, plan, Shared()) for one in chosen]
    waiting.reverse()
    going: dict[int, Run] = {}
    kept: list[Path] = []
    while waiting or going:
        while waiting and len(going) < jobs:
            run = waiting.pop()
            if each_s and not run.began:
                run.plan = replace(run.plan, until=time.monotonic() + each_s)
            run.began = run.began or time.monotonic()
            going[_started(run)] = run
        pid, status = os.wait()
        run = going.pop(pid)
        with os.fdopen(run.pipe, "rb") as pipe:
            content = pipe.read()
        if os.WIFEXITED(status) and not os.WEXITSTATUS(status):
            run.reports.append(child.unpacked(content))
        elif _goes_on(run, status, content):
            waiting.append(run)
            continue
        kept += _told(run, where)
        run.shared.close()
    return kept


def _started(run: Run) -> int:
    """A child process that tries the cases of a target; its pid."""
    run.shared.put(run.plan.first, b"")
    reading, writing = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            os.close(reading)
            said = child.packed(child.run(run.target, run.plan, run.shared))
            with os.fdopen(writing, "wb") as pipe:
                pipe.write(said)
            status = 0
        except BaseException:  # noqa: BLE001  # of the target itself: its seeds, its imports
            import traceback

            os.write(writing, traceback.format_exc()[-8_000:].encode(errors="replace"))
        finally:
            os._exit(status)
    os.close(writing)
    run.pipe = reading
    return pid


def _goes_on(run: Run, status: int, said: bytes) -> bool:
    """A child died: note the case by which it did; whether there is more to try after it."""
    number, content = run.shared.take()
    if not os.WIFSIGNALED(status):
        run.deaths.append(Finding(-1, content, f"the target failed before its first case:\n{said.decode()}", "start"))
        return False
    killed = signal.Signals(os.WTERMSIG(status))
    if killed is not signal.SIGPROF or not run.plan.follows or _dies(run.target, content):
        why = {signal.SIGPROF: f"more than {child.CASE_CPU_S:g} s of processor time", signal.SIGALRM: "it hangs"}
        what = why.get(killed, f"the process died by {killed.name}")
        run.deaths.append(Finding(number, content, what, what))
    done = number + 1 - run.plan.first
    run.reports.append(Report(done, 0, 0, 0, 0, ()))
    run.plan = replace(run.plan, first=number + 1, count=max(run.plan.count - done, 0))
    is_over = run.plan.until and time.monotonic() > run.plan.until
    return not is_over and (run.plan.follows or run.plan.count > 0) and len(run.deaths) < child.FINDINGS_MAX


def _dies(target: Target, content: bytes) -> bool:
    """Whether a case ends a process also where no lines are followed."""
    pid = os.fork()
    if pid == 0:
        try:
            decoder = target.made()
            child.limit()
            child.outcome(decoder, content)
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(pid, 0)[1])


def _told(run: Run, where: Path) -> list[Path]:
    """Print a line about a target that is done, and write its findings."""
    found = [*run.deaths, *(one for report in run.reports for one in report.findings)]
    cases, refused = (sum(getattr(one, name) for one in run.reports) for name in ("cases", "refused"))
    lines, kept = (max((getattr(one, name) for one in run.reports), default=0) for name in ("lines", "kept"))
    slowest_s = max((one.slowest_s for one in run.reports), default=0.0)
    share = 100 * refused // cases if cases else 0
    follows = f", {lines:5} lines, {kept:3} kept" if run.plan.follows else ""
    print(
        f"{run.target.name:24} {cases:8} cases, {share:3} % refused{follows}, slowest {slowest_s:.3f} s, {len(found)} findings",
        flush=True,
    )
    return [_written(run, one, where) for one in found]


def _written(run: Run, found: Finding, where: Path) -> Path:
    where.mkdir(parents=True, exist_ok=True)
    path = where / f"{run.target.name}-{hashlib.sha256(found.place.encode() + found.content).hexdigest()[:12]}.json"
    command = f"./run fuzz --play {path}"
    kept = Kept(run.target.name, run.plan.seed, found.number, found.what, command, found.content, found.trace)
    path.write_bytes(msgspec.json.format(msgspec.json.encode(kept)))
    print(f"  {found.what.splitlines()[-1] if found.number < 0 else found.what.splitlines()[0]:.300}", flush=True)
    return path


def play(path: Path) -> int:
    """Try the case of a finding again, under the same limits; what it does, a traceback too, is printed."""
    try:
        kept = msgspec.json.decode(path.read_bytes(), type=Kept)
    except (OSError, ValueError) as error:
        print(f"fuzz: cannot read {path}: {error}; give a file that a run wrote", file=sys.stderr)
        return 2
    print(f"{kept.target}, case {kept.number} of seed {kept.seed}: {len(kept.content)} bytes: {kept.content[:200]!r}", flush=True)
    decoder = TARGETS[kept.target].made()
    child.limit()
    print(child.outcome(decoder, kept.content))
    return 0


if __name__ == "__main__":
    targets.load()
    sys.exit(main(sys.argv[1:]))
