"""Names of processes and of mapped files that look like lines of the kernel's."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from checkpoint.linux.procfs import procfs
from tests.checkpoint.round_trip import ended, expect_three_lives, start

TELLS_LINES_OF_ITSELF = """
import ctypes, mmap, os, sys, time
libc = ctypes.CDLL(None)
libc.prctl(15, sys.argv[1].encode(), 0, 0, 0)
with open("odd\\r7f00-\\x85\\x0c name", "w+b") as file:
    file.write(b"content")
    file.flush()
    mapped = mmap.mmap(file.fileno(), 7)
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.01)
name = ctypes.create_string_buffer(16)
libc.prctl(16, name, 0, 0, 0)
print("ok" if mapped[:] == b"content" and name.value == sys.argv[1].encode() else repr((mapped[:], name.value)))
"""
NAMES = ["a\rUid:\t7 7 7 7", " \\n\n\\\\ \x1cb ", "\x0bPid:\t1"]


@pytest.mark.root
@pytest.mark.parametrize("name", NAMES)
def test_a_name_with_ends_of_lines_is_kept(name: str, tmp_path: Path) -> None:
    program = start([sys.executable, "-c", TELLS_LINES_OF_ITSELF, name], tmp_path)
    program.wait_for_line("ready")
    expect_three_lives(program, tmp_path)


@pytest.mark.parametrize("name", NAMES)
def test_a_process_tells_nothing_of_itself_by_its_name(name: str, tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", TELLS_LINES_OF_ITSELF, name], tmp_path)) as program:
        program.wait_for_line("ready")
        status = procfs.status(program.pid)
        assert status.name == name
        assert status.uids == (os.getuid(),) * 4
        assert status.pids[0] == program.pid
