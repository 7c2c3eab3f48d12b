"""The programs of the demo: ordinary, unprepared ones, whose output depends on nothing but themselves."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from msgspec import Struct

LINES: Final = 400
PAUSE_S: Final = 0.015
"""Between two lines of the Python program: together with the arithmetic some ten seconds."""

PI_LINE_SIZE: Final = 39

PI: Final = '''\
"""Ten digits of pi a line, by Gibbons' unbounded spigot, and a running digest over all of them so far."""

import hashlib
import time

LINES, PAUSE = %d, %r


def digits():
    q, r, t, k, n, l = 1, 0, 1, 1, 3, 3
    while True:
        if 4 * q + r - t < n * t:
            yield n
            q, r, n = 10 * q, 10 * (r - n * t), 10 * (3 * q + r) // t - 10 * n
        else:
            q, r, t, k, n, l = q * k, (2 * q + r) * l, t * l, k + 1, (q * (7 * k + 2) + r * l) // (t * l), l + 2


source = digits()
digest = hashlib.sha256()
for line in range(1, LINES + 1):
    ten = "".join(str(next(source)) for _ in range(10))
    digest.update(ten.encode())
    print(f"pi {line * 10:5}  {ten}  {digest.hexdigest()[:16]}", flush=True)
    time.sleep(PAUSE)
'''

POINTS: Final = 400
STEPS: Final = 3500
"""Of arithmetic before each line of the other program: some ten seconds as well."""

POINT_SIZE: Final = 63
"""Bytes of a line, on the average."""

BC: Final = """\
# The logistic map in its chaotic range: one wrong digit anywhere changes everything that follows.
scale = 50
x = 0.4
for (i = 1; i <= %d; i++) {
  for (j = 0; j < %d; j++) x = 3.99 * x * (1 - x)
  print "chaos ", i, "  ", x, "\n"
}
quit
"""


class Program(Struct, frozen=True):
    """One program to protect.

    Attributes:
        name: of the component.
        title: how the demo speaks of it.
        argv: the command line to execute.
        directory: where to execute it; its files lie there.
        expected_size: bytes that it writes in all, near enough for a progress bar.
    """

    name: str
    title: str
    argv: tuple[str, ...]
    directory: Path
    expected_size: int

    def undisturbed(self, environment: dict[str, str]) -> subprocess.Popen[bytes]:
        """Start it as a user would, politely, its output going to a file: see `reference`."""
        with self.reference.open("wb") as output:
            return subprocess.Popen(
                ["nice", "-n", "10", *self.argv],
                cwd=self.directory,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def reference(self) -> Path:
        """Where the undisturbed run writes."""
        return self.directory / f"{self.title}.undisturbed"


def write(directory: Path, length: int = 1) -> tuple[Program, ...]:
    """Write the programs' files; returns those that this machine can run.

    Args:
        length: how many times the usual time they take. Their output stays as long.
    """
    python = getattr(sys, "_base_executable", None) or sys.executable
    (directory / "pi.py").write_text(PI % (LINES, PAUSE_S * length))
    found = [Program("/demo/pi", "pi", (python, "pi.py"), directory, LINES * PI_LINE_SIZE)]
    bc = shutil.which("bc")
    if bc is not None:
        (directory / "chaos.bc").write_text(BC % (POINTS, STEPS * length))
        found.append(Program("/demo/chaos", "chaos", (bc, "-q", "chaos.bc"), directory, POINTS * POINT_SIZE))
    return tuple(found)
