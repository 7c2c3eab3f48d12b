"""The login to which a program belongs is kept where the kernel permits it, and reported where it does not."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.arch import stubs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources.process import audit_login
from checkpoint.resources.process.audit_login import NOBODY
from tests.checkpoint.engines.ptrace.restore.families import goes_through_three_lives
from tests.checkpoint.round_trip import NOBODY as NOBODY_ELSE
from tests.checkpoint.round_trip import captured_and_killed, ended, expect_ok, restored, start_tracee

LOGIN = 4321
PROGRAM = f"""
def say(login):
    Path("/proc/self/loginuid").write_text(str(login))

def follow():
    say({LOGIN + 1})
    os.write(write_end, b".")
    wait_for_go()
    expect("the child's login", Path("/proc/self/loginuid").read_text(), "{LOGIN + 1}")

read_end, write_end = os.pipe()
child = born(follow)
os.read(read_end, 1)
say({LOGIN})
is_ready()
expect("the login", Path("/proc/self/loginuid").read_text(), "{LOGIN}")
expect_child(child)
print("ok", flush=True)
"""


def has_no_login() -> bool:
    """Whether nobody has logged in to run these tests, and the kernel has an audit."""
    return os.path.exists("/proc/self/loginuid") and audit_login.login_of(os.getpid()) == (NOBODY, NOBODY)


@pytest.mark.root
@pytest.mark.skipif(not has_no_login(), reason="somebody has logged in, or this kernel has no audit")
def test_each_process_of_a_program_keeps_the_user_of_its_login(tmp_path: Path) -> None:
    goes_through_three_lives(PROGRAM, tmp_path)


@pytest.mark.root
@pytest.mark.compiler
@pytest.mark.skipif(not has_no_login(), reason="somebody has logged in, or this kernel has no audit")
def test_a_users_program_keeps_it_where_its_files_are_opened_with_his_own_eyes(compiled: Callable[..., Path]) -> None:
    """The vessel's file of /proc is root's: it may not be looked into, since it sees with other eyes."""
    with tempfile.TemporaryDirectory() as made:
        place = Path(made)
        place.chmod(0o755)
        program = Path(shutil.copy(compiled("login", "-O2"), place))
        with ended(start_tracee(program, place, str(LOGIN), str(NOBODY_ELSE))) as tracee:
            for name in ("out", "err"):
                (place / name).chmod(0o666)
            snapshot = captured_and_killed(tracee)
        with ended(restored(snapshot, place, own_eyes=True)) as tracee:
            tracee.tell()
            expect_ok(tracee)


@pytest.mark.skipif(not has_no_login(), reason="somebody has logged in, or this kernel has no audit")
@pytest.mark.parametrize(
    ("login", "session", "calls", "notes"),
    [
        (NOBODY, NOBODY, [], []),
        (LOGIN, NOBODY, ["openat", "write", "close"], []),
        (LOGIN, 7, ["openat", "write", "close"], ["the number of its audit session is not kept: it was 7"]),
    ],
    ids=["nobody's", "a user's", "a session's"],
)
def test_what_is_made_of_a_login(login: int, session: int, calls: list[str], notes: list[str]) -> None:
    table = CallTable(1 << 20, descriptors={0, 1, 2})
    told = [Resource(audit_login.KIND, "login", {"descriptors": [], "user": login, "session": session})]
    assert audit_login.rebuild(table, told, os.getpid()) == notes
    assert [call.number for call in table.calls] == [stubs.SYSTEM_CALLS[name] for name in calls]
    assert [call.lost for call in table.calls if call.lost] == [
        f"the user of its login (loginuid {LOGIN}) is not kept: that takes CAP_AUDIT_CONTROL here" for _ in calls[:1]
    ]
