"""A program comes back where it was in control groups of version 1 and 2; where it cannot, the restore says so."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from checkpoint.resources.process import control_groups
from tests.checkpoint.round_trip import everybody_below
from tests.failover.cli.test_verbs import COMMAND

pytestmark = [pytest.mark.root]

PYTHON = getattr(sys, "_base_executable", sys.executable)
PATIENCE_S = 60.0
PROGRAM = """
import os, sys, time
first, second = sys.argv[1:]
def enter(group):
    if group:
        with open(group + "/cgroup.procs", "w") as file:
            file.write("0")
if os.fork() == 0:
    enter(second)
    open("child", "w").close()
    time.sleep(600)
enter(first)
open("first", "w").close()
os.wait()
"""
NOBODY = 65534


@dataclass
class Hierarchy:
    """One that is mounted.

    Attributes:
        name: in /proc/PID/cgroup.
        top: a directory of the tests' own.
    """

    name: str
    top: Path

    def group(self, name: str) -> Path:
        made = self.top / name
        made.mkdir()
        return made

    def of(self, pid: int) -> str:
        """The name of the group that a process is in."""
        return control_groups.groups_of(pid)[self.name].rpartition(f"/{self.top.name}")[2]


@pytest.fixture(params=["v2", "v1"])
def hierarchy(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Hierarchy]:
    """A group of the tests' own, in the unified hierarchy, or in a named one of version 1 that is made for the test."""
    place, name = tmp_path / "hierarchy", ""
    place.mkdir()
    if request.param == "v1":
        name = f"name=failover{os.getpid()}"
        words = ["-t", "cgroup", "-o", f"none,{name}"]
    else:
        words = ["-t", "cgroup2"]
    mounted = subprocess.run(["mount", *words, "none", str(place)], capture_output=True, text=True, check=False)
    if mounted.returncode:
        pytest.skip(f"needs control groups of {request.param}: {mounted.stderr.strip()}")
    top = place / f"tests-{os.getpid()}"
    try:
        top.mkdir()
        yield Hierarchy(name, top)
    finally:
        for directory, _, _ in os.walk(top, topdown=False):
            for _ in range(500):  # until its last process has ended
                with contextlib.suppress(OSError):
                    os.rmdir(directory)
                    break
                time.sleep(0.01)
        subprocess.run(["umount", str(place)], check=True)


class Program:
    """Two processes, each in a group."""

    def __init__(self, directory: Path, first: Path | str, second: Path | str) -> None:
        self.directory = directory
        words = [PYTHON, "-c", PROGRAM, str(first), str(second)]
        self._process = subprocess.Popen(words, cwd=directory, stdin=subprocess.DEVNULL, start_new_session=True)
        self.pid = self._process.pid
        deadline = time.monotonic() + PATIENCE_S
        while not ((directory / "first").exists() and (directory / "child").exists()):
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def pids(self) -> list[int]:
        return [self.pid, *everybody_below(self.pid)]

    def capture(self) -> None:
        ran = self._failover("capture", str(self.pid), "-o", "snapshot", "--force")
        assert ran.returncode == 0, ran.stderr
        self._process.wait()

    def restore(self, *before: str) -> str:
        """What was said of it."""
        ran = self._failover("restore", "snapshot", before=before)
        assert ran.returncode == 0, ran.stderr
        self.pid = int(ran.stdout)
        return ran.stderr

    def _failover(self, *words: str, before: Sequence[str] = ()) -> subprocess.CompletedProcess[str]:
        command = [*before, *COMMAND, *words]
        ran = subprocess.run(command, cwd=self.directory, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
        assert "Traceback" not in ran.stderr
        return ran

    def end(self) -> None:
        for pid in reversed(self.pids()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._process.wait()


@contextlib.contextmanager
def running(directory: Path, first: Path | str = "", second: Path | str = "") -> Iterator[Program]:
    program = Program(directory, first, second)
    try:
        yield program
    finally:
        program.end()


def test_each_process_comes_back_to_its_group(hierarchy: Hierarchy, tmp_path: Path) -> None:
    with running(tmp_path, hierarchy.group("outer"), hierarchy.group("outer/inner")) as program:
        for _ in range(2):
            program.capture()
            assert "control group" not in program.restore()
            assert [hierarchy.of(pid) for pid in program.pids()] == ["/outer", "/outer/inner"]


def test_groups_of_its_own_are_made_anew(hierarchy: Hierarchy, tmp_path: Path) -> None:
    outer, inner = hierarchy.group("outer"), hierarchy.group("outer/inner")
    with running(tmp_path, outer, inner) as program:
        program.capture()
        inner.rmdir()
        outer.rmdir()
        assert "control group" not in program.restore()
        assert [hierarchy.of(pid) for pid in program.pids()] == ["/outer", "/outer/inner"]


def test_a_group_that_others_had_too_is_not_made_and_that_is_said(hierarchy: Hierarchy, tmp_path: Path) -> None:
    common = hierarchy.group("common")
    other = subprocess.Popen(["sleep", "600"])
    try:
        (common / "cgroup.procs").write_text(str(other.pid))
        with running(tmp_path, common) as program:
            program.capture()
            other.kill()
            other.wait()
            common.rmdir()
            notes = program.restore()
            assert f"was in the control group /{hierarchy.top.name}/common (" in notes, notes
            assert "that group does not exist here; make it, and write the PID to its cgroup.procs" in notes
            assert notes.count("was in the control group") == 1, "only of the process that was there"
            assert not common.exists()
    finally:
        other.kill()
        other.wait()


IN_A_THREAD = """
import sys, threading, time
def wait():
    with open(sys.argv[1] + "/tasks", "w") as file:
        file.write("0")
    open("first", "w").close()
    open("child", "w").close()
    time.sleep(600)
threading.Thread(target=wait).start()
"""


def test_a_thread_that_was_elsewhere_than_its_process_is_told_of(
    hierarchy: Hierarchy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not hierarchy.name:
        pytest.skip("a group of version 2 that takes single threads must be made so (threaded)")
    monkeypatch.setitem(globals(), "PROGRAM", IN_A_THREAD)
    with running(tmp_path, hierarchy.group("threads")) as program:
        program.capture()
        notes = program.restore()
        assert f"were in the control group /{hierarchy.top.name}/threads; they are in that of their process now" in notes, notes


def test_a_component_of_a_user_enters_only_groups_of_that_user(hierarchy: Hierarchy) -> None:
    group = hierarchy.group("outer")
    process = subprocess.Popen(["sleep", "600"])
    try:
        usual = control_groups.groups_of(process.pid)[hierarchy.name]
        place = control_groups._Place(hierarchy.name, f"/{hierarchy.top.name}/outer", "", False)
        mounts = control_groups._Mounts()
        lost = control_groups._lost(process.pid, place, usual, mounts, NOBODY)
        assert lost == f"the group is not one of user {NOBODY} here; an administrator puts it there"
        os.chown(group / "cgroup.procs", NOBODY, NOBODY)
        assert not control_groups._lost(process.pid, place, usual, mounts, NOBODY)
        assert hierarchy.of(process.pid) == "/outer"
    finally:
        process.kill()
        process.wait()


def test_the_usual_place_is_not_recorded() -> None:
    here = os.getpid()
    assert (usual := control_groups.groups_of(here))
    assert not list(control_groups._elsewhere(usual, usual, (here,), is_guarded=False))


@pytest.mark.parametrize(
    ("path", "below"),
    [
        ("/agents/failover-0a1b", None),
        ("/agents/failover-0a1b/worker", "worker"),
        ("/other", ""),
    ],
)
def test_under_a_guard_the_usual_place_is_the_group_that_it_made(path: str, below: str | None) -> None:
    told = [groups[2] for groups in control_groups._elsewhere({"": path}, {"": "/agents"}, (), is_guarded=True)]  # type: ignore[index, call-overload]
    assert told == ([] if below is None else [below])
