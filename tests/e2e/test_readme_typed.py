"""The README's first block, typed on two clean machines: a program is protected, its robot is killed, and it goes on."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from failover.cli.demo.host import descendants
from tests.e2e import machines, robots
from tests.e2e.machines import CHECKOUT, Machine
from tests.e2e.service import COUNT, component, counted, lay_cable
from tests.e2e.test_package import PACKAGE, SYSTEM
from tests.e2e.test_systemd_power import MORE

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-"),
    pytest.mark.skipif(not (PACKAGE and SYSTEM), reason="FAILOVER_TEST_PACKAGE, FAILOVER_TEST_DEBIAN say with what"),
]

COMMANDS_MAX: Final = 4
"""On one robot, from nothing to a protected program."""

HOME: Final = "root"
ENDED: Final = "--ended--"
PROMPT: Final = "# "


class Line(NamedTuple):
    """What is typed, and where: "r1", "r2" or "both"."""

    command: str
    where: str


def lines_of(readme: str) -> list[Line]:
    """The block of the README that sets a team up; the comment of each line begins with the robot."""
    section = readme.split("## First success: two robots\n")[1]
    return [_line(text) for text in section.split("```\n")[1].splitlines()]


def _line(text: str) -> Line:
    found = re.fullmatch(r"(\S.*?)\s+# (both|r1|r2)\b.*", text)
    assert found, f"the README does not say where to type {text!r}"
    return Line(found[1], found[2])


class Terminal:
    """A person at one machine."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self._screen, near = pty.openpty()
        inside = [*machine.inside(), f"HOME=/{HOME}", "TERM=dumb", "sh", "-c", f"cd /{HOME}; PS1='# ' exec sh -i"]
        self._shell = subprocess.Popen(inside, stdin=near, stdout=near, stderr=near, start_new_session=True)
        os.close(near)
        self._said = ""
        self.until(PROMPT)

    def type(self, text: str) -> None:
        """One line, and the key Enter."""
        os.write(self._screen, f"{text}\n".encode())

    def until(self, sign: str) -> str:
        """What is shown up to this sign."""
        deadline = time.monotonic() + robots.PATIENCE_S
        while sign not in self._said:
            assert time.monotonic() < deadline, f"{self.machine.name} does not say {sign!r}: {self._said}"
            if select.select([self._screen], [], [], 0.1)[0]:
                self._said += os.read(self._screen, 65_536).decode(errors="replace").replace("\r", "")
        said, _, self._said = self._said.partition(sign)
        return said

    def begin(self, command: str) -> None:
        """Type a command; its exit status is shown after its end."""
        self.type(f"{command}; echo {ENDED[:5]}''{ENDED[5:]} $?")

    def finish(self) -> str:
        """What a command has said; it ended well."""
        said = self.until(ENDED)
        status = self.until("\n").strip()
        self.until(PROMPT)  # what is typed before it stands in front of the next command's first line
        assert status == "0", f"status {status} at {self.machine.name}: {said}"
        return said

    def close(self) -> None:
        """End the shell and what it runs; its parent, which entered the machine, ends with it."""
        for pid in descendants(self._shell.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._shell.wait()
        os.close(self._screen)


@contextmanager
def two_clean_machines(directory: Path) -> Iterator[tuple[Machine, Machine]]:
    """Debian, a cable between them, the package's file, and a program at the first."""
    with ExitStack() as stack:
        first, second = (stack.enter_context(machines.booted(directory, name, Path(SYSTEM))) for name in ("r1", "r2"))
        lay_cable(first, second)
        for machine in (first, second):
            shutil.copy(PACKAGE, machine.root / HOME)
        (first.root / HOME / "mapper.py").write_text(COUNT)
        yield first, second


def settings_of(machine: Machine) -> str:
    """The agent's, as they lie there."""
    return (machine.root / "etc/failover/agent.toml").read_text()


def test_the_readme_typed_as_it_stands_protects_a_program_that_outlives_its_robot(tmp_path: Path) -> None:
    lines = lines_of((CHECKOUT / "README.md").read_text())
    typed = Counter(robot for line in lines for robot in ("r1", "r2") if line.where in (robot, "both"))
    assert max(typed.values()) <= COMMANDS_MAX, typed
    install, create, invite, join, run = lines
    with two_clean_machines(tmp_path) as (first, second), ExitStack() as stack:
        began = time.monotonic()
        at = {machine.name: Terminal(machine) for machine in (first, second)}
        for terminal in at.values():
            stack.callback(terminal.close)
        assert install.where == "both"
        for terminal in at.values():
            terminal.begin(install.command)
        for terminal in at.values():
            terminal.finish()
        before = [settings_of(machine) for machine in (first, second)]

        at[create.where].begin(create.command)
        said = at[create.where].finish()
        assert (
            "this machine is r1 at 10.9.0.1:7420; its service runs; failover status shows it; then: failover team invite" in said
        )

        at[invite.where].begin(invite.command)
        at[invite.where].until("\nr2@10.9.0.1:")
        line = "r2@10.9.0.1:" + at[invite.where].until("\n")
        at[invite.where].until("on r2: failover team join, which asks for that line")
        at[join.where].begin(join.command)
        at[join.where].until("the line of failover team invite: ")
        at[join.where].type(line)
        assert "this machine is r2 of team lab, with r1; its service runs; failover status shows it" in at[join.where].finish()
        assert "r2 belongs to the team now" in at[invite.where].finish()

        at[run.where].begin(run.command)
        assert "/lab/r1/mapper\n" in (said := at[run.where].finish()) and "r2 holds a checkpoint of it" in said, said
        print(f"{time.monotonic() - began:.1f} s from nothing to a protected program; commands: {dict(typed)}")
        assert before == [settings_of(machine) for machine in (first, second)], "no line of configuration was needed"
        assert component(first, "mapper")["protection"] == "protected"

        first.stand_still()
        first.end()
        robots.until(lambda: component(second, "mapper").get("restores", 0) >= 1, "the other robot to take over")
        seen = len(counted(second, "mapper"))
        robots.until(lambda: len(counted(second, "mapper")) > seen + MORE, "the count to go on")
        numbers = counted(second, "mapper")
        assert seen and numbers == list(range(len(numbers)))
