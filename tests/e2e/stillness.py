"""Measures how long the machine itself stood still: by processes that no process of ours can delay, one on each processor."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

PRIORITY: Final = 70
"""Above a main loop's."""

WATCHMAN: Final = """
import os, signal, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(sys.argv[2])))
is_over, longest = False, 0.0
def end(number, frame):
    global is_over
    is_over = True
signal.signal(signal.SIGTERM, end)
print("ready", flush=True)
while not is_over:
    began = time.monotonic()
    time.sleep(0.005)
    longest = max(longest, time.monotonic() - began - 0.005)
print(longest, flush=True)
"""


@dataclass
class Stillness:
    """The longest, in milliseconds; known when the watch is over."""

    longest_ms: float = 0.0


@contextmanager
def watched() -> Iterator[Stillness]:
    """Watch each processor while the body runs. Needs the right to real-time priority."""
    found = Stillness()
    command = [sys.executable, "-S", "-c", WATCHMAN]
    watchmen = [
        subprocess.Popen([*command, str(cpu), str(PRIORITY)], stdout=subprocess.PIPE, text=True)
        for cpu in os.sched_getaffinity(0)
    ]
    try:
        for watchman in watchmen:
            assert watchman.stdout is not None and watchman.stdout.readline() == "ready\n"
        yield found
    finally:
        for watchman in watchmen:
            watchman.terminate()
        said = [watchman.communicate()[0] for watchman in watchmen]
    found.longest_ms = max(float(one) for one in said) * 1e3
