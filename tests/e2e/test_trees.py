"""Programs of several processes at one robot, whose power fails: all of their processes resume at the other one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e import robots

pytestmark = pytest.mark.root

COUNTING = "i=0; while :; do echo $i; i=$((i+1)); sleep 0.02 | cat; done"

HANDING_ON = """
import mmap, os, time
memory = mmap.mmap(-1, 4096)
ask, asked = os.pipe()
answer, answered = os.pipe()
if os.fork() == 0:
    while os.read(ask, 1):
        memory[0] = (memory[0] + 1) % 256
        os.write(answered, b"x")
number = 0
while True:
    os.write(asked, b"x")
    os.read(answer, 1)
    assert memory[0] == (number + 1) % 256, (memory[0], number)
    print(number, flush=True)
    number += 1
    time.sleep(0.01)
"""
"""Counts in memory that it shares with its child, which answers each question by a pipe."""


@pytest.mark.parametrize(
    "command",
    [("/bin/sh", "-c", COUNTING), ("/usr/bin/python3", "-S", "-c", HANDING_ON)],
    ids=["shell with pipelines", "parent and child"],
)
def test_all_processes_of_a_program_go_on_at_the_other_robot(command: tuple[str, ...], tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, "") as (first, second):
        robots.run(first, "count", *command)
        robots.until_protected(first)
        robots.counts_on_elsewhere(first, second, 30)
