"""Base of every test: skip rules with their reasons, compiled tracees, and no process left behind."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from checkpoint.engines.ptrace.capture import enter
from checkpoint.linux import abi
from checkpoint.linux.memory import choose_tracker
from checkpoint.linux.memory.tracker import Tracker
from checkpoint.linux.memory.write_protect import PagemapTracker

pytest_plugins = ["tests.runner"]

TRACEES = Path(__file__).parent / "tracees"

PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
WALL = 0x40000000  # __WALL of linux/wait.h
LEAVE_S = 30.0
"""How long a process that a test has told to end may take for it."""

settings.register_profile("busy", deadline=None)
settings.load_profile("busy")
"""An example may take as long as a busy machine takes for it."""

signal.signal(signal.SIGINT, signal.default_int_handler)
"""In the background of a shell we are started with Ctrl-C ignored, and so would be every program that a test interrupts."""


# --- Skip rules ------------------------------------------------------------------------------------------------------


@functools.cache
def compiler() -> str | None:
    """The C compiler's path, or None when it or the C library's headers are missing."""
    path = shutil.which("gcc") or shutil.which("cc")
    if path is None:
        return None
    probe = subprocess.run([path, "-E", "-xc", "-"], input=b"#include <stdio.h>\n", capture_output=True, check=False)
    return path if probe.returncode == 0 else None


@functools.cache
def has_user_namespaces() -> bool:
    """Whether an ordinary user may make a user and a PID namespace here."""
    unshare = shutil.which("unshare")
    if unshare is None:
        return False
    return subprocess.run([unshare, "-Urpf", "true"], capture_output=True, check=False).returncode == 0


def why_not(item: pytest.Item) -> str | None:
    """The reason why this machine cannot run a test, or None when it can."""
    if item.get_closest_marker("root") and os.geteuid() != 0:
        return "needs root: run the tests as root to see it"
    if item.get_closest_marker("compiler") and compiler() is None:
        return "needs a C compiler and its headers: apt-get install gcc libc6-dev"
    if item.get_closest_marker("user_namespaces") and not has_user_namespaces():
        return "needs user namespaces, which this system forbids to ordinary users"
    if item.get_closest_marker("write_protection") and tracking_of(item.config) != PagemapTracker.name:
        return f"needs write protection of single pages; here they are found by {tracking_of(item.config)}"
    for marker in item.iter_markers("command"):
        if shutil.which(marker.args[0]) is None:
            return f"needs {marker.args[0]}, which is not installed here"
    return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what this machine cannot run, and say why."""
    reason = why_not(item)
    if reason is not None:
        pytest.skip(reason)


# --- On which machine, and how written pages are found -----------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    """The ways that this machine's kernel has besides the best one."""
    parser.addoption("--tracking", choices=["soft-dirty", "digest"], help="how written pages are found, instead of the best way")


@pytest.fixture(scope="session", autouse=True)
def _tracking(request: pytest.FixtureRequest) -> Iterator[None]:
    """Have engines in our own process find written pages in another way, as if this kernel had no better one."""
    wanted = request.config.getoption("--tracking")
    with pytest.MonkeyPatch.context() as patched:
        if wanted:
            patched.setattr(enter, "PagemapTracker", _no_write_protection)
        if wanted == "digest":
            patched.setattr(choose_tracker, "has_soft_dirty", lambda: False)
        yield


def tracking_of(config: pytest.Config) -> str:
    """How written pages are found in these tests."""
    return str(config.getoption("--tracking") or choose_tracker.best_tracking())


def _no_write_protection(pid: int, faults: int) -> Tracker:
    raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))


@pytest.fixture(scope="session", autouse=True)
def _machine(request: pytest.FixtureRequest, record_testsuite_property: Callable[[str, object], None]) -> None:
    """For ``--junitxml``, see ``tests/machines/seen.py``."""
    about = os.uname()
    record_testsuite_property("processor", about.machine)
    record_testsuite_property("kernel", about.release)
    record_testsuite_property("tracking", tracking_of(request.config))
    record_testsuite_property("page_size", abi.PAGE_SIZE)
    record_testsuite_property("on", time.strftime("%Y-%m-%d"))


# --- Tracees ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Compile ``tests/tracees/NAME.c`` once a session: ``compiled("heap")`` is the program's path."""
    made: dict[tuple[str, ...], Path] = {}

    def build(name: str, *flags: str) -> Path:
        key = (name, *flags)
        if key not in made:
            path = compiler()
            if path is None:
                pytest.skip("needs a C compiler and its headers: apt-get install gcc libc6-dev")
            program = tmp_path_factory.mktemp("tracees") / name
            page = f"-DPAGE={os.sysconf('SC_PAGESIZE')}UL"
            subprocess.run([path, "-O1", "-g", page, "-o", program, TRACEES / f"{name}.c", *flags], check=True)
            made[key] = program
        return made[key]

    return build


# --- No process left behind ------------------------------------------------------------------------------------------


def children() -> set[int]:
    """Our child processes, zombies included, by any of our threads."""
    found: set[int] = set()
    for task in Path("/proc/self/task").iterdir():
        try:
            found.update(map(int, (task / "children").read_text().split()))
        except FileNotFoundError:  # the thread ended meanwhile
            continue
    return found


def reap(pids: set[int]) -> set[int]:
    """Collect those of our children that have ended; return the ones that live."""
    alive = set()
    for pid in pids:
        try:
            ended, _ = os.waitpid(pid, os.WNOHANG)
        except ChildProcessError:  # collected by the test itself
            continue
        if ended == 0:
            alive.add(pid)
    return alive


def reap_threads(pid: int) -> None:
    """Collect the threads of a child that a test has left traced by us: until then it is no child that can be collected."""
    for task in Path(f"/proc/{pid}/task").glob("*"):
        with contextlib.suppress(ChildProcessError):
            os.waitpid(int(task.name), os.WNOHANG | WALL)


def command_of(pid: int) -> str:
    """What a process runs, for a message."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return "?"


@pytest.fixture(scope="session", autouse=True)
def _subreaper() -> Iterator[None]:
    """Orphans of the tests become our children instead of the machine's, so that they can be found and reaped."""
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
    yield
    libc.prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


@pytest.fixture(autouse=True)
def _no_process_left_behind(_subreaper: None) -> Iterator[None]:
    """Reap what a test left as zombies; a test that leaves a process running has failed, and the process is ended.

    Fixtures of a wider scope are set up before this one, so what they start is theirs to end.
    """
    before = children()
    yield
    alive = reap(children() - before)
    deadline = time.monotonic() + LEAVE_S
    while alive and time.monotonic() < deadline:
        time.sleep(0.01)
        alive = reap(children() - before)
    if not alive:
        return
    left = [f"{pid} ({command_of(pid)})" for pid in sorted(alive)]
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    deadline = time.monotonic() + LEAVE_S
    while children() - before and time.monotonic() < deadline:  # their own children come to us as they die
        for pid in reap(children() - before):
            os.kill(pid, signal.SIGKILL)
            reap_threads(pid)
        time.sleep(0.01)
    pytest.fail(f"the test left processes running: {', '.join(left)}")
