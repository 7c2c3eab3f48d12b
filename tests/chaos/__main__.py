"""``python -m tests.chaos --faults 200``: real faults, drawn from a seed, in a test team of five robots, a server and a witness.

Needs root. Everything runs in namespaces of its own, so no end of this program (Ctrl-C, kill -9) leaves a process, a mount or an
interface. A campaign that fails leaves its evidence in a directory and prints the path: the faults with their instants, the
actuator's record, each agent's log, and the merged event log of all robots (``failover why``).
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final, NoReturn

from failover.errors import FailoverError
from tests.chaos.campaign import Campaign
from tests.chaos.faults import KINDS
from tests.chaos.house import BEAT_MS, LEASE_MS, House, programs

INSIDE: Final = "FAILOVER_CHAOS_INSIDE"
"""Set once we stand in namespaces of our own."""

NAMESPACES: Final = (
    *("unshare", "--mount", "--net", "--ipc", "--pid", "--fork", "--kill-child", "--mount-proc"),
    *("--propagation", "private"),
)
MISTAKE_LINES: Final = 40
LAST_LINES: Final = 60
TIME_SIZE: Final = len("23:59:59")
FIRST_PROCESS: Final = '"$@"; exit $?'
"""A shell as PID 1 reaps what is left to it."""


def main() -> int:
    """Wage a campaign; 1 if a promise was broken."""
    arguments = _parser().parse_args()
    if os.geteuid():
        sys.exit("python -m tests.chaos: needs root: every robot gets a network of its own")
    if INSIDE not in os.environ:
        _go_inside()
    directory = Path(arguments.directory or tempfile.mkdtemp(prefix="chaos-"))
    directory.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    print(f"seed {arguments.seed}, {arguments.faults} faults; beats every {BEAT_MS} ms, leases of {LEASE_MS} ms", flush=True)
    if not _wage(directory, arguments.seed, arguments.faults, arguments.kinds):
        print(f"evidence: {directory}", flush=True)
        return 1
    print(f"in {time.monotonic() - began:.0f} s", flush=True)
    if not arguments.directory:
        shutil.rmtree(directory, ignore_errors=True)
    return 0


def _wage(directory: Path, seed: str, faults: int, kinds: list[str]) -> bool:
    plan = tuple(programs(directory, shutil.which("gcc") or shutil.which("cc"), _gawk()))
    with House(directory, plan) as house:
        house.start()
        campaign = Campaign(house, random.Random(seed), kinds)
        try:
            campaign.wage(faults)
        except (AssertionError, FailoverError) as error:
            print(f"seed {seed}: {type(error).__name__} at fault {len(campaign.blows) + 1}: {error}", flush=True)
            campaign.evidence()
            print(*_last_lines(house), sep="\n", flush=True)
            return False
        except KeyboardInterrupt:
            print("called off; until then:", flush=True)
        print(campaign.figures(), flush=True)
        return not any(_is_mistaken(member.directory / "agent.log") for member in house.members)


def _last_lines(house: House) -> list[str]:
    """The newest lines about components of all agents' logs, in order: where the evidence is lost, they may say enough."""
    logs = ((member.name, (member.directory / "agent.log").read_text(errors="replace")) for member in house.members)
    about = [(line[:TIME_SIZE], name, line[TIME_SIZE:]) for name, log in logs for line in log.splitlines() if "/house/" in line]
    return [f"{at} {name}{said}" for at, name, said in sorted(about, key=lambda one: one[0])[-LAST_LINES:]]


def _is_mistaken(log: Path) -> bool:
    """Whether there is a traceback in an agent's log: a bug, also if it did no harm. It is shown."""
    _, found, rest = log.read_text(errors="replace").partition("Traceback")
    if found:
        print(f"a mistake in {log}:", *(found + rest).splitlines()[:MISTAKE_LINES], sep="\n", flush=True)
    return bool(found)


def _gawk() -> str | None:
    """The path of a gawk that can sleep."""
    path = shutil.which("gawk")
    works = path is not None and not subprocess.run([path, '@load "time"; BEGIN {}'], capture_output=True, check=False).returncode
    return path if works else None


def _go_inside() -> NoReturn:
    """Become the first process of namespaces: to kill this process kills the whole campaign."""
    command = [*NAMESPACES, "sh", "-c", FIRST_PROCESS, "sh", sys.executable, "-m", "tests.chaos", *sys.argv[1:]]
    os.execvpe(command[0], command, {**os.environ, INSIDE: "1"})


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument("--faults", type=int, default=20, help="how many")
    parser.add_argument("--seed", default=str(random.randrange(1 << 32)), help="of the dice")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="of faults; all of them")
    parser.add_argument("--directory", help="where to work, and to leave the evidence; kept")
    return parser


if __name__ == "__main__":
    sys.exit(main())
