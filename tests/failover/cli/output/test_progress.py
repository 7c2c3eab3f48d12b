"""Progress where a person waits: one line that moves on a terminal, seldom a plain one elsewhere, none of a short wait."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
from pathlib import Path

from failover.cli.output import progress
from failover.cli.output.progress import Progress, of_reading, share


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def told_for(stream: io.StringIO, clock: Clock, seconds: int, *, is_quiet: bool = False) -> str:
    """What is written in a wait of so long, that is told of sixteen times a second."""
    with Progress(is_quiet=is_quiet, stream=stream, now=clock) as shown:
        for step in range(16 * seconds):
            shown.tell(f"step {step}")
            clock.now_s += 1 / 16
    return stream.getvalue()


def test_on_a_terminal_one_line_moves_and_is_gone_at_the_end() -> None:
    told = told_for(Terminal(), Clock(), 3)
    assert "\n" not in told and told.startswith("\rstep 16") and told.endswith("\r\x1b[K")
    assert told.count("step") == 16, "at most ten times a second"


def test_a_line_that_is_too_long_for_the_terminal_is_cut() -> None:
    stream, clock = Terminal(), Clock()
    with Progress(stream=stream, now=clock) as shown:
        clock.now_s += progress.PATIENCE_S
        shown.tell("long " * 50)
    assert len(stream.getvalue().partition("\x1b")[0]) == progress.COLUMNS  # with the \r


def test_elsewhere_a_line_comes_every_five_seconds() -> None:
    assert told_for(io.StringIO(), Clock(), 12).splitlines() == ["step 16", "step 96", "step 176"]


def test_nothing_is_told_of_a_short_wait_nor_with_json() -> None:
    assert told_for(Terminal(), Clock(), 1) == told_for(io.StringIO(), Clock(), 1) == ""
    assert told_for(Terminal(), Clock(), 9, is_quiet=True) == ""


def test_what_has_not_changed_is_told_once_elsewhere() -> None:
    stream, clock = io.StringIO(), Clock()
    with Progress(stream=stream, now=clock) as shown:
        for _ in range(400):
            shown.tell("waits")
            clock.now_s += 0.05
    assert stream.getvalue() == "waits\n"


def test_a_share_is_never_more_than_the_whole() -> None:
    assert share(512_000_000, 2_000_000_000) == "512.0 MB of 2.0 GB (25 %)"
    assert share(9, 8).endswith("(100 %)") and share(0, 0).endswith("(0 %)")


READING = """
import os, sys
file = os.open(sys.argv[1], os.O_RDONLY)
for offset in range(0, 8 << 20, 1 << 20):
    os.pread(file, 1 << 20, offset)
    print(offset, flush=True)
    sys.stdin.readline()
"""


def test_what_another_process_has_read_of_a_file_is_told(tmp_path: Path) -> None:
    size = 8 << 20
    (tmp_path / "large").write_bytes(os.urandom(size))
    stream, clock = Terminal(), Clock()
    command = [sys.executable, "-S", "-c", READING, str(tmp_path / "large")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdin is not None and reader.stdout is not None
        reader.stdout.readline()
        with Progress(stream=stream, now=clock) as shown, of_reading(reader.pid, "reading", size, shown):
            clock.now_s += progress.PATIENCE_S
            for part in range(1, 5):
                reader.stdin.write("\n")
                reader.stdin.flush()
                reader.stdout.readline()
                clock.now_s += progress.PATIENCE_S
                until_s = time.monotonic() + 60
                while f"({100 * part // 8} %)" not in stream.getvalue() and time.monotonic() < until_s:
                    clock.now_s += progress.MOVES_S
                    time.sleep(0.01)
        reader.kill()
    for part in range(1, 5):
        assert f"({100 * part // 8} %)" in stream.getvalue(), stream.getvalue()
