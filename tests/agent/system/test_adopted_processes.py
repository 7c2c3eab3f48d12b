"""A process that a client names by its PID is the one whose owner was checked, or none."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agent.errors import GuardError, RefusedError
from agent.guard.freezer import SignalFreezer
from agent.system.adopted_process import Guest
from agent.system.permissions import Caller, guest_of
from agent.worker.components import launch
from agent.worker.components.paths import Places
from checkpoint.errors import ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn import namespaces
from checkpoint.linux.spawn.inherited_limits import Inheritance
from tests.agent.guards import PATIENCE_S, PYTHON, until
from tests.agent.worker.components.test_component import live

NAME = "/test/robot1/guest"
SOMEBODY, GIVEN = 7001, 42
CALLER = Caller(SOMEBODY, SOMEBODY, (), Inheritance(SOMEBODY, SOMEBODY))
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root: it becomes another user, and chooses a PID")


@contextmanager
def sleeping(*become: str) -> Iterator[int]:
    with subprocess.Popen([*become, "sleep", "1000"]) as process:
        try:
            until(lambda: procfs.status(process.pid).name == "sleep", "it to be executed")
            yield process.pid
        finally:
            process.kill()


def sleep() -> None:
    """In a child: be a program that has nothing in common with others."""
    nothing = os.open("/dev/null", os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    os.closerange(3, 4096)
    os.execvp("sleep", ["sleep", "1000"])


def victim() -> int:
    pid = os.fork()
    if pid == 0:
        sleep()
    until(lambda: procfs.status(pid).name == "sleep", "it to be executed")
    return pid


def end(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


@contextmanager
def successor(pid: int) -> Iterator[None]:
    """Another process, which has the number of one that has ended."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        helper = os.fork()
        if helper == 0:
            try:
                born = namespaces.sibling(pid)
            except OSError:
                os._exit(1)
            if born == 0:
                sleep()
            os._exit(0)
        if os.waitpid(helper, 0)[1] == 0:
            break
        assert time.monotonic() < deadline, "the number is not free"
    try:
        until(lambda: procfs.status(pid).name == "sleep", "the successor")
        yield
    finally:
        end(pid)


def named(pid: int) -> Guest:
    return guest_of(pid, Caller(os.geteuid(), os.getegid(), (), Inheritance(0, 0)))


def test_a_process_that_has_ended_is_known_to_have() -> None:
    with sleeping() as pid:
        guest = named(pid)
        assert not guest.has_ended
        os.kill(pid, signal.SIGKILL)
        until(lambda: guest.has_ended, "its end to be seen")
        guest.close()


@as_root
@pytest.mark.parametrize("keeps_running", [True, False])
def test_the_successor_of_a_process_that_was_named_is_not_taken_in(tmp_path: Path, keeps_running: bool) -> None:
    """It ended before its guard looked after it, or afterwards, before its keeper looked at it."""

    async def story(places: Places) -> None:
        pid = victim()
        guest = named(pid)
        if not keeps_running:
            end(pid)
            with successor(pid), pytest.raises(GuardError, match="No such process"):
                await launch.watch(NAME, guest, places)
            return
        component = await launch.watch(NAME, guest, places)
        end(pid)
        with successor(pid):
            with pytest.raises(ProcessGoneError, match="another process may have its number"):
                await component.protect()
            assert not component.keeper.is_there
            assert "TracerPid:\t0\n" in Path(f"/proc/{pid}/status").read_text()
            await component.ended
            await component.forget()

    live(tmp_path, story)


@as_root
def test_the_successor_of_a_process_that_is_held_is_not_stopped() -> None:
    pid = victim()
    guest, freezer = Guest(pid), SignalFreezer()
    freezer.add(pid, guest.fileno())
    end(pid)
    with successor(pid):
        freezer.freeze()
        freezer.kill()
        assert procfs.status(pid).state == "S"
    guest.close()


@as_root
@pytest.mark.parametrize(
    ("become", "why"),
    [
        (("--reuid=7001", "--regid=7001", "--clear-groups"), ""),
        (("--reuid=7001", "--rgid=7001", f"--egid={GIVEN}", "--clear-groups"), "is not a process of uid 7001"),
        (("--reuid=7001", "--regid=7001", f"--groups={GIVEN}"), "runs with gid 42, which uid 7001 has not"),
        (("--ruid=7001", "--euid=7002", "--regid=7001", "--clear-groups"), "is not a process of uid 7001"),
    ],
)
def test_ones_own_process_has_ones_own_users_and_groups_alone(become: tuple[str, ...], why: str) -> None:
    with sleeping("setpriv", *become) as pid:
        if why:
            with pytest.raises(RefusedError, match=why):
                guest_of(pid, CALLER)
            return
        guest = guest_of(pid, CALLER)
        assert guest.rights == Inheritance(SOMEBODY, SOMEBODY)
        guest.close()


@as_root
def test_a_group_that_the_caller_has_may_be_the_process_s_too() -> None:
    caller = Caller(SOMEBODY, SOMEBODY, (GIVEN,), CALLER.inheritance)
    with sleeping("setpriv", "--reuid=7001", "--regid=7001", f"--groups={GIVEN}") as pid:
        guest_of(pid, caller).close()


@as_root
def test_a_process_that_the_system_keeps_from_its_own_user_is_roots() -> None:
    """As one that has executed a set-user-id program, which gave its rights up again."""
    script = f"import ctypes, os, time; os.setresgid(*[{SOMEBODY}] * 3); os.setgroups([]); os.setresuid(*[{SOMEBODY}] * 3)"
    script += "; ctypes.CDLL(None).prctl(4, 0); print('ready', flush=True); time.sleep(1000)"
    with subprocess.Popen([PYTHON, "-S", "-c", script], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None and process.stdout.readline()
            with pytest.raises(RefusedError, match="is not a process of uid 7001"):
                guest_of(process.pid, CALLER)
        finally:
            process.kill()
