"""The commands of docs/servers.md, typed: both robots die, one comes back with an empty disk, and the counter counts on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from failover.cli.demo.host import descendants
from tests.agent.guards import lives
from tests.e2e import robots
from tests.e2e.test_decorator_page_typed import PAGE as DECORATOR_PAGE
from tests.e2e.test_decorator_page_typed import Terminal, terminal

PAGE = DECORATOR_PAGE.with_name("servers.md")
MEMBERS = ("r1", "r2", "hall")
KEPT = "json=$(failover status --json --socket hall/run/control.sock); echo $json"
OF_ITS_OWN = re.compile(r'"components": \[\{"name": "/here/r1/counter", "role": "standby"[^{}]*"sequence": \d')
"""What the server says of itself, once it has a checkpoint: it is a standby before, and the program's files arrive first.
What it says of the others follows below "elsewhere".
"""
SEEN = 20
"""Numbers that are counted before the robots die, and after."""

pytestmark = [pytest.mark.root, pytest.mark.command("unshare"), pytest.mark.command("ip")]


@contextmanager
def ending(typed: Terminal) -> Iterator[None]:
    """The server ends with the test; the terminal ends the robots."""
    try:
        yield
    finally:
        print(typed.type(f"tail -n {robots.LOG_LINES} */log"))  # shown by pytest where a test fails
        typed.type("kill -9 $(cat hall/pid)")


def test_the_server_returns_a_component_to_an_empty_robot_as_the_page_tells_it(tmp_path: Path) -> None:
    begin, protect, lose = re.findall(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)
    counter = re.search(r"```python\n(.*?)```", DECORATOR_PAGE.read_text().split(" In five lines\n")[1], re.DOTALL)
    assert counter is not None
    (tmp_path / "counter.py").write_text(counter[1])
    with terminal(tmp_path) as typed, ending(typed):
        said = typed.type(begin)
        sockets = [tmp_path / member / "run" / "control.sock" for member in MEMBERS]
        robots.until(lambda: all(socket.exists() for socket in sockets), f"three agents after: {said}")
        robots.until(lambda: "hears 3 of 3" in typed.type(protect.splitlines()[1]), "a majority")
        logs, why = lose.splitlines()[3:]
        at_r1 = logs.replace("r2/", "r1/")
        said = typed.type(protect)
        while "has just started" in said:  # people type more slowly
            said = typed.type(protect)
        robots.until(lambda: len(typed.type(at_r1).split()) > SEEN, f"the counter to count after: {said}")
        robots.until(lambda: OF_ITS_OWN.search(typed.type(KEPT)), "a checkpoint at the server")
        kill, *later = lose.splitlines()
        there = [pid for robot in ("r1", "r2") for pid in descendants(int((tmp_path / robot / "pid").read_text()))]
        typed.type(kill)  # people type slowly: what it ends may still write to the directory that goes next
        robots.until(lambda: not any(map(lives, there)), "the end of both robots")
        typed.type("\n".join(later))
        robots.until(lambda: "it resumes from checkpoint" in typed.type(why), "the counter to go on")
        before = len(typed.type(logs).split())
        robots.until(lambda: len(typed.type(logs).split()) > before + SEEN, "the counter to count on")
        numbers = typed.type(logs).split()
        assert numbers == [str(number) for number in range(1, len(numbers) + 1)]
        robots.until(lambda: "hall gives its checkpoint back to r2" in typed.type(why), "the server to tell its part")
