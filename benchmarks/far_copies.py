"""How old the newest sealed copy at another site becomes, on a wire of 200 ms: so much work is lost with a site, at most.

python -m benchmarks.far_copies                          10 MB, 2 Mbit/s, a copy each 60 s, 2 % loss; as root, seven minutes
python -m benchmarks.far_copies --megabytes 1 --every 10

A program whose memory no compression makes smaller counts at robot1. The witness is at the other end of the wire of
``tests/e2e/long_wire.py``. The age counts from the sealing of a copy until the next one is kept, by one clock. The first copy is
told apart: the files that the program needs travel before it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from tests.e2e import robots
from tests.e2e.test_sealed_copies import copies
from tests.e2e.two_sites import PATIENCE_S, SETTINGS, TwoSites, stage

PAGE_SIZE: Final = 4096
COPIES: Final = 2
LOOK_S: Final = 0.05

HOLDS: Final = """
import os, sys, time
held = os.urandom({size})
number = 0
while True:
    print(number, flush=True)
    number += 1
    time.sleep(0.01)
"""


def main() -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.far_copies", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--megabytes", type=int, default=10, help="that the program holds (default: %(default)s)")
    parser.add_argument("--mbit", type=float, default=2, help="that the wire carries in a second (default: %(default)s)")
    parser.add_argument("--every", type=int, default=60, metavar="S", help="s3_every_s (default: %(default)s)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir="/tmp") as directory, stage(Path(directory), SETTINGS, arguments.every) as site:
        site.limit(f"{arguments.mbit * 1000:.0f}kbit")
        begun_s = time.time()
        robots.run(site.members["robot1"], "count", "/usr/bin/python3", "-S", "-c", HOLDS.format(size=arguments.megabytes << 20))
        kept_s = _next(site, "")
        print(f"the first copy was kept {kept_s - begun_s:.0f} s after the start of the program", flush=True)
        for _ in range(COPIES):
            newest = copies(site.members["gate"])[-1]
            sealed_s, size = int(newest.name.partition("-")[0], 16) / 1000, newest.stat().st_size / 1e6
            fresh_s, kept_s = kept_s - sealed_s, _next(site, newest.name)
            print(
                f"{size:.1f} MB: {fresh_s:.0f} s old when it was kept, {kept_s - sealed_s:.0f} s when the next one was",
                flush=True,
            )
    return 0


def _next(site: TwoSites, newest: str) -> float:
    """When a copy is kept that is later than that one."""
    gate = site.members["gate"]

    def has_come() -> bool:
        time.sleep(LOOK_S)
        kept = copies(gate)
        return bool(kept) and kept[-1].name > newest

    robots.until(has_come, "the next copy", 4 * PATIENCE_S)
    return time.time()


if __name__ == "__main__":
    sys.exit(main())
