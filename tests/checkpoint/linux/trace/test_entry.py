"""The first entry into a program, where some step of it fails on our side: nothing of ours stays inside."""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.spawn import vdso
from checkpoint.linux.trace import entry
from tests.checkpoint.round_trip import ENGINE, Program, captured, captured_at_last, ended, protected, start


def test_of_a_keeper_without_a_descriptor_left_none_stays_in_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It finds what is written without write protection, and says why."""

    def none_left(_tid: int) -> int:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    sleeps = "import time; print('ready', flush=True); time.sleep(600)"
    with ended(start([sys.executable, "-S", "-c", sleeps], tmp_path)) as program:
        program.wait_for_line("ready")
        had = sorted(os.listdir(f"/proc/{program.pid}/fd"))
        with monkeypatch.context() as patched:
            patched.setattr(entry, "pidfd_of", none_left)
            for _ in "enter", "enter again":
                with protected(program) as session:
                    assert any("Too many open files" in note for note in session.notes)
                    assert entry.left_open(program.pid) == ()
        assert sorted(os.listdir(f"/proc/{program.pid}/fd")) == had
        captured(program)


FEW = 64
"""Zeros behind the image, on a kernel whose vdso fills its page; aarch64's before 6.12 have too few."""
COUNTS = "import time; print('ready', flush=True)\nwhile True: time.sleep(0.01)"


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    with ended(start([sys.executable, "-S", "-c", COUNTS], tmp_path)) as found:
        found.wait_for_line("ready")
        yield found


def few_zeros(memory: Memory, maps: Sequence[MapsLine]) -> tuple[range, range]:
    _, unread = ROOMS(memory, maps)
    return unread[-FEW:], unread


ROOMS, WAIT = entry.vdso_rooms, entry._wait_in_call


def image_of(pid: int) -> bytes:
    line = next(line for line in procfs.parse_maps(procfs.read_text(pid, "maps")) if line.name == "[vdso]")
    return Memory(pid).read(line.start, line.size)


def test_a_vdso_without_zeros_enough_lends_what_no_program_reads_of_it(program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    before, meanwhile = image_of(program.pid), []

    def look(*arguments: Any) -> None:
        WAIT(*arguments)
        meanwhile.append(image_of(program.pid))

    monkeypatch.setattr(entry, "vdso_rooms", few_zeros)
    monkeypatch.setattr(entry, "_wait_in_call", look)
    captured(program)
    used, whole = vdso.ends(before)
    assert meanwhile and all(image[used:whole] != before[used:whole] and image[:used] == before[:used] for image in meanwhile)
    assert image_of(program.pid) == before


def test_a_keeper_that_dies_in_there_leaves_a_program_that_goes_on_and_can_be_protected_again(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = image_of(program.pid)
    used, whole = vdso.ends(before)
    monkeypatch.setattr(entry, "vdso_rooms", few_zeros)
    keeper = os.fork()
    if not keeper:
        monkeypatch.setattr(entry, "_wait_in_call", die_waiting)
        with suppress(BaseException):
            ENGINE.protect(program.pid, ProtectOrder("/test/counts"))
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(keeper, 0)[1]) == -signal.SIGKILL
    assert image_of(program.pid)[used:whole] != before[used:whole]
    stands_at = int(procfs.read_text(program.pid, "syscall").split()[-1], 16)
    assert entry.is_in_stub(stands_at, Memory(program.pid), procfs.parse_maps(procfs.read_text(program.pid, "maps")))
    with protected(program) as session:  # waits until the program has left our code by itself
        captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
    assert image_of(program.pid)[:used] == before[:used]
    captured(program)


def die_waiting(*arguments: Any) -> None:
    WAIT(*arguments)
    os.kill(os.getpid(), signal.SIGKILL)


def test_what_programs_use_of_the_vdso_ends_before_what_only_debuggers_read() -> None:
    image = image_of(os.getpid())
    used, whole = vdso.ends(image)
    assert max(one.offset + one.size for one in vdso.functions(image)) <= used < whole <= len(image)
    assert not any(image[whole:])
