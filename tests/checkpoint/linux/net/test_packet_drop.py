"""Tables of connections that are kept silent: they end by themselves, and the next one clears them away."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.root

SPENT = """
from checkpoint.linux.net import packet_drop as silence
first, second = (silence.Connection(("10.0.0.1", port), ("10.0.0.2", 80)) for port in (1, 2))
silence.SILENCE_S = 0
silence.impose([first])
assert [name for name, _ in silence._tables()] == [first.table]
silence.SILENCE_S = 60
silence.impose([second])
assert [name for name, _ in silence._tables()] == [second.table]
silence.impose([first])
silence.lift([first, second])
assert not list(silence._tables())
"""

MANY = """
from checkpoint.linux.net import packet_drop as silence
connections = [silence.Connection(("10.0.0.1", port), ("10.0.0.2", 80)) for port in range(1, 401)]
silence.impose(connections)
assert {name for name, _ in silence._tables()} == {one.table for one in connections}
silence.lift(connections)
assert not list(silence._tables())
"""


@pytest.mark.parametrize("script", [SPENT, MANY], ids=["spent", "many"])
def test_tables_come_and_go_all_at_once(script: str) -> None:
    ran = subprocess.run(
        ["unshare", "--net", sys.executable, "-c", script], capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    assert ran.returncode == 0, ran.stderr
