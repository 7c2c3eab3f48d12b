"""Where a restore lays carried files down: what stood there is kept, rights are the owner's, and what fails changes nothing."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import subprocess
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from checkpoint.errors import MismatchError, RestoreError
from checkpoint.linux.user_rights import Eyes
from checkpoint.model import Snapshot
from checkpoint.resources.carried import attributes, restore, reversible_moves
from checkpoint.resources.carried.capture import CarriedTrees
from checkpoint.snapshot import carried_files
from tests.checkpoint import round_trip
from tests.checkpoint.resources.carried.carrying import asleep, carrying, contents, once_more, portrait
from tests.checkpoint.round_trip import ended, restored


def test_what_stood_there_is_kept_and_never_overwritten(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    (folder / "state").write_text("of the checkpoint")
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        state = once_more(session, 1)
    for attempt in range(restore.KEPT_COUNT + 2):
        (folder / "state").write_text(f"newer, by somebody else, {attempt}")
        (folder / "another").write_text("his, too")
        with ended(restored(state, tmp_path)):
            assert {path.name: path.read_text() for path in folder.iterdir()} == {"state": "of the checkpoint"}
    sets = sorted((tmp_path / ".failover-kept-kept").iterdir())
    kept = [(one / "kept" / "state").read_text().rpartition(" ")[2] for one in sets]
    assert kept == ["2", "3", "4", "5"]
    assert all((one / "kept" / "another").exists() for one in sets)
    with ended(restored(state, tmp_path)):
        assert len(list((tmp_path / ".failover-kept-kept").iterdir())) == len(sets), "what was right was replaced"


@pytest.mark.parametrize("is_link", [True, False], ids=["a link", "a folder that all may write"])
def test_what_somebody_else_has_put_where_replaced_files_are_kept_is_left_alone(tmp_path: Path, is_link: bool) -> None:
    path, his, trap = tmp_path / "state", tmp_path / "his", tmp_path / ".failover-kept-state"
    path.write_text("of the checkpoint")
    with asleep(tmp_path) as program, carrying(program, path) as session:
        state = once_more(session, 1)
    (his if is_link else trap).mkdir()
    trap.symlink_to(his) if is_link else trap.chmod(0o777)
    wanted = {str(number) for number in range(2 * restore.KEPT_COUNT)}
    for name in wanted:
        (trap / name).mkdir()
    path.write_text("newer")
    with ended(restored(state, tmp_path)):
        assert path.read_text() == "of the checkpoint"
    assert {one.name for one in trap.iterdir()} == wanted
    (kept,) = tmp_path.glob(".failover-kept-state-*/*/state")
    assert kept.read_text() == "newer"


def test_a_path_where_nothing_stood_is_empty_again(tmp_path: Path) -> None:
    path = tmp_path / "later"
    with asleep(tmp_path) as program, carrying(program, path) as session:
        state = once_more(session, 1)
        path.write_text("after the checkpoint")
        program.kill()
    with ended(restored(state, tmp_path)):
        assert not path.exists()
        (kept,) = (tmp_path / ".failover-kept-later").iterdir()
        assert (kept / "later").read_text() == "after the checkpoint"


def test_a_file_that_another_process_writes_to_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("one")
    with asleep(tmp_path) as program, carrying(program, path) as session:
        state = once_more(session, 1)
    path.write_text("two")
    writer = subprocess.Popen(["sleep", "1000"], stdout=path.open("ab"))
    try:
        with pytest.raises(MismatchError, match=f"is held open for writing by pid {writer.pid}"):
            restored(state, tmp_path)
        assert path.read_text() == "two"
    finally:
        writer.kill()
        writer.wait()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: a small file system is mounted")
def test_a_full_disk_changes_nothing_and_is_said(tmp_path: Path) -> None:
    folder = tmp_path / "mount"
    folder.mkdir()
    (folder / "state").write_bytes(os.urandom(4 << 20))
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        state = once_more(session, 1)
    shutil.rmtree(folder)
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", folder], check=True)
    try:
        (folder / "his").write_text("stays")
        with pytest.raises(RestoreError, match=r"need 4096 KiB and .* KiB free: make room there"):
            restored(state, tmp_path)
        assert [path.name for path in folder.iterdir()] == ["his"]
        subprocess.run(["mount", "-o", "remount,size=16m", folder], check=True)
        with ended(restored(state, tmp_path)):  # a mount point cannot be moved: what is in it is
            assert (folder / "state").stat().st_size == 4 << 20
            assert not (folder / "his").exists()
            (kept,) = (folder / ".failover-kept-mount").iterdir()
            assert (kept / "his").read_text() == "stays"
    finally:
        subprocess.run(["umount", folder], check=True)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: whose rights are less is the question")
def test_what_belongs_to_an_ordinary_user_is_read_and_laid_down_with_his_rights(tmp_path: Path, open_path: Path) -> None:
    """He names a folder of root's in a snapshot of his own: nothing of root's is read for him, and nothing written."""
    folder = open_path / "roots"
    folder.mkdir()
    (folder / "secret").write_text("root's")
    (folder / "secret").chmod(0o600)
    nobody = Eyes(round_trip.NOBODY, round_trip.NOBODY)
    with asleep(tmp_path) as program:
        trees = CarriedTrees(program.pid, (str(folder),), nobody)
        assert "cannot be read" in trees.refuse()[0]
        trees.close()
        with carrying(program, folder) as session:
            state = once_more(session, 1)
    (folder / "secret").write_text("changed")
    with pytest.raises(RestoreError, match="see to room and rights there"):
        restore.lay_down(state, nobody, frozenset())
    assert (folder / "secret").read_text() == "changed"
    assert os.geteuid() == 0 and folder.stat().st_uid == 0


def of_two_paths(tmp_path: Path, one: Path, other: Path, uid: int = -1) -> Snapshot:
    """A snapshot that carries two folders, which are of another content now.

    Args:
        uid: whose they are; -1: our own.
    """
    for folder in (one, other):
        folder.mkdir()
        (folder / "state").write_text("of the checkpoint")
        for path in (folder, folder / "state"):
            os.chown(path, uid, uid)
    with asleep(tmp_path) as program, carrying(program, one, other) as session:
        state = once_more(session, 1)
    for folder in (one, other):
        (folder / "state").write_text("newer")
        (folder / "his").mkdir()
    return state


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: whose rights are less is the question")
@pytest.mark.parametrize("built", [False, True], ids=["built", "moved"])
def test_a_path_that_cannot_be_laid_down_leaves_the_others_as_they_were(tmp_path: Path, open_path: Path, built: bool) -> None:
    """The second one has no room beside it that may be written; or has, but may not be moved from there."""
    top = open_path / "top"
    top.mkdir()
    one, other = top / "a", top / "z"
    state = of_two_paths(tmp_path, one, other, round_trip.NOBODY)
    for path in (top, one, *one.iterdir()):
        os.chown(path, round_trip.NOBODY, round_trip.NOBODY)
    if not built:
        os.chown(other, 0, 0)
    other.chmod(0o555)
    if not built:
        top.chmod(0o555)
    before = contents(top)
    with pytest.raises(RestoreError, match=f"cannot write {other}, which .* see to room and rights there"):
        restore.lay_down(state, Eyes(round_trip.NOBODY, round_trip.NOBODY), frozenset())
    assert contents(top) == before


@pytest.mark.parametrize("failing", ["kept", "z"])
def test_a_disk_that_fails_between_two_moves_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str) -> None:
    """The move after the exchange fails, or the exchange of the second path: no disk can be made to do that when asked."""
    top = tmp_path / "top"
    top.mkdir()
    state = of_two_paths(tmp_path, top / "a", top / "z")
    before = contents(top)
    real, failures = reversible_moves._renameat2, [OSError(errno.EIO, os.strerror(errno.EIO))]

    def renameat2(old: str, new: str, flag: int) -> None:
        if failures and (new == str(top / failing) or (failing == "kept" and ".failover-kept" in new)):
            raise failures.pop()
        real(old, new, flag)

    monkeypatch.setattr(reversible_moves, "_renameat2", renameat2)
    with pytest.raises(RestoreError, match="Input/output error"):
        restore.lay_down(state, None, frozenset())
    assert not failures
    assert contents(top) == before


def test_what_cannot_be_moved_back_is_not_removed_and_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    top = tmp_path / "top"
    top.mkdir()
    state = of_two_paths(tmp_path, top / "a", top / "z")
    real, calls = reversible_moves._renameat2, []

    def renameat2(old: str, new: str, flag: int) -> None:
        calls.append(old)
        if len(calls) > 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        real(old, new, flag)

    monkeypatch.setattr(reversible_moves, "_renameat2", renameat2)
    with pytest.raises(RestoreError, match=f"nor undo it: the former {top}/a is at {top}/.failover-new"):
        restore.lay_down(state, None, frozenset())
    (left,) = top.glob(".failover-new-*/new/state")
    assert left.read_text() == "newer"


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: whose rights are less is the question")
def test_a_folder_that_is_emptied_name_by_name_is_whole_again_when_a_name_cannot_move(tmp_path: Path, open_path: Path) -> None:
    """Its parent is not writable, and a folder in it is closed: that cannot move to another folder."""
    folder = open_path / "mine"
    folder.mkdir()
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        (folder / "state").write_text("of the checkpoint")
        state = once_more(session, 1)
    for index in range(8):
        (folder / str(index)).mkdir(mode=0o755 if index % 4 else 0o555)
    for path in (folder, *folder.iterdir()):
        os.chown(path, round_trip.NOBODY, round_trip.NOBODY)
    before = contents(folder)
    with pytest.raises(RestoreError, match="see to room and rights there"):
        restore.lay_down(state, Eyes(round_trip.NOBODY, round_trip.NOBODY), frozenset())
    assert contents(folder) == before


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: whose rights are less is the question")
@pytest.mark.parametrize("writable", [True, False], ids=["as a whole", "name by name"])
def test_an_ordinary_users_folder_is_laid_down_with_his_rights_alone(tmp_path: Path, open_path: Path, writable: bool) -> None:
    folder = open_path / "his" / "mine"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "state").write_text("of the checkpoint")
    os.mkfifo(folder / "pipe", 0o620)
    (folder / "link").symlink_to("deep")
    for path in (*((folder.parent,) if writable else ()), folder, *folder.rglob("*")):
        os.chown(path, round_trip.NOBODY, round_trip.NOBODY, follow_symlinks=False)
    before = contents(folder)
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        state = once_more(session, 1)
    (folder / "deep" / "state").write_text("newer")
    (note,) = restore.lay_down(state, Eyes(round_trip.NOBODY, round_trip.NOBODY), frozenset()).notes
    kept = Path(note.partition("is kept in ")[2])
    assert next(kept.rglob("state")).read_text() == "newer"
    assert {name: about for name, about in contents(folder).items() if ".failover-kept" not in name} == before


@pytest.mark.parametrize("name", ["folder/file", "folder", "link", "pipe", "file"])
def test_owner_and_mode_are_given_through_no_link_and_to_nothing_else(tmp_path: Path, name: str) -> None:
    """Somebody puts a link in its place after it was made: what that leads to stays as it is."""
    victim, top = tmp_path / "victim", tmp_path / "top"
    for made in (victim, top):
        (made / "folder").mkdir(parents=True)
        (made / "folder" / "file").touch(mode=0o600)
    file = (top / "folder" / "file").stat()
    entry = carried_files.Entry(b"", stat.S_IFREG | 0o777, file.st_uid, file.st_gid, 5, attributes=(("user.x", b"y"),))
    before = portrait(victim)
    kinds = {"folder": stat.S_IFDIR, "link": stat.S_IFLNK, "pipe": stat.S_IFIFO}
    if name == "folder/file":
        shutil.rmtree(top / "folder")
        (top / "folder").symlink_to(victim / "folder")
    else:
        if name == "folder":
            shutil.rmtree(top / name)
        (top / name).symlink_to(victim / "folder" / "file")
    entry = replace(entry, mode=kinds.get(name, stat.S_IFREG) | 0o777)
    if name == "link":  # it is one itself
        attributes.give(str(top), entry, os.fsencode(name))
        assert (top / name).lstat().st_mtime_ns == 5
    else:
        with pytest.raises(OSError, match=r"Not a directory|something else has its place"):
            attributes.give(str(top), entry, os.fsencode(name))
    assert portrait(victim) == before
    assert os.listxattr(victim / "folder" / "file") == []


def test_what_was_built_aside_is_given_away_there_wherever_its_name_leads_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who owns the folder renames what is built, and lets its name lead to files that are not his, as soon as it is made."""
    folder, victim, real = tmp_path / "kept", tmp_path / "victim", restore._write
    (victim / "new").mkdir(parents=True)
    folder.mkdir()
    for path in (victim / "new" / "state", folder / "state"):
        path.write_text("x")
        path.chmod(0o600)
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        (folder / "state").chmod(0o666)
        state = once_more(session, 1)
    (folder / "state").unlink()
    before = portrait(victim)

    def write(*told: Any) -> None:
        real(*told)
        (aside,) = tmp_path.glob(".failover-new-*")
        aside.rename(tmp_path / "moved")
        aside.symlink_to(victim)

    monkeypatch.setattr(restore, "_write", write)
    restore.lay_down(state, None, frozenset())
    assert portrait(victim) == before
    assert (folder / "state").stat().st_mode & 0o777 == 0o666
