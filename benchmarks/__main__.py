"""Measure, side by side with what a user would pick instead; print tables, and write them with the machine's facts.

python -m benchmarks                     all of it, some fifteen minutes; writes benchmarks/RESULTS.md
python -m benchmarks --quick             fewer cases and repetitions, some minutes; prints only
python -m benchmarks --quick restore     one of them
python -m benchmarks load --load 8       beside eight busy loops, and without; no part of the whole run
python -m benchmarks soak --for 2h       what grows over hours; no part of the whole run
python -m benchmarks fleet               how a fleet grows to 1,000 robots, on paper; no part of the whole run
python -m benchmarks sealed              what sealed copies cost, and beside restic; no part of the whole run

As root more is measured (CRIU, beats on the wire). Nothing else should run meanwhile; a busy machine is warned of.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks import (
    beside,
    board,
    board_in_c,
    chains,
    costs,
    crowd,
    cuts,
    driver_call,
    encoding,
    engine,
    families,
    files,
    fleet,
    increments,
    interference,
    lateness,
    load,
    machine,
    main_loop,
    outage,
    overload,
    results,
    sealed,
    slack,
    soak,
    task,
    task_times,
)
from benchmarks.figures import Absent, Findings
from benchmarks.running import BenchmarkError
from checkpoint.errors import CheckpointError
from failover.config.quantities import span_ms
from failover.errors import FailoverError

HERE: Final = Path(__file__).parent


def _freeze(quick: bool, directory: Path) -> Findings:
    return Findings(
        "Freeze time",
        "How long the keeper holds the program still, by its own account (from asking its first thread to stop until the last "
        "one is let go), for its first snapshot (a base, copied while the "
        "program runs) and for the deltas after it, twenty a second; the time until a delta is encoded; what it carries.",
        tuple(engine.freeze(quick, directory)),
    )


def _crowd(quick: bool, directory: Path) -> Findings:
    return Findings(
        "Threads, descriptors and carried files",
        "How much longer a program stands still for each thread that sleeps, each descriptor, and each name in a carried folder, "
        "that it has more.",
        tuple(crowd.crowd(quick, directory)),
    )


def _restore(quick: bool, directory: Path) -> Findings:
    theirs, absent = beside.restored_by_criu(quick, directory)
    ours = engine.restore(quick, directory)
    return Findings(
        "Restore",
        "From the snapshot in memory to the program running: all of it brought back; the takeover: the order to a standby that "
        "has the memory in a stopped process already (as by default). gcore's files cannot be restored.",
        tuple(sorted([*ours, *theirs], key=lambda figure: int(figure.case.split()[0]))),
        absent,
    )


def _outage(quick: bool, directory: Path) -> Findings:
    return Findings(
        "Outage",
        "Two robots on this machine, in namespaces of their own where root allows; beats each 20 ms, a lease of 120 ms. Every "
        "process of the primary is stopped and killed; from that instant to the next output of each program at the standby "
        "(they write each 10 ms). The first ones are captured from outside; those that keep their state themselves are started "
        "again, where they are not *warm*: started in advance, and waiting.",
        tuple(outage.outage(quick, directory)),
    )


BENCHMARKS: Final[dict[str, Callable[[bool, Path], Findings]]] = {
    "freeze": _freeze,
    "increments": increments.increments,
    "crowd": _crowd,
    "beside": beside.beside,
    "restore": _restore,
    "families": families.families,
    "chains": chains.chains,
    "files": files.files,
    "outage": _outage,
    "cuts": cuts.cuts,
    "overload": overload.overload,
    "throughput": interference.throughput,
    "costs": costs.costs,
    "beats": interference.beats,
    "lateness": lateness.lateness,
    "main_loop": main_loop.main_loop,
    "encoding": encoding.encoding,
    "task": task.task,
    "board": board.board,
    "board_in_c": board_in_c.board_in_c,
    "slack": slack.slack,
    "task_times": task_times.task_times,
    "driver_call": driver_call.driver_call,
    "messages": driver_call.messages,
}

BY_ITSELF: Final = ("load", "soak", "fleet", "sealed")
"""No parts of the whole run: they take twenty minutes, hours, ten minutes, and ten minutes."""


def main() -> int:
    """Measure, print, write."""
    arguments = _parser().parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # of what is installed the bytecode is there
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that whatever was started is ended
    share = machine.busy_share()
    warning = machine.warning(share)
    facts = machine.facts(share) | {"measured": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"}
    if warning:
        print(f"WARNING: {warning}", file=sys.stderr)
    began, before = time.monotonic(), machine.ticks()
    loads = (0, arguments.load) if arguments.load else load.LOADS
    span_s = arguments.span_ms / 1_000 if arguments.span_ms else None
    benchmarks = BENCHMARKS | {
        "load": partial(load.load, loads=loads),
        "soak": partial(soak.soak, span_s=span_s),
        "fleet": fleet.fleet,
        "sealed": sealed.sealed,
    }
    findings = [_measure(name, benchmarks[name], arguments.quick) for name in arguments.names or BENCHMARKS]
    facts["it took"] = f"{time.monotonic() - began:.0f} s"
    facts["given to others by the host meanwhile"] = f"{(machine.ticks() - before).stolen_share:.1%} of its cores' time"
    command = " ".join(["python -m benchmarks", *(["--quick"] if arguments.quick else []), *arguments.names])
    print(results.page(command, facts, warning, findings))
    whole = not arguments.names and not arguments.quick
    if arguments.output or whole:
        results.write(arguments.output or HERE, command, facts, warning, findings)
    return 0 if all(found.figures for found in findings) else 1


def _measure(name: str, benchmark: Callable[[bool, Path], Findings], quick: bool) -> Findings:
    """One benchmark; one that comes to nothing says why and leaves the others their turn."""
    print(f"measuring {name} …", file=sys.stderr, flush=True)
    began, before = time.monotonic(), machine.ticks()
    try:
        with tempfile.TemporaryDirectory(prefix="failover-benchmark-") as directory:
            found = benchmark(quick, Path(directory))
        print(f"  in {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        return replace(found, stolen=(machine.ticks() - before).stolen_share)
    except (BenchmarkError, CheckpointError, FailoverError, OSError) as error:
        print(f"{name} came to nothing: {error}", file=sys.stderr)
        return Findings(name, "This came to nothing.", (), (Absent(name, str(error)),))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names",
        nargs="*",
        choices=[*BENCHMARKS, *BY_ITSELF, []],
        metavar="NAME",
        help=f"which: {', '.join(BENCHMARKS)}; {', '.join(BY_ITSELF)}",
    )
    parser.add_argument("--quick", action="store_true", help="fewer cases and repetitions; nothing is written")
    parser.add_argument("--for", dest="span_ms", type=span_ms, metavar="SPAN", help="of soak: 25m, 2h (the default)")
    parser.add_argument("--load", type=int, metavar="N", help="of load: N busy loops (default: 2, and 8)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="write there (default: a whole run writes into benchmarks/)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
