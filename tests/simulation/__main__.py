"""``python -m tests.simulation --seeds N``: play more seeds than the tests do, and stop at the first that breaks."""

from __future__ import annotations

import argparse
import sys
import time

from tests.simulation.chaos import life
from tests.simulation.invariants import Broken


def main() -> int:
    """Play the seeds; 1 if one broke, with its story."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=1_000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument("--keep-going", action="store_true", help="do not stop at the first that breaks")
    arguments = parser.parse_args()
    began, broken = time.monotonic(), 0
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        try:
            life(seed)
        except Broken as story:
            broken += 1
            print(f"seed {seed}: {story if not arguments.keep_going else str(story).splitlines()[0]}")
            if not arguments.keep_going:
                return 1
    print(f"{arguments.seeds} seeds in {time.monotonic() - began:.1f} s, {broken} broken")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
