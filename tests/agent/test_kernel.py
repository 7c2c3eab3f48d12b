"""What the heart and the guards ask of the kernel for themselves."""

from __future__ import annotations

import subprocess
import sys
from typing import Final

import pytest

LOCKED: Final = """
import threading
from agent import kernel
kernel.small_stacks()
try:
    kernel.lock_memory()
except OSError:
    print("not allowed")
    raise SystemExit
def resident_kb():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmRSS:"))
before = resident_kb()
go = threading.Event()
threads = [threading.Thread(target=go.wait) for _ in range(2)]
for thread in threads:
    thread.start()
print(resident_kb() - before)
go.set()
for thread in threads:
    thread.join()
"""


def test_two_threads_of_a_process_that_is_locked_take_little_memory() -> None:
    found = subprocess.run([sys.executable, "-c", LOCKED], capture_output=True, text=True, check=True, timeout=60).stdout
    if "not allowed" in found:
        pytest.skip("this user may not lock memory")
    assert int(found) < 4096
