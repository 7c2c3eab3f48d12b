"""The commands of docs/decorator.md, typed: two robots on one machine, one of them killed, and the counter counts on."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.e2e import robots

PAGE = Path(__file__).parents[2] / "docs" / "decorator.md"
MORE = 10
"""Numbers that are counted after the death of the robot."""

pytestmark = [pytest.mark.root, pytest.mark.command("unshare"), pytest.mark.command("ip")]


@dataclass
class Terminal:
    """A shell in a network of its own: the ports on the page may be taken here."""

    shell: subprocess.Popen[str]

    def type(self, text: str) -> str:
        """What comes of it, errors included."""
        assert self.shell.stdin is not None and self.shell.stdout is not None
        self.shell.stdin.write(f"{text}\necho typed\n")
        self.shell.stdin.flush()
        return "".join(iter(self.shell.stdout.readline, "typed\n"))


IN_A_NETWORK = ("unshare", "--net", "sh", "-c", "ip link set lo up; exec sh 2>&1")


@contextmanager
def terminal(folder: Path, command: Sequence[str] = IN_A_NETWORK) -> Iterator[Terminal]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FAILOVER_")}
    environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=pipe, stdout=pipe, text=True) as shell:
        try:
            yield Terminal(shell)
        finally:
            Terminal(shell).type("kill -9 $(cat r?/pid); wait")
            shell.kill()


def section(heading: str) -> str:
    return PAGE.read_text().split(f" {heading}\n")[1].split("\n#")[0]


def test_two_robots_on_one_machine_as_the_page_tells_it(tmp_path: Path) -> None:
    begin, protect, lose = re.findall(r"```sh\n(.*?)```", section("Two robots on one machine"), re.DOTALL)
    counter = re.search(r"```python\n(.*?)```", section("In five lines"), re.DOTALL)
    assert counter is not None
    (tmp_path / "counter.py").write_text(counter[1])
    with terminal(tmp_path) as typed:
        said = typed.type(begin)
        sockets = [tmp_path / robot / "run" / "control.sock" for robot in ("r1", "r2")]
        robots.until(lambda: all(socket.exists() for socket in sockets), f"two agents after: {said}")
        said = typed.type(protect)
        robots.until(lambda: "r2, warm" in typed.type(protect.splitlines()[1]), f"a warm standby after: {said}")
        said = typed.type(lose)
        logs, why = lose.splitlines()[1:]
        before = len(typed.type(logs).split())
        robots.until(lambda: len(typed.type(logs).split()) > before + MORE, f"the counter to go on after: {said}")
        numbers = typed.type(logs).split()
        assert numbers == [str(number) for number in range(1, len(numbers) + 1)]
        robots.until(lambda: "it resumes from checkpoint" in typed.type(why), "the event log to tell of it")
