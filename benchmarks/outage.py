"""The whole: from the power cut to the program's next output, by the demo itself."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

from benchmarks.figures import Figure


def outage(quick: bool, _directory: Path) -> list[Figure]:
    """Run the demo several times; a run whose output differs is an error, not a figure."""
    found: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for _ in range(2 if quick else 8):
        ran = subprocess.run(
            [sys.executable, "-m", "failover.cli.main", "demo", "--json"], capture_output=True, text=True, check=False
        )
        if ran.returncode:
            raise RuntimeError(f"the demo failed: {ran.stdout.strip()} {ran.stderr.strip()}")
        for program in json.loads(ran.stdout)["programs"]:
            case = program["name"]
            found["power cut to next output", case, "ms"].append(program["outage_ms"])
            found["age of the checkpoint at the cut", case, "ms"].append(program["lag_ms"])
            found["freeze in the demo, median", case, "ms"].append(program["freeze_us_median"] / 1000)
    return [Figure(*key, tuple(values)) for key, values in found.items()]
