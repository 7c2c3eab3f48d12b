"""How much a program has written by its commit, where the guard that counts does not catch up."""

from __future__ import annotations

import subprocess
import sys

STUCK = """
import os, sys
from checkpoint.segment.output_counters import COUNTERS
from failover.kept_state.output import OwnOutput
counters = os.memfd_create("counters")
os.pwrite(counters, COUNTERS.pack(1, 7, 0, 0, 0, 0), 0)
output = OwnOutput(counters)
sys.stdout.write("four")
found = [output.totals(), output.totals()]
os.pwrite(counters, COUNTERS.pack(0, 7, 0, 0, 0, 0), 0)
found.append(output.totals())
sys.stderr.write(repr(found))
"""


def test_a_guard_that_stopped_while_it_counted_leaves_the_count_pending_until_it_goes_on() -> None:
    with subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None and program.stderr is not None
        assert program.stderr.read() == "[<Pending.PENDING: 2>, <Pending.PENDING: 2>, (11, 0)]"
        assert program.stdout.read() == "four", "flushed, and counted while it was unread"
