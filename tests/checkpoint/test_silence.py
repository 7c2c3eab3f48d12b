"""Tables of connections that are kept silent: they end by themselves, and the next one clears them away."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.root

SPENT = """
from checkpoint.linux import silence
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


def test_what_has_no_effect_any_more_is_cleared_away_by_the_next() -> None:
    ran = subprocess.run(
        ["unshare", "--net", sys.executable, "-c", SPENT], capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    assert ran.returncode == 0, ran.stderr
