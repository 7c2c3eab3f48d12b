"""What a program and its children use of the machine, looked at while they run."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from failover.client.process_use import Meter, Use

TWO = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-S", "-c", "print('ready', flush=True)\\nwhile True: pass"])
memory = bytearray(b"x") * 50_000_000
sys.stdin.read()
child.kill()
child.wait()
"""
PATIENCE_S = 60.0
TICK_S = 1 / os.sysconf("SC_CLK_TCK")  # the grain of the processor times


@contextmanager
def two_processes() -> Iterator[int]:
    """One with 50 MB, and its child, which calculates."""
    with subprocess.Popen([sys.executable, "-S", "-c", TWO], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"ready\n"
        yield program.pid
        program.communicate()


def until(meter: Meter, pid: int, least: float) -> Use:
    """Until it has used so much of a core since the look before, which a busy machine may give it late."""
    deadline = time.monotonic() + PATIENCE_S
    while (use := meter.of(pid)) is None or use.cpu < least or use.memory < 50_000_000:
        assert time.monotonic() < deadline, use
        time.sleep(0.05)
    return use


def test_a_program_and_its_child_are_counted_together_and_only_since_the_last_look() -> None:
    meter = Meter()
    with two_processes() as pid:
        assert until(meter, pid, 0.05).processes == 2
        began = time.monotonic()
        assert meter.of(pid) is not None
        looked = time.monotonic()
        time.sleep(0.5)
        again = time.monotonic()
        use = meter.of(pid)
        assert use is not None
        at_most = time.monotonic() - began + 2 * TICK_S
        assert use.cpu * (again - looked) <= at_most, "the parent waits, and one loop has one core"
    assert meter.of(pid) is None, "it has ended"


def test_a_program_that_waits_uses_nothing_once_it_waits() -> None:
    meter = Meter()
    with subprocess.Popen(["/bin/sleep", "1000"]) as program:
        deadline = time.monotonic() + PATIENCE_S
        while (use := meter.of(program.pid)) is None or use.cpu:  # its execve is still under way
            assert time.monotonic() < deadline, use
            time.sleep(0.1)
        program.kill()
    assert (use.cpu, use.processes) == (0, 1)
    assert use.memory > 0
