"""A program resumes where its own files are missing or differ: with the files brought along, and no file in place is touched."""

from __future__ import annotations

import mmap
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, ProtectOrder, RestoreOptions
from checkpoint.engines.ptrace.facts.file_identity import Identities
from checkpoint.errors import MismatchError, UnsupportedError
from checkpoint.linux.procfs import procfs
from checkpoint.model import Snapshot
from checkpoint.snapshot.required_files import Need, needs
from checkpoint.store.atomic_files import WholeFiles
from checkpoint.store.content_store import Contents, digest_of_file
from checkpoint.store.disk import Disk
from tests.checkpoint.round_trip import (
    ENGINE,
    NOBODY,
    Program,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    restored,
    start,
    transported,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

SOURCE = r"""
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
int main(int count, char **arguments) {
    char text[8] = {0}, *go = arguments[1];
    int file = count > 2 ? open(arguments[2], O_RDONLY) : -1;
    setvbuf(stdout, NULL, _IOLBF, 0);
    if (file >= 0) lseek(file, 3, SEEK_SET);
    puts("ready");
    while (access(go, F_OK)) nanosleep(&(struct timespec){0, 1000000}, NULL);
    if (file >= 0 && (read(file, text, 4) != 4 || strcmp(text, "defg"))) { printf("read %s\n", text); return 1; }
    puts("ok");
    return 0;
}
"""


class Stage:
    """A program with a C library of its own, in a directory of its own; it works in another one."""

    def __init__(self, directory: Path) -> None:
        self.place = directory / "home" / "app"
        self.work = directory / "work"
        self.store = directory / "store"
        for one in (self.place, self.work, self.store):
            one.mkdir(parents=True)
        self.store.chmod(0o700)
        self.contents = Contents(self.store, WholeFiles(Disk()))
        source = directory / "program.c"
        source.write_text(SOURCE)
        self.program = self.place / "program"
        subprocess.run(["cc", "-O1", "-o", str(self.program), str(source)], check=True)
        listed = subprocess.run(["ldd", str(self.program)], check=True, capture_output=True, text=True).stdout
        self.library = self.place / "libc.so.6"
        shutil.copy(next(line.split()[2] for line in listed.splitlines() if "libc.so.6" in line), self.library)

    def snapshot(self, *arguments: str) -> Snapshot:
        """Of the program, which has ended since."""
        words = [str(self.program), str(self.work / "go"), *arguments]
        program = start(words, self.work, env={"LD_LIBRARY_PATH": str(self.place)})
        with ended(program):
            program.wait_for_line("ready")
            return captured_and_killed(program)

    def bring(self, snapshot: Snapshot) -> tuple[Need, ...]:
        """Keep what it needs; the program's own files are gone afterwards."""
        wanted = needs(snapshot)
        for need in wanted:
            descriptor = os.open(need.path, os.O_RDONLY)
            self.contents.put(descriptor, need.digest)
            os.close(descriptor)
        return wanted

    def back(self, snapshot: Snapshot, **options: bool) -> Program:
        return restored(snapshot, self.work, contents=self.contents.folder, **options)  # type: ignore[arg-type]


@pytest.fixture
def stage() -> Iterator[Stage]:
    """In a directory that every user reaches; pytest's own are closed to others."""
    with tempfile.TemporaryDirectory(prefix="brought-") as directory:
        Path(directory).chmod(0o755)
        yield Stage(Path(directory))


def captured_by_an_agent(program: Program) -> Snapshot:
    """As by one that keeps its files: those need not be there any more."""
    session = ENGINE.protect(program.pid, ProtectOrder("/test/tracee", names={}))
    try:
        snapshot = transported(session.capture(CaptureOrder()))
    finally:
        program.kill()
        session.close()
    return snapshot


def mapped(pid: int) -> set[str]:
    """The files behind its mappings."""
    lines = (line.split() for line in Path(f"/proc/{pid}/maps").read_text().splitlines())
    return {words[5] for words in lines if len(words) > 5 and words[5].startswith("/")}


def test_a_program_whose_directory_is_gone_goes_on_with_what_was_brought(stage: Stage) -> None:
    snapshot = stage.snapshot()
    stage.bring(snapshot)
    shutil.rmtree(stage.place.parent)
    with ended(stage.back(snapshot)) as program:
        executable = stage.contents.path(snapshot.process.executable.digest)
        assert os.readlink(f"/proc/{program.pid}/exe") == str(executable)
        assert {str(executable)} < mapped(program.pid)
        (stage.work / "go").touch()
        expect_ok(program)
    assert not stage.place.parent.exists()


def test_another_version_at_the_same_path_is_not_run_and_not_touched(stage: Stage) -> None:
    snapshot = stage.snapshot()
    stage.bring(snapshot)
    stage.library.write_bytes(stage.library.read_bytes() + b"a later release")
    there = (stage.library.read_bytes(), stage.library.stat().st_mtime_ns)
    with ended(stage.back(snapshot)) as program:
        assert str(stage.library) not in mapped(program.pid)
        assert str(stage.program) in mapped(program.pid), "what is the same here is this machine's own"
        (stage.work / "go").touch()
        expect_ok(program)
    assert (stage.library.read_bytes(), stage.library.stat().st_mtime_ns) == there


def test_what_was_brought_is_named_by_its_content_when_it_is_captured_again(stage: Stage) -> None:
    """So that a third robot can be asked for the same digests."""
    snapshot = stage.snapshot()
    wanted = stage.bring(snapshot)
    shutil.rmtree(stage.place.parent)
    with ended(stage.back(snapshot)) as program:
        again = captured_and_killed(program)
    assert {need.digest for need in needs(again)} == {need.digest for need in wanted}
    (stage.work / "go").touch()
    with ended(stage.back(again)) as program:
        expect_ok(program)


def test_a_program_that_was_replaced_while_it_ran_is_needed_as_it_ran(stage: Stage) -> None:
    words = [str(stage.program), str(stage.work / "go")]
    was = stage.program.read_bytes()
    program = start(words, stage.work)
    with ended(program):
        program.wait_for_line("ready")
        stage.program.unlink()
        stage.program.write_bytes(was + b"upgraded")
        held = os.open(f"/proc/{program.pid}/exe", os.O_RDONLY)
        snapshot = captured_by_an_agent(program)
    try:
        need = next(need for need in needs(snapshot) if need.path == str(stage.program))
        stage.contents.put(held, need.digest)
        assert os.pread(held, len(was) + 1, 0) == was
    finally:
        os.close(held)
    (stage.work / "go").touch()
    with ended(stage.back(snapshot)) as back:
        expect_ok(back)
    assert stage.program.read_bytes() == was + b"upgraded"


def test_without_somebody_who_keeps_its_files_a_program_that_was_deleted_is_refused(stage: Stage) -> None:
    program = start([str(stage.program), str(stage.work / "go")], stage.work)
    with ended(program):
        program.wait_for_line("ready")
        stage.program.unlink()
        with pytest.raises(UnsupportedError, match=str(stage.program)):
            captured_and_killed(program)


def test_a_content_that_was_damaged_is_not_run_and_is_named(stage: Stage) -> None:
    snapshot = stage.snapshot()
    stage.bring(snapshot)
    shutil.rmtree(stage.place.parent)
    path = stage.contents.path(snapshot.process.executable.digest)
    content = bytearray(path.read_bytes())
    content[100] ^= 1
    path.write_bytes(content)
    with pytest.raises(MismatchError) as refusal:
        stage.back(snapshot).kill()
    assert any(str(path) in reason and str(stage.program) in reason for reason in refusal.value.reasons), refusal.value.reasons


def test_what_was_not_brought_is_refused_by_name_as_before(stage: Stage) -> None:
    snapshot = stage.snapshot()
    shutil.rmtree(stage.place.parent)
    with pytest.raises(MismatchError) as refusal:
        stage.back(snapshot).kill()
    assert any(str(stage.program) in reason for reason in refusal.value.reasons)


def test_what_is_lacking_here_is_told_while_the_program_runs_elsewhere(stage: Stage) -> None:
    """And what it goes on writing meanwhile is not."""
    log = stage.work / "log"
    with ended(
        start(["/bin/sh", "-c", f"exec >> {log}; echo one; exec {stage.program} {stage.work / 'go'}"], stage.work)
    ) as program:
        program.wait_until(lambda: log.exists() and "ready" in log.read_text(), "its start")
        with protected(program) as session:
            snapshot = transported(captured_at_last(session, CaptureOrder()))
            outline = replace(snapshot, contents=b"")
            log.write_text("cut")
            assert ENGINE.lacks(outline, RestoreOptions()) == ()
            shutil.move(stage.place.parent, stage.work / "moved")
            (lack, *_) = ENGINE.lacks(outline, RestoreOptions())
            assert lack.startswith(f"{stage.program} cannot be used (No such file or directory)"), lack
            shutil.move(stage.work / "moved", stage.place.parent)
            log.unlink()
            assert [str(log) in lack for lack in ENGINE.lacks(outline, RestoreOptions())] == [True]


def test_a_file_that_is_only_read_goes_on_from_its_offset(stage: Stage) -> None:
    text = stage.place / "text"
    text.write_text("abcdefgh")
    snapshot = stage.snapshot(str(text))
    stage.bring(snapshot)
    text.write_text("another!")
    (stage.work / "go").touch()
    with ended(stage.back(snapshot)) as program:
        expect_ok(program)
    assert text.read_text() == "another!"


def test_the_rights_of_a_set_user_id_file_are_not_brought(stage: Stage) -> None:
    stage.program.chmod(0o6755)
    snapshot = stage.snapshot()
    stage.bring(snapshot)
    assert stage.contents.path(snapshot.process.executable.digest).stat().st_mode & 0o7777 == 0o555


def test_a_user_who_may_not_look_into_the_store_goes_on_with_what_is_in_it(stage: Stage) -> None:
    """Opened with our rights, from a directory that is ours; everything else with his own."""
    stage.work.chmod(0o777)
    for name in ("out", "err"):
        (stage.work / name).touch()
        (stage.work / name).chmod(0o666)
    words = ["/usr/bin/setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    program = start([*words, str(stage.program), str(stage.work / "go")], stage.work, env={"LD_LIBRARY_PATH": str(stage.place)})
    with ended(program):
        program.wait_for_line("ready")
        snapshot = captured_and_killed(program)
    assert snapshot.process.credentials.uids[0] == NOBODY
    stage.bring(snapshot)
    shutil.rmtree(stage.place.parent)
    with ended(stage.back(snapshot, own_eyes=True)) as back:
        (stage.work / "go").touch()
        expect_ok(back)


def test_a_working_directory_that_is_missing_is_made(stage: Stage) -> None:
    place = stage.work / "some" / "where"
    place.mkdir(parents=True)
    program = start(["/bin/sh", "-c", f"cd {place}; exec {stage.program} {stage.work / 'go'}"], stage.work)
    with ended(program):
        program.wait_for_line("ready")
        snapshot = captured_and_killed(program)
    stage.bring(snapshot)
    shutil.rmtree(stage.work / "some")
    with ended(stage.back(snapshot)) as back:
        assert os.readlink(f"/proc/{back.pid}/cwd") == str(place)
        (stage.work / "go").touch()
        expect_ok(back)


def test_a_link_by_the_name_that_the_kernel_shows_of_a_mapped_file_does_not_lead_us_to_another_file(tmp_path: Path) -> None:
    """In /proc/PID/maps a newline is ``\\012``, but so is a backslash with these digits; and names change while we look."""
    mapped, closed = tmp_path / "file\\012x", tmp_path / "closed"
    mapped.write_bytes(b"the program's own")
    closed.write_bytes(b"nobody else's business")
    (tmp_path / "file\nx").symlink_to(closed)
    with mapped.open("rb") as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ):
        lines = procfs.parse_maps(procfs.read_text(os.getpid(), "maps"))
        (line,) = (line for line in lines if line.name.startswith(str(tmp_path)))
        identity = Identities(os.getpid(), {}).of_mapping(line)
    assert (identity.digest, identity.size) == (digest_of_file(mapped), len("the program's own"))
