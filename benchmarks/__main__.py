"""Run the benchmarks, print a table, write it with the machine's facts.

python -m benchmarks                    all of them, some minutes
python -m benchmarks --quick freeze     fewer cases of one, half a minute
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from benchmarks import engine, machine, outage, task
from benchmarks.figures import Figure, table

BENCHMARKS = {"freeze": engine.freeze, "restore": engine.restore, "outage": outage.outage, "task": task.task}


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*BENCHMARKS, []], metavar="NAME", help=f"which: {', '.join(BENCHMARKS)}")
    parser.add_argument("--quick", action="store_true", help="fewer cases and repetitions")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results", help="directory of the results")
    arguments = parser.parse_args()
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory(prefix="failover-benchmark-") as directory:
        for name in arguments.names or BENCHMARKS:
            print(f"measuring {name} …", file=sys.stderr, flush=True)
            figures += BENCHMARKS[name](arguments.quick, Path(directory))
    print(table(figures))
    write(arguments.output, figures)
    return 0


def write(directory: Path, figures: list[Figure]) -> None:
    """Keep the newest figures of each benchmark, for people and for machines."""
    directory.mkdir(parents=True, exist_ok=True)
    facts = machine.facts() | {"measured": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"}
    heading = "\n".join(f"* {key}: {value}" for key, value in facts.items())
    (directory / "newest.md").write_text(f"# Newest figures\n\n`python -m benchmarks`\n\n{heading}\n\n{table(figures)}\n")
    (directory / "newest.json").write_text(
        json.dumps({"machine": facts, "figures": [asdict(one) for one in figures]}, indent=1) + "\n"
    )


if __name__ == "__main__":
    sys.exit(main())
