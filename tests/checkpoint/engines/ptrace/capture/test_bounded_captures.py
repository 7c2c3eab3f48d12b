"""A capture takes nothing with more rights than those of the component's owner, however the program came by more.

The program executes a set-user-id program: before a keeper looks at it, between a look and the freeze, between two captures, or
in a child. Its carried files are opened with its owner's rights, not with the rights that the program has by then.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, Session, Terms
from checkpoint.errors import CheckpointError, ProcessGoneError, RestoreError, UnsupportedError
from checkpoint.linux.user_rights import Eyes
from checkpoint.model import Snapshot
from checkpoint.resources.carried import restore
from checkpoint.resources.process import thread_credentials
from checkpoint.snapshot import carried_files
from checkpoint.snapshot.credentials import Owner
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    at_last,
    captured_and_killed,
    captured_at_last,
    ended,
    restored,
    start,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

ALICE = 7001
BOB = 7002
OWNER = Owner(ALICE, ALICE, (ALICE,))
SECRET = "a secret of root\n"
TRIES = 20
STEP_S = 0.01


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A directory of Alice's to which every user finds the way."""
    for folder in (tmp_path, *list(tmp_path.parents)[:3]):
        folder.chmod(folder.stat().st_mode | 0o111)
    made = tmp_path / "alice"
    made.mkdir()
    os.chown(made, ALICE, ALICE)
    return made


@pytest.fixture
def ordinary(compiled: Callable[..., Path], tmp_path: Path) -> Path:
    """The program without any rights of its own."""
    return Path(shutil.copy(compiled("becomes"), tmp_path / "becomes"))


def with_bits(program: Path, mode: int, uid: int = 0, gid: int = 0) -> Path:
    """The same as a program that lends rights."""
    made = Path(shutil.copy(program, program.with_name(f"lends-{mode:o}-{uid}-{gid}")))
    os.chown(made, uid, gid)
    made.chmod(mode)
    return made


@pytest.fixture
def lends(ordinary: Path) -> Path:
    return with_bits(ordinary, 0o4755)


@pytest.fixture
def program(ordinary: Path, lends: Path, place: Path) -> Iterator[Program]:
    """Alice's program, which may execute one of root's."""
    with ended(alices(ordinary, lends, place)) as started:
        yield started


def alices(ordinary: Path, lends: Path, place: Path) -> Program:
    become = [shutil.which("setpriv") or "setpriv", f"--reuid={ALICE}", f"--regid={ALICE}", "--clear-groups"]
    started = start([*become, ordinary, lends], place)
    started.wait_for_line(f"ready {ALICE} {ALICE} {ALICE}")
    return started


def terms(*paths: Path) -> Terms:
    return Terms(Carry(tuple(map(str, paths))), owner=OWNER)


def protect(program: Program, *paths: Path) -> Session:
    return at_last(lambda: ENGINE.protect(program.pid, ProtectOrder("/test/alices", terms=terms(*paths))))


def become_root(program: Program) -> None:
    """Have it execute the set-user-id program, and wait until it has."""
    (program.directory / "exec").touch()
    program.wait_for_line(f"became {ALICE} 0 0")


def of_files(snapshot: Snapshot) -> bytes:
    return b"".join(bytes(content) for pieces in carried_files.pieces(snapshot).values() for _, content in pieces)


def test_a_process_that_has_come_by_other_rights_is_not_protected(program: Program, place: Path) -> None:
    become_root(program)
    with pytest.raises(UnsupportedError, match=r"other rights than those of its owner, uid 7001: it has uid 0"):
        protect(program)


def test_a_process_that_comes_by_other_rights_between_the_look_and_the_freeze_is_not_captured(
    program: Program, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The keeper looks, the process executes the set-user-id program, the keeper enters and freezes it."""
    secret = place.parent / "secret"
    secret.write_text(SECRET)
    secret.chmod(0o600)
    look = thread_credentials.refuse

    def look_and_wait(pid: int, owner: Owner | None) -> tuple[str, ...]:
        found = look(pid, owner)
        if not found and "became" not in program.output:
            become_root(program)
        return found

    monkeypatch.setattr(thread_credentials, "refuse", look_and_wait)
    with pytest.raises(UnsupportedError) as refused:
        protect(program, secret)
    assert "cannot be read (Permission denied)" in str(refused.value), "it was read with the rights of that instant"
    session = protect_unseen(program, monkeypatch)
    try:
        with pytest.raises(UnsupportedError, match="it has uid 0"):
            captured_at_last(session, CaptureOrder())
    finally:
        session.close()


def protect_unseen(program: Program, monkeypatch: pytest.MonkeyPatch) -> Session:
    """As if it had had its owner's rights when it was looked at."""
    monkeypatch.setattr(thread_credentials, "refuse", lambda _pid, _owner: ())
    return protect(program)


def test_a_process_that_comes_by_other_rights_later_is_captured_no_more(program: Program) -> None:
    session = protect(program)
    try:
        captured_at_last(session, CaptureOrder())
        become_root(program)
        with pytest.raises(ProcessGoneError, match="become another program"):
            captured_at_last(session, CaptureOrder(sequence=2))
    finally:
        session.close()
    with pytest.raises(UnsupportedError, match="it has uid 0"):
        protect(program)


@pytest.mark.parametrize(("mode", "group", "told"), [(0o4755, 0, "uid 0"), (0o2755, 42, "gid 42")])
def test_a_component_is_not_captured_while_a_child_of_it_has_other_rights(
    ordinary: Path, place: Path, mode: int, group: int, told: str
) -> None:
    with ended(alices(ordinary, with_bits(ordinary, mode, gid=group), place)) as program:
        session = protect(program)
        try:
            captured_at_last(session, CaptureOrder())
            (place / "fork").touch()
            program.wait_until(lambda: "child" in program.output, "a child with other rights")
            with pytest.raises(UnsupportedError, match=f"other rights than those of its owner, uid 7001: it has {told}"):
                captured_at_last(session, CaptureOrder(sequence=2))
            (place / "end").touch()
            program.wait_for_line(f"alone {ALICE} {ALICE} {ALICE}")
            assert captured_at_last(session, CaptureOrder(sequence=3)).process.credentials.uids == (ALICE,) * 4
        finally:
            (place / "end").touch()
            session.close()
            program.wait_until(lambda: "alone" in program.output, "the child's end")


def test_what_the_kernel_lets_a_program_do_by_its_file_is_not_its_owners(ordinary: Path, place: Path) -> None:
    """Capabilities of a file: all of its uids are Alice's."""
    setcap = shutil.which("setcap") or "/usr/sbin/setcap"
    if not os.path.exists(setcap):
        pytest.skip("needs setcap: apt-get install libcap2-bin")
    lends = with_bits(ordinary, 0o755)
    subprocess.run([setcap, "cap_dac_read_search=ep", lends], check=True)
    with ended(alices(ordinary, lends, place)) as program:
        (place / "exec").touch()
        program.wait_for_line(f"became {ALICE} {ALICE} {ALICE}")
        with pytest.raises(UnsupportedError, match="it has capabilities 0x4"):
            protect(program)


@pytest.mark.parametrize("dumpable", [1, 2])
def test_a_program_whose_memory_its_user_may_not_read_comes_back_so(program: Program, place: Path, dumpable: int) -> None:
    """2: it has been a set-user-id program and gave its rights up, where fs.suid_dumpable is 2. Source: PR_SET_DUMPABLE."""
    base = captured_and_killed(program)
    for name in ("out", "err"):
        os.chown(place / name, ALICE, ALICE)
    base = replace(base, process=replace(base.process, dumpable=dumpable))
    with ended(restored(base, place, own_eyes=True)) as again:
        assert os.stat(f"/proc/{again.pid}/fd").st_uid == (ALICE if dumpable == 1 else 0)


def test_a_component_of_root_may_have_any_rights(program: Program) -> None:
    become_root(program)
    session = at_last(lambda: ENGINE.protect(program.pid, ProtectOrder("/test/roots")))
    try:
        assert captured_at_last(session, CaptureOrder()).process.credentials.uids == (ALICE, 0, 0, 0)
    finally:
        session.close()


def test_no_try_of_many_yields_what_its_owner_may_not_read(ordinary: Path, lends: Path, place: Path) -> None:
    """The program executes the set-user-id program at some instant of its protection: each capture has its owner's rights."""
    secret, own = place.parent / "secret", place / "own"
    secret.write_text(SECRET)
    secret.chmod(0o600)
    own.write_text("alice's\n")
    os.chown(own, ALICE, ALICE)
    taken = []
    for attempt in range(TRIES):
        with ended(alices(ordinary, lends, place)) as program:
            later = threading.Timer(attempt * STEP_S, (place / "exec").touch)
            if attempt:
                later.start()
            for path in (secret, own):
                taken += [snapshot] if (snapshot := captured_once(program, path)) else []
            later.cancel()
        for name in ("exec", "out", "err"):
            (place / name).unlink(missing_ok=True)
    assert taken, "none was captured"
    for snapshot in taken:
        assert set(snapshot.process.credentials.uids) == {ALICE}
        assert SECRET.encode() not in of_files(snapshot)


def captured_once(program: Program, path: Path) -> Snapshot | None:
    """One snapshot with a carried path, if there can be one."""
    try:
        session = protect(program, path)
    except CheckpointError:
        return None
    try:
        return captured_at_last(session, CaptureOrder())
    except CheckpointError:
        return None
    finally:
        session.close()


def test_a_user_carries_no_file_of_another_users(program: Program, place: Path) -> None:
    """At the other robot it would become that user's own."""
    theirs = place / "theirs"
    theirs.write_text("bob's, for all to read\n")
    theirs.chmod(0o644)
    os.chown(theirs, BOB, BOB)
    with pytest.raises(UnsupportedError, match=r"theirs belongs to uid 7002, gid 7002, which uid 7001 can give no file to"):
        protect(program, place)
    os.chown(theirs, ALICE, ALICE)
    session = protect(program, place / "theirs")
    try:
        snapshot = captured_at_last(session, CaptureOrder())
        assert b"for all to read" in of_files(snapshot)
    finally:
        session.close()
    theirs.unlink()
    restore.lay_down(snapshot, Eyes(ALICE, ALICE, (ALICE,)), frozenset())
    about = theirs.stat()
    assert (about.st_uid, about.st_gid, stat.S_IMODE(about.st_mode)) == (ALICE, ALICE, 0o644)


def test_a_file_that_cannot_have_its_owner_is_not_laid_down_for_another_user(program: Program, place: Path) -> None:
    """As a snapshot of an earlier version tells it."""
    own = place / "own"
    own.write_text("root's\n")
    session = at_last(lambda: ENGINE.protect(program.pid, ProtectOrder("/test/roots", terms=Terms(Carry((str(own),))))))
    try:
        snapshot = captured_at_last(session, CaptureOrder())
    finally:
        session.close()
    own.unlink()
    with pytest.raises(RestoreError, match="it would belong to uid 7001, not to its owner"):
        restore.lay_down(snapshot, Eyes(ALICE, ALICE, (ALICE,)), frozenset())
    assert list(place.glob("own")) == []
