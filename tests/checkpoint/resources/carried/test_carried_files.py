"""Carried files: what the program writes comes back as it was at the checkpoint, with the memory of the same instant."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, Session, Terms
from checkpoint.errors import MismatchError, RestoreError, UnsupportedError
from checkpoint.linux.user_rights import Eyes
from checkpoint.model import Resource, Snapshot
from checkpoint.resources.carried import attributes, capture, restore, reversible_moves
from checkpoint.resources.carried.capture import CarriedTrees
from checkpoint.snapshot import carried_files
from tests.checkpoint import round_trip, snapshots
from tests.checkpoint.round_trip import ENGINE, Program, at_last, captured_at_last, ended, restored, start, transported

COUNTER = Path(__file__).parents[2] / "sqlite_counter.py"


@pytest.fixture
def open_path() -> Iterator[Path]:
    """A folder that every user may look into: each run of pytest closes the folder of all runs to others."""
    with tempfile.TemporaryDirectory() as directory:
        Path(directory).chmod(0o755)
        yield Path(directory)


SLEEPER = "import time\nprint('ready', flush=True)\nwhile True: time.sleep(0.01)\n"


@contextlib.contextmanager
def carrying(program: Program, *paths: Path, size_max: int = 1 << 28) -> Iterator[Session]:
    """Hold a program under protection whose files travel with it."""
    order = ProtectOrder("/test/carried", terms=Terms(Carry(tuple(map(str, paths)), size_max)))
    session = at_last(lambda: ENGINE.protect(program.pid, order))
    try:
        yield session
    finally:
        session.close()


@pytest.mark.parametrize("mode", ["delete", "wal"])
def test_a_database_and_the_memory_of_its_program_come_back_as_of_one_instant(tmp_path: Path, mode: str) -> None:
    """Killed at a moment of its own in each round, the folder lost: what was counted stands in the database, and no more."""
    folder, enough = tmp_path / "kept", tmp_path / "enough"
    folder.mkdir()
    program = start([sys.executable, COUNTER, folder / "steps.db", mode, "1", enough], tmp_path)
    for round_number in range(3):
        with ended(program):
            program.wait_for_output((tmp_path / "out").stat().st_size + 40)
            with carrying(program, folder) as session:
                chain = [transported(captured_at_last(session, CaptureOrder()))]
                for sequence in range(2, 6):
                    session.acknowledge(chain[-1].position)
                    size = (tmp_path / "out").stat().st_size
                    program.wait_for_output(size + 20)
                    chain.append(transported(captured_at_last(session, CaptureOrder(base=False, sequence=sequence))))
                program.wait_for_output((tmp_path / "out").stat().st_size + 7 * round_number)
                program.kill()
        shutil.rmtree(folder)
        program = restored(chain, tmp_path)
    with ended(program):
        program.wait_for_output((tmp_path / "out").stat().st_size + 40)
        enough.touch()
        assert program.finish() == 0, program.output[-400:] + program.complaints
        assert program.output.splitlines()[-1] == "ok"


@contextlib.contextmanager
def asleep(directory: Path) -> Iterator[Program]:
    """A program that does nothing, so that a test may change its files for it."""
    program = start([sys.executable, "-c", SLEEPER], directory)
    with ended(program):
        program.wait_for_line("ready")
        yield program


def once_more(session: Session, sequence: int, parent: Snapshot | None = None) -> Snapshot:
    """The next snapshot: a delta of one that is acknowledged, or a base."""
    if parent is not None:
        session.acknowledge(parent.position)
    return transported(captured_at_last(session, CaptureOrder(base=parent is None, sequence=sequence)))


def portrait(top: Path) -> dict[str, tuple[object, ...]]:
    """All that can be told of a folder: names, kinds, modes, owners, times, contents, links."""
    told: dict[str, tuple[object, ...]] = {}
    links: dict[int, str] = {}
    for path in (top, *sorted(top.rglob("*"))):
        about, name = path.lstat(), str(path.relative_to(top))
        content: object = None
        if path.is_symlink():
            content = os.readlink(path)
        elif path.is_file():
            content = path.read_bytes(), links.setdefault(about.st_ino, name), about.st_nlink
        told[name] = (about.st_mode, about.st_uid, about.st_gid, about.st_mtime_ns, content)
    return told


def furnish(folder: Path) -> None:
    """Everything that a folder may hold."""
    folder.mkdir()
    (folder / "plain").write_bytes(os.urandom(10_000))
    (folder / "empty").touch()
    (folder / "deep" / "er").mkdir(parents=True, mode=0o750)
    (folder / "deep" / "er" / "secret").write_text("x")
    (folder / "deep" / "er" / "secret").chmod(0o400)
    (folder / "link").symlink_to("deep/er/secret")
    (folder / "nowhere").symlink_to("/no/such/place")
    os.link(folder / "plain", folder / "deep" / "second name")
    os.mkfifo(folder / "fifo", 0o640)
    with (folder / "sparse").open("wb") as sparse:
        sparse.truncate(50 << 20)
        sparse.seek(20 << 20)
        sparse.write(b"in the middle")
    if os.geteuid() == 0:
        os.chown(folder / "empty", 12, 34)
    os.utime(folder / "deep", ns=(1, 1_234_567_890_123_456_789))


def test_a_folder_comes_back_with_all_that_is_in_it(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    furnish(folder)
    before = portrait(folder)
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        state = once_more(session, 1)
    shutil.rmtree(folder)
    with ended(restored(state, tmp_path)):
        assert portrait(folder) == before
        assert (folder / "sparse").stat().st_blocks * 512 < 1 << 20, "its holes were filled"
        assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []


def test_what_is_new_deleted_renamed_and_cut_travels_with_a_delta(tmp_path: Path) -> None:
    """Only changed blocks are in it; one that nobody acknowledged forgets nothing."""
    folder = tmp_path / "kept"
    furnish(folder)
    with asleep(tmp_path) as program, carrying(program, folder) as session:
        base = once_more(session, 1)
        (folder / "deep" / "er" / "secret").unlink()
        (folder / "plain").rename(folder / "renamed")
        os.truncate(folder / "renamed", 5_000)
        (folder / "new").write_bytes(b"n" * 9_000)
        session.acknowledge(base.position)
        captured_at_last(session, CaptureOrder(base=False, sequence=2))  # is lost on its way
        (folder / "new").write_bytes(b"o" * 3_000)
        with (folder / "sparse").open("r+b") as sparse:
            sparse.seek(30 << 20)
            sparse.write(b"further on")
        delta = once_more(session, 3, base)
        told = sum(run.size for run in delta.runs if run.start >= carried_files.FIRST_ADDRESS)
        assert told < 40_000, "more than the changed blocks"
        (folder / "new").unlink()
        (folder / "at last").mkdir()
        last = once_more(session, 4, delta)
        expected = portrait(folder)
    shutil.rmtree(folder)
    with ended(restored([base, delta, last], tmp_path)):
        assert portrait(folder) == expected


MAPPER = """
import mmap, os, time
def wait(name):
    print(name, flush=True)
    while not os.path.exists(name):
        time.sleep(0.002)
file = os.open('mapped', os.O_RDWR)
pages = mmap.mmap(file, 3 << 12)
pages[5000:5005] = b'first'
wait('one')
pages[5000:5005] = b'later'  # the page is dirty already: no time tells of this one
pages.close()
os.close(file)
wait('two')
print(open('mapped', 'rb').read()[5000:5005].decode(), flush=True)
"""


def test_what_a_mapping_wrote_travels_though_no_time_shows_it(tmp_path: Path) -> None:
    """The mapping is gone by the second capture, and the file's times are those of the first."""
    for attempt in range(20):
        (tmp_path / str(attempt)).mkdir()
        if chain := mapped_and_told_by_no_time(tmp_path / str(attempt)):
            break
    else:
        raise AssertionError("the kernel has written the page back each time")
    path = tmp_path / str(attempt) / "mapped"
    path.unlink()
    program = restored(chain, path.parent)
    (path.parent / "two").touch()
    with ended(program):
        assert program.finish() == 0, program.complaints
        assert program.output.splitlines()[-1] == "later"


def mapped_and_told_by_no_time(directory: Path) -> list[Snapshot]:
    """A base and a delta; none where the page was written back between the two writes (fsync(2) of anybody): times tell, then."""
    path = directory / "mapped"
    path.write_bytes(bytes(3 << 12))
    program = start([sys.executable, "-c", MAPPER], directory)
    with ended(program):
        program.wait_for_line("one")
        time.sleep(2 * capture.GRAIN_NS / 1e9)  # so that nothing else makes the file be read again
        with carrying(program, path) as session:
            base = once_more(session, 1)
            before = path.stat()
            (directory / "one").touch()
            program.wait_for_line("two")
            delta = once_more(session, 2, base)
            return [base, delta] if path.stat().st_mtime_ns == before.st_mtime_ns else []


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


def a_socket(folder: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(folder / "s"))


@pytest.mark.parametrize(
    ("furnished", "said"),
    [
        (a_socket, "/s is a socket, which is not carried"),
        (lambda folder: (folder / "large").write_bytes(bytes(3 << 20)), "hold 3 MiB, the limit is 2 MiB"),
        (lambda folder: [(folder / str(index)).touch() for index in range(capture.ENTRIES_MAX)], "more than 8192 names"),
    ],
    ids=["socket", "size", "names"],
)
def test_what_cannot_be_carried_is_refused_by_name_and_later_too(
    tmp_path: Path, furnished: Callable[[Path], object], said: str
) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    with asleep(tmp_path) as program, carrying(program, folder, size_max=2 << 20) as session:
        once_more(session, 1)
        furnished(folder)
        for _ in range(2):
            with pytest.raises(UnsupportedError, match=said):
                session.capture(CaptureOrder())
        with pytest.raises(UnsupportedError, match=said), carrying(program, folder, size_max=2 << 20):
            pass
        for path in folder.iterdir():
            path.unlink()
        once_more(session, 2)


@pytest.mark.parametrize(
    ("path", "said"), [("link/inside", "is a link, or behind one"), ("../x", "no absolute path"), ("", "no absolute path")]
)
def test_a_path_that_means_another_thing_elsewhere_is_refused(tmp_path: Path, path: str, said: str) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    named = f"{tmp_path}/{path}" if path else "relative"
    with asleep(tmp_path) as program, pytest.raises(UnsupportedError, match=said):
        ENGINE.protect(program.pid, ProtectOrder("/test/carried", terms=Terms(Carry((named,))))).close()


def test_a_folder_above_that_becomes_a_link_is_refused_by_name_until_it_is_a_folder_again(tmp_path: Path) -> None:
    """What it leads to would be carried under the old name."""
    above, moved = tmp_path / "above", tmp_path / "moved"
    (above / "kept").mkdir(parents=True)
    with asleep(tmp_path) as program, carrying(program, above / "kept") as session:
        once_more(session, 1)
        above.rename(moved)
        above.symlink_to(moved)
        for _ in range(2):
            with pytest.raises(UnsupportedError, match=f"{above}/kept is to be carried, .*: name it as {moved}/kept"):
                session.capture(CaptureOrder())
        above.unlink()
        moved.rename(above)
        once_more(session, 2)


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


def contents(top: Path) -> dict[str, tuple[object, ...]]:
    """All that can be told of a folder but times, which change when something is made beside, and taken away again."""
    return {name: (*about[:3], about[4]) for name, about in portrait(top).items()}


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


def test_a_path_in_a_carried_folder_may_be_carried_by_itself_too(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    furnish(folder)
    before = portrait(folder)
    with asleep(tmp_path) as program, carrying(program, folder / "deep", folder, folder / "plain") as session:
        state = once_more(session, 1)
    (folder / "deep" / "er" / "secret").unlink()
    restore.lay_down(state, None, frozenset())
    assert portrait(folder) == before


@pytest.mark.parametrize("name", [b"../out", b"/etc/passwd", b"a/../../out", b"a/b", b".", b"a//b"])
def test_a_snapshot_cannot_name_a_file_outside_of_its_folder(tmp_path: Path, name: bytes) -> None:
    with asleep(tmp_path) as program, carrying(program, tmp_path / "kept") as session:
        (tmp_path / "kept").mkdir()
        (tmp_path / "kept" / "a").touch()
        state = once_more(session, 1)
    (tree,) = carried_files.trees_of(state)
    entries = (tree.entries[0], replace(tree.entries[1], name=name))
    forged = replace(
        state, resources=(*carried_files.without(state).resources, carried_files.Tree(tree.path, entries).resource())
    )
    with pytest.raises(RestoreError, match="its snapshot"):
        restore.lay_down(forged, None, frozenset())


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


@pytest.mark.parametrize("path", ["/tmp/a/../../etc/x", "/tmp/./a", "/tmp//a", "//tmp/a", "/tmp/a/", "/", "tmp/a", "/tmp/a\0b"])
def test_a_snapshot_cannot_name_a_path_by_another_name(path: str) -> None:
    forged = replace(snapshots.history(1)[0], resources=(carried_files.Tree(path, ()).resource(),))
    with pytest.raises(RestoreError, match="does not name the path in full"):
        carried_files.trees_of(forged)


RESTLESS = """
import os
a, b = (os.open(name, os.O_RDWR | os.O_CREAT) for name in ("kept/a", "kept/b"))
count = 0
for file in (a, b):
    os.pwrite(file, bytes(8), 0)
while True:
    told = [int.from_bytes(os.pread(file, 8, 0), "little") for file in (a, b)]
    assert told == [count, count], (told, count)
    count += 1
    os.pwrite(a, count.to_bytes(8, "little"), 0)
    os.pwrite(b, count.to_bytes(8, "little"), 0)
    if not count % 2000:
        print(count, flush=True)
"""


def test_files_are_of_the_same_instant_as_the_memory_to_a_single_write(tmp_path: Path) -> None:
    """It never stops writing: a file that was read a moment earlier or later than the memory would be told by its own check."""
    (tmp_path / "kept").mkdir()
    program = start([sys.executable, "-c", RESTLESS], tmp_path)
    for _ in range(8):
        with ended(program), carrying(program, tmp_path / "kept") as session:
            program.wait_for_output((tmp_path / "out").stat().st_size)
            base = once_more(session, 1)
            program.wait_for_output((tmp_path / "out").stat().st_size)
            delta = once_more(session, 2, base)
        program = restored([base, delta], tmp_path)
    with ended(program):
        program.wait_for_output((tmp_path / "out").stat().st_size)


def test_files_are_laid_down_at_another_path_where_the_robot_wants_them(tmp_path: Path) -> None:
    """What is open, and the working directory, follow; the old path is not touched."""
    there, here = tmp_path / "kept", tmp_path / "elsewhere" / "here"
    there.mkdir()
    code = RESTLESS.replace("import os\n", "import os\nos.chdir('kept')\n").replace("kept/", "")
    program = start([sys.executable, "-c", code], tmp_path)
    with ended(program), carrying(program, there) as session:
        program.wait_for_output((tmp_path / "out").stat().st_size)
        state = once_more(session, 1)
    left = (there / "a").read_bytes()
    program = restored(carried_files.relocated(state, {str(there): str(here)}), tmp_path)
    with ended(program):
        program.wait_for_output((tmp_path / "out").stat().st_size)
        assert os.readlink(f"/proc/{program.pid}/cwd") == str(here)
        assert (here / "a").read_bytes() > bytes(8)
        assert (there / "a").read_bytes() == left


def test_whatever_else_leads_below_a_carried_path_follows_to_where_it_is_laid_down() -> None:
    """Where single threads work, what is watched, where a socket's name begins."""
    told = (
        Resource(carried_files.KIND, "/kept", {"entries": [], "size": 0}),
        Resource("thread_tables", "", {"descriptors": [], "threads": [[7, "/kept/of_thread", 18, 0], [8, "", 0, [[3, 4, 1]]]]}),
        Resource("watches", "fd 3", {"descriptors": [[3, 0]], "watches": [[1, "/kept", 2], [2, "/keptnot", 2]]}),
        Resource("unix_sockets", "fd 4", {"descriptors": [], "path": "/kept/cage/x", "root": "/kept/cage", "directory": ""}),
    )
    state = replace(snapshots.snapshot({}), resources=told)
    _, threads, watches, names = carried_files.relocated(state, {"/kept": "/here"}).resources
    assert threads.facts["threads"] == [[7, "/here/of_thread", 18, 0], [8, "", 0, [[3, 4, 1]]]]
    assert watches.facts["watches"] == [[1, "/here", 2], [2, "/keptnot", 2]]
    assert names.facts == {"descriptors": [], "path": "/here/cage/x", "root": "/here/cage", "directory": ""}
