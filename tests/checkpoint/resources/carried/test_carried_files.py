"""Carried files: what the program writes comes back as it was at the checkpoint, with the memory of the same instant."""

from __future__ import annotations

import os
import shutil
import sys
import time
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder
from checkpoint.model import Resource, Snapshot
from checkpoint.resources.carried import capture, restore
from checkpoint.snapshot import carried_files
from tests.checkpoint import snapshots
from tests.checkpoint.resources.carried.carrying import asleep, carrying, once_more, portrait
from tests.checkpoint.round_trip import captured_at_last, ended, restored, start, transported

COUNTER = Path(__file__).parents[2] / "sqlite_counter.py"


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


def test_a_path_in_a_carried_folder_may_be_carried_by_itself_too(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    furnish(folder)
    before = portrait(folder)
    with asleep(tmp_path) as program, carrying(program, folder / "deep", folder, folder / "plain") as session:
        state = once_more(session, 1)
    (folder / "deep" / "er" / "secret").unlink()
    restore.lay_down(state, None, frozenset())
    assert portrait(folder) == before


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
