"""A program that keeps its state under ordinary abuse: threads, signals in a commit, limits, exec, odd places."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import failover
from checkpoint.segment.task_messages import Begin, Safe, encode
from failover.errors import KeepError, NotCommittedError, TaskError
from failover.kept_state.agent_link import Guarded
from failover.kept_state.api import PROCESS

ROOT = Path(__file__).parents[3]
PATIENCE_S = 60


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """States lie in a folder of the test's own, and none is kept when it ends."""
    monkeypatch.setenv("FAILOVER_STATE", str(tmp_path))
    monkeypatch.delenv("FAILOVER_COMPONENT", raising=False)
    yield tmp_path
    PROCESS.release()


def ran(folder: Path, text: str) -> list[str]:
    """What a program prints that ends by itself."""
    path = folder / "program.py"
    path.write_text(textwrap.dedent(text))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(path)], capture_output=True, text=True, check=False, env=environment, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\n")[:-1]


def test_threads_may_commit_at_once() -> None:
    state = failover.resume("mission", default={"n": 0})
    numbers: list[int] = []

    def commit_often() -> None:
        for _ in range(100):
            numbers.append(failover.commit())

    threads = [threading.Thread(target=commit_often) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(numbers) == 400
    state["n"] = 7
    failover.commit()
    PROCESS.release()
    assert failover.resume("mission", default={"n": 0}) == {"n": 7}


INTERRUPTED = """
    import failover, signal, time

    state = failover.resume("mission", default={{"n": 0, "copy": [0] * 3000}})
    refused = 0

    def interrupt(*_):
        {handler}

    def arm():
        signal.setitimer(signal.ITIMER_REAL, 0.0003)

    signal.signal(signal.SIGALRM, interrupt)
    deadline = time.monotonic() + 30
    while refused < 20 and time.monotonic() < deadline:
        try:
            arm()
            while True:
                state["n"] += 1
                state["copy"] = [state["n"]] * 3000
                failover.commit()
        except {error}:
            refused += 1
    signal.setitimer(signal.ITIMER_REAL, 0)
    failover.commit()
    print(refused, state["n"])
"""


@pytest.mark.parametrize(
    ("handler", "error"),
    [("failover.commit(); arm()", "failover.TaskError"), ("raise InterruptedError", "InterruptedError")],
    ids=["which commits is refused", "which raises leaves the last commit"],
)
def test_a_signal_handler_in_the_middle_of_a_commit(folder: Path, handler: str, error: str) -> None:
    """It must not wait for the commit that it interrupts, for that would be for good."""
    ((refused, last),) = (line.split() for line in ran(folder, INTERRUPTED.format(handler=handler, error=error)))
    assert int(refused) == 20
    state = failover.resume("mission", default={"n": 0, "copy": [0]})
    assert state == {"n": int(last), "copy": [int(last)] * 3000}


@contextmanager
def limited(kind: int, most: int) -> Iterator[None]:
    """A limit of this process; nothing may open a file meanwhile, or write much."""
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def segments() -> int:
    """How many this process has open."""
    links = []
    for name in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):
            links.append(os.readlink(f"/proc/self/fd/{name}"))
    return sum("failover-segment" in link for link in links)


@pytest.mark.parametrize(
    ("kind", "most"), [(resource.RLIMIT_NOFILE, 0), (resource.RLIMIT_FSIZE, 4096)], ids=["open files", "size of a file"]
)
def test_a_commit_that_a_limit_forbids_is_named_and_the_last_one_stands(kind: int, most: int) -> None:
    state = failover.resume("mission", default={"n": 0, "more": b""})
    failover.commit()
    failover.wait_committed(PATIENCE_S)
    before = segments()
    with limited(kind, most):
        state["more"] = bytes(1 << 20)  # more than there is room for: it needs another segment
        for _ in range(3):
            with pytest.raises(KeepError, match="cannot keep mission"):
                failover.commit()
        state["more"] = b""
        state["n"] = 1
        assert failover.commit() == 2, "what fits is committed"
    assert segments() == before, "nothing is left of those that failed"
    state["more"] = bytes(1 << 20)
    failover.commit()
    PROCESS.release()
    assert failover.resume("mission", default={"n": 0, "more": b""}) == {"n": 1, "more": bytes(1 << 20)}


def test_a_program_that_executes_itself_goes_on(folder: Path) -> None:
    lines = ran(
        folder,
        """
        import failover, os, sys
        state = failover.resume("mission", default={"n": 0})
        print(state["n"], flush=True)
        state["n"] += 1
        failover.commit()
        failover.wait_committed(60)
        if state["n"] < 3:
            os.execv(sys.executable, [sys.executable, *sys.argv])
        """,
    )
    assert lines == ["0", "1", "2"]


@pytest.mark.parametrize("place", ["/proc", "/dev/null"])
def test_a_place_where_nothing_can_be_kept_is_refused_with_its_name(monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    monkeypatch.setenv("FAILOVER_STATE", place)
    with pytest.raises(TaskError, match=f"cannot keep mission in {place}"):
        failover.resume("mission", default={"n": 0})


def test_an_on_resume_that_raises_leaves_the_state_as_it_was(folder: Path) -> None:
    text = """
        import failover

        @failover.component(name="mission")
        class Mission:
            n: int = failover.kept(default=0)

            def on_resume(self, resumed):
                self.n = -1
                raise RuntimeError("no camera")

            def step(self):
                self.n += 1
                return failover.FINISHED

        try:
            print(failover.run(Mission).n)
        except RuntimeError as error:
            print(error)
    """
    assert ran(folder, text) == ["1"]
    assert ran(folder, text) == ["no camera"]
    assert ran(folder, text.replace('raise RuntimeError("no camera")', "self.n += 11")) == ["11"]


@pytest.fixture
def guard() -> Iterator[tuple[Guarded, socket.socket]]:
    """A program's end of the task socket, begun, and the guard's."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    counters = os.memfd_create("counters")
    socket.send_fds(ours, [encode(Begin("/lab/mission", 1, (0, 0)))], [counters])
    os.close(counters)
    guarded = Guarded(theirs)
    yield guarded, ours
    guarded.close()
    ours.close()


def test_a_thread_that_waits_for_long_does_not_make_others_wait_longer_than_they_would(
    guard: tuple[Guarded, socket.socket],
) -> None:
    guarded, theirs = guard
    patient = threading.Thread(target=guarded.wait, args=(2, None))
    patient.start()
    began = time.monotonic()
    with pytest.raises(NotCommittedError, match=r"not safe after 0\.05 s"):
        guarded.wait(1, 0.05)
    assert patient.is_alive() and time.monotonic() - began >= 0.05
    theirs.send(encode(Safe(2)))
    patient.join()
    guarded.wait(1, 0.0)
