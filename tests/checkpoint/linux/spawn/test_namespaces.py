"""A new vessel: it inherits no descriptor from its maker, whichever features the kernel has."""

from __future__ import annotations

import subprocess
import sys

import pytest

from checkpoint.linux.spawn import namespaces

UNKNOWN_CALL = 1 << 20
BORN = """
import os, sys
from checkpoint.linux.spawn import namespaces
namespaces._SYS_CLOSE_RANGE = int(sys.argv[1])
for number in (40, 41, 42, 43):
    os.dup2(0, number, inheritable=True)
namespaces.close_others_on_exec(42)
os.execv("/bin/sh", ["sh", "-c", "for n in 40 41 42 43; do test -e /proc/self/fd/$n && echo $n; done; :"])
"""


@pytest.mark.parametrize("number", [namespaces._SYS_CLOSE_RANGE, UNKNOWN_CALL], ids=["all at once", "one by one"])
def test_a_program_that_is_executed_has_the_first_descriptors_only(number: int) -> None:
    told = subprocess.run([sys.executable, "-c", BORN, str(number)], capture_output=True, text=True, check=True, timeout=60)
    assert told.stdout.split() == ["40", "41"]
