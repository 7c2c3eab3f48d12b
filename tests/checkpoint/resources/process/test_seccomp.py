"""Programs that have confined themselves by seccomp(2): captured in spite of their filters, and under the same ones again."""

from __future__ import annotations

import ctypes
import os
import shutil
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from checkpoint.arch import stubs
from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.capture.memory import RunningCopy
from checkpoint.engines.ptrace.capture.session import PtraceSession
from checkpoint.errors import UnsupportedError
from checkpoint.linux.spawn import bpf
from checkpoint.linux.trace import seccomp
from checkpoint.resources.process.thread_credentials import ThreadRights
from tests.checkpoint.round_trip import (
    as_nobody,
    captured,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    expect_three_lives,
    protected,
    restored,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]


@pytest.fixture(autouse=True)
def _suspendable() -> None:
    if why := seccomp.why_not():
        pytest.skip(why)


@pytest.mark.parametrize("kind", ["stack", "user", "thread", "all", "family"])
def test_a_confined_program_is_captured_in_spite_of_its_filters_and_restored_under_them(
    kind: str, compiled: Compiled, tmp_path: Path
) -> None:
    tmp_path.chmod(0o777)
    expect_three_lives(start_tracee(compiled("confined", "-O2", "-pthread"), tmp_path, kind, isolate=kind == "family"), tmp_path)


def test_filters_come_back_where_files_are_opened_with_the_users_own_eyes(compiled: Compiled) -> None:
    with tempfile.TemporaryDirectory() as made:
        place = Path(made)
        program = shutil.copy(compiled("confined", "-O2", "-pthread"), place)
        with ended(start_tracee(Path(program), place, "user")) as tracee:
            for name in ("out", "err"):
                (place / name).chmod(0o666)
            snapshot = captured_and_killed(tracee)
        with ended(restored(snapshot, place, own_eyes=True)) as tracee:
            tracee.tell()
            expect_ok(tracee)


def test_a_program_in_the_strict_mode_is_captured_and_restored_in_it(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("sandboxed", "-O2"), tmp_path)) as tracee:
        tracee.tell()
        tracee.wait_for_output(100)
        captured(tracee)
        tracee.wait_for_output((tmp_path / "out").stat().st_size)
        snapshot = captured_and_killed(tracee)
    with ended(restored(snapshot, tmp_path)) as tracee:
        tracee.wait_for_output((tmp_path / "out").stat().st_size)
        assert b"\nSeccomp:\t1\n" in Path(f"/proc/{tracee.pid}/status").read_bytes()


def test_a_program_that_confines_itself_while_it_is_protected_is_captured_from_then_on_too(
    compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("sandboxed", "-O2"), tmp_path)) as tracee, protected(tracee) as session:
        assert [held for held in captured_at_last(session, CaptureOrder()).resources if held.kind == "seccomp"] == []
        tracee.tell()
        tracee.wait_for_output(100)
        told = [held for held in captured_at_last(session, CaptureOrder()).resources if held.kind == "seccomp"]
        assert [held.facts["threads"] for held in told] == [[[tracee.pid, True, []]]]
        tracee.wait_for_output((tmp_path / "out").stat().st_size)


def test_one_thread_that_confines_itself_alone_between_captures_is_captured_with_its_filter(
    compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("confined", "-O2", "-pthread"), tmp_path, "late")) as tracee:
        with protected(tracee) as session:
            captured_at_last(session, CaptureOrder())
            (tmp_path / "confine").touch()
            tracee.wait_for_line("confined")
            for _ in range(3):
                snapshot = captured_at_last(session, CaptureOrder())
            assert "seccomp" in [held.kind for held in snapshot.resources]
        tracee.tell()
        expect_ok(tracee)


def test_one_thread_that_confines_itself_after_all_were_looked_at_is_not_killed_by_our_questions(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ended(start_tracee(compiled("confined", "-O2", "-pthread"), tmp_path, "late")) as tracee:
        with protected(tracee) as session:
            captured_at_last(session, CaptureOrder())
            monkeypatch.setattr(ThreadRights, "prepare", lambda rights: None)  # what was looked up dates from before
            (tmp_path / "confine").touch()
            tracee.wait_for_line("confined")
            snapshot = captured_at_last(session, CaptureOrder())
            assert "seccomp" in [held.kind for held in snapshot.resources]
        tracee.tell()
        expect_ok(tracee)


def test_one_thread_that_confines_itself_while_everything_is_copied_is_known_to_be_confined(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ended(start_tracee(compiled("confined", "-O2", "-pthread"), tmp_path, "late")) as tracee:
        with protected(tracee) as session:
            assert isinstance(session, PtraceSession)
            first = session._first
            copy = first.memory.copy_running

            def slowly(**named: Any) -> RunningCopy:
                (tmp_path / "confine").touch()
                tracee.wait_for_line("confined")
                return copy(**named)

            monkeypatch.setattr(first.memory, "copy_running", slowly)
            captured_at_last(session, CaptureOrder())
            assert list(first.onlooker.rights.modes.values()) == [seccomp.FILTERED]
        tracee.tell()
        expect_ok(tracee)


def test_a_filter_that_asks_another_process_is_refused_by_name(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("confined", "-O2", "-pthread"), tmp_path, "notified")) as tracee:
        with pytest.raises(UnsupportedError, match="SECCOMP_RET_USER_NOTIF"), protected(tracee):
            raise AssertionError("it was protected")
        tracee.tell()
        expect_ok(tracee)


def test_who_may_not_suspend_a_filter_is_told_what_it_takes() -> None:
    def asked() -> str:
        seccomp.why_not.cache_clear()
        return seccomp.why_not()

    assert "CAP_SYS_ADMIN" in as_nobody(asked)


RETURN = 0x06
YES, NO = (RETURN, 0, 0, 0x7FFF0000), (RETURN, 0, 0, 0x80000000)
NUMBER = (0x20, 0, 0, 0)
"""The instruction that loads a call's number."""


@pytest.mark.parametrize(
    ("instructions", "number", "expected"),
    [
        ([YES], 219, True),
        ([NO], 219, False),
        ([NUMBER, (0x15, 0, 1, 219), NO, YES], 219, False),
        ([NUMBER, (0x15, 0, 1, 219), NO, YES], 35, True),
        ([NUMBER, (0x35, 1, 0, 200), YES, NO], 219, False),
        ([NUMBER, (0x25, 0, 1, 219), NO, YES], 219, True),
        ([NUMBER, (0x07, 0, 0, 0), (0x00, 0, 0, NO[3]), (0x05, 0, 0, 1), YES, (0x16, 0, 0, 0)], 1, False),
        ([NUMBER, (0x02, 0, 0, 3), (0x61, 0, 0, 3), (0x87, 0, 0, 0), (0x15, 0, 1, 7), NO, YES], 7, False),
        ([NUMBER, (0x54, 0, 0, 4), (0x64, 0, 0, 2), (0x15, 0, 1, 16), YES, NO], 7, True),
    ],
)
def test_our_reading_of_a_filter_is_the_kernels(
    instructions: list[tuple[int, int, int, int]], number: int, expected: bool
) -> None:
    program = code(*instructions)
    assert bpf.allows([program], number, 0xC000003E, (0,) * 6) is expected
    assert _kernel_allows(program, number) is expected


def code(*instructions: tuple[int, int, int, int]) -> bytes:
    """As the kernel takes it."""
    return b"".join(struct.pack("<HBBI", *one) for one in instructions)


def _kernel_allows(program: bytes, number: int) -> bool:
    """Whether a child of ours that is under the filter lives on after the call; everything else it may call."""
    wanted = code(NUMBER, (0x15, 0, len(program) // 8, number)) + program + code(YES)
    content = ctypes.create_string_buffer(wanted)
    about = struct.pack("<HxxxxxxQ", len(wanted) // 8, ctypes.addressof(content))
    libc = ctypes.CDLL(None)
    child = os.fork()
    if child == 0:
        libc.prctl(4, 0, 0, 0, 0)  # PR_SET_DUMPABLE: no core
        if libc.syscall(stubs.SYSTEM_CALLS["seccomp"], 1, 0, about) == 0:
            libc.syscall(number, -1, 0, 0, 0, 0, 0)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
