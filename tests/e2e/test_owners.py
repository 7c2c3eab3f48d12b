"""Two robots and an ordinary user who gives orders about a program of theirs.

Its carried files are read with that user's rights, whichever program it executes meanwhile.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.errors import CheckpointError
from checkpoint.snapshot import carried_files, format
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = [pytest.mark.root, pytest.mark.compiler]

Pair = tuple[RobotMachine, RobotMachine]

ALICE = 7001
GROUP = "nogroup"
SECRET = b"a secret of root, which alice may not read"
DELAYS_S = (0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, *(number / 5 for number in range(1, 12)), None)
"""From the order to the instant in which it executes the other program; None: it does not."""
TRIES = len(DELAYS_S)

BECOME = f"""
import grp, json, os, subprocess, sys, threading, time
from pathlib import Path
from failover.client.control import Control
from failover.errors import FailoverError

os.setgroups([])
os.setgid(grp.getgrnam("{GROUP}").gr_gid)
os.setuid({ALICE})
"""

ORDERS = f"""
socket, program, lends, secret, place = map(Path, sys.argv[1:])

def ask(verb, **arguments):
    try:
        with Control.open(socket) as link:
            return link.ask(verb, **arguments)
    except FailoverError as error:
        return {{"refused": str(error)}}

def protected(name):
    return any(one["name"].endswith("/" + name) and one["protection"] == "protected" for one in ask("status")["components"])

for attempt, delay_s in enumerate({DELAYS_S}):
    here = place / str(attempt)
    here.mkdir()
    with open(here / "out", "wb") as out, open(os.devnull) as nothing:
        running = subprocess.Popen([program, lends], cwd=here, stdin=nothing, stdout=out, stderr=out, start_new_session=True)
    while b"ready" not in (here / "out").read_bytes():
        time.sleep(0.001)
    later = threading.Timer(delay_s or 0.0, (here / "exec").touch)
    if delay_s is not None:
        later.start()
    name = f"race{{attempt}}"
    answer = ask("protect", pid=running.pid, name=name, carry=[str(secret)])
    if delay_s is not None:
        later.join()
    if "refused" not in answer:
        deadline = time.monotonic() + 10
        while time.monotonic() < deadline and not protected(name) and running.poll() is None:
            time.sleep(0.02)
        ask("release", name=name)
    running.kill() if running.poll() is None else None
    print(json.dumps(answer), flush=True)
"""
"""Alice's: again and again a program of hers is to be protected that carries root's file, and that executes one of root's."""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    open_the_way(tmp_path)
    with robots.two_robots(tmp_path, f'group = "{GROUP}"\n') as both:
        yield both


def open_the_way(place: Path) -> None:
    """Every user finds the way to it."""
    for folder in (place, *list(place.parents)[:3]):
        folder.chmod(folder.stat().st_mode | 0o111)


def as_alice(robot: RobotMachine, script: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Have an ordinary user of the robot run a script, who need not find the way to this Python."""
    inside = ["nsenter", f"--target={robot.processes()[0]}", "--all"] if robots.means().own_pids else []
    command = [*inside, sys.executable, "-c", BECOME + script, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=10 * robots.PATIENCE_S)


def stored(robot: RobotMachine) -> Iterator[bytes]:
    """What the carried files of all checkpoints hold that this robot has, wherever it keeps them."""
    for path in robot.directory.rglob("*"):
        if path.is_file() and path.suffix in (".base", ".delta", ".snapshot"):
            try:
                snapshot = format.decode(path)
            except CheckpointError:
                continue  # it is just being removed
            for pieces in carried_files.pieces(snapshot).values():
                yield from (bytes(content) for _, content in pieces)


def test_no_order_of_a_user_reads_a_file_with_the_rights_that_a_program_comes_by(
    pair: Pair, compiled: Callable[..., Path], tmp_path: Path
) -> None:
    """`protect PID --carry FILE`, and the program executes a set-user-id program at some instant of it."""
    program = Path(shutil.copy(compiled("becomes"), tmp_path / "becomes"))
    lends = Path(shutil.copy(program, tmp_path / "lends"))
    lends.chmod(0o4755)
    secret, place = tmp_path / "secret", tmp_path / "alice"
    secret.write_bytes(SECRET)
    secret.chmod(0o600)
    place.mkdir()
    os.chown(place, ALICE, -1)
    ran = as_alice(pair[0], ORDERS, pair[0].socket, program, lends, secret, place)
    assert ran.returncode == 0, ran.stderr
    answers = [json.loads(line) for line in ran.stdout.splitlines()]
    assert len(answers) == TRIES
    taken = [answer for answer in answers if "refused" not in answer]
    assert not taken, f"{len(taken)} of {TRIES} times a file of root's was to be carried: {taken[0]}"
    said = [answer["refused"] for answer in answers]
    assert any("other rights than those of its owner" in one or "is not a process of uid" in one for one in said), said
    assert "is to be carried and cannot be read (Permission denied)" in said[-1], said
    for robot in pair:
        assert not any(SECRET in content for content in stored(robot))
