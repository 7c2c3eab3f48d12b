"""Vessels and fresh programs: created with the requested PID, clocks and descriptors, and gone when they should be."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Birth, Born
from checkpoint.model import Clocks

DAY_NS = 86_400 * 1_000_000_000
OF_THE_C_LIBRARY = 3 << 31
"""Signals 32 and 33, of which it lets nobody say what they do. One may be ignored where pytest has workers."""
PATIENCE_S = 20.0


def gone(pid: int) -> bool:
    """Whether a process has ended, reaped or not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


def wait_until_gone(pid: int) -> None:
    """Wait for the end of a process whose parent has died; it comes to us, who are a subreaper, or to the machine's."""
    deadline = time.monotonic() + PATIENCE_S
    while not gone(pid):
        assert time.monotonic() < deadline, f"pid {pid} still lives"
        time.sleep(0.005)


def output_of(argv: list[str], birth: Birth) -> tuple[str, int]:
    """What a fresh program writes to its standard output, and its exit code."""
    read_end, write_end = os.pipe()
    null = os.open("/dev/null", os.O_RDWR)
    birth = Birth(birth.inner_pid, birth.isolate, birth.clocks, birth.elapsed_ns, (null, write_end, 2))
    try:
        born = vessel.spawn_program(argv, {"PATH": "/usr/bin:/bin"}, "/", 0o22, birth)
    finally:
        os.close(write_end)
        os.close(null)
    with os.fdopen(read_end) as reader:
        text = reader.read()
    _, status = os.waitpid(born.pid, 0)
    if born.init_pid:
        os.waitpid(born.init_pid, 0)
    return text, os.waitstatus_to_exitcode(status)


def pid_that_is_free() -> int:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    return child


def test_a_vessel_waits_with_three_descriptors_and_nothing_else() -> None:
    born = vessel.spawn_vessel(Birth())
    try:
        assert sorted(os.listdir(f"/proc/{born.pid}/fd")) == ["0", "1", "2"]
        assert "libc" not in Path(f"/proc/{born.pid}/maps").read_text()
        assert (born.inner_pid, born.init_pid, born.notes) == (born.pid, 0, ())
    finally:
        vessel.discard(born)
    assert gone(born.pid)


@pytest.mark.root
def test_a_vessel_gets_the_pid_that_it_is_to_have() -> None:
    wanted = pid_that_is_free()
    born = vessel.spawn_vessel(Birth(inner_pid=wanted))
    vessel.discard(born)
    assert (born.pid, born.notes) == (wanted, ())


def test_a_pid_in_use_becomes_another_and_a_note() -> None:
    born = vessel.spawn_vessel(Birth(inner_pid=os.getpid()))
    vessel.discard(born)
    assert born.pid != os.getpid()
    assert any(note.startswith("new PID") for note in born.notes)


@pytest.mark.root
def test_a_pid_of_one_that_was_not_waited_for_is_said_to_be_so() -> None:
    with subprocess.Popen(["true"]) as ended:
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
        born = vessel.spawn_vessel(Birth(inner_pid=ended.pid))
        vessel.discard(born)
        wanted = f"{ended.pid} is not available, it has ended, but its parent, pid {os.getpid()}, has not waited for it yet"
        assert any(wanted in note for note in born.notes), born.notes


@pytest.mark.user_namespaces
def test_an_isolated_vessel_has_its_pid_whatever_runs_outside() -> None:
    born = vessel.spawn_vessel(Birth(inner_pid=os.getpid(), isolate=True))
    vessel.discard(born)
    assert (born.inner_pid, born.isolated, born.notes) == (os.getpid(), True, ())


@pytest.mark.user_namespaces
def test_an_isolated_program_sees_only_its_own_processes() -> None:
    text, code = output_of(["sh", "-c", "echo $$; cd /proc; ls -d [0-9]* | wc -l; exit 3"], Birth(isolate=True))
    assert (text.split()[0], code) == ("2", 3)
    assert int(text.split()[1]) <= 4  # the first process, the shell, ls and wc


IN_A_CHROOT = """
set -e
mount -t tmpfs none "$1"
mkdir "$1/root"
for place in /*; do
    if [ -L "$place" ]; then
        cp -d "$place" "$1/root$place"
    elif [ -d "$place" ]; then
        mkdir "$1/root$place"
        mount --rbind "$place" "$1/root$place"
    fi
done
exec chroot "$1/root" "$2" -c "$3"
"""
ENTERS = """
import sys
sys.path[:] = {path!r}
from checkpoint.linux.spawn import namespaces
entered = namespaces.enter(pids=True, clocks=False)
print(entered.pids, *entered.notes)
"""


@pytest.mark.root
@pytest.mark.command("unshare")
def test_in_a_chroot_that_hands_its_mounts_on_a_program_shares_the_pids(tmp_path: Path) -> None:
    words = ["unshare", "-m", "sh", "-c", IN_A_CHROOT, "sh", str(tmp_path), sys.executable, ENTERS.format(path=sys.path)]
    seen = subprocess.run(words, capture_output=True, text=True, check=False)
    assert seen.returncode == 0, seen.stderr
    assert seen.stdout.startswith("False no namespace of its own for PIDs") and "mount --bind DIRECTORY DIRECTORY" in seen.stdout


@pytest.mark.user_namespaces
@pytest.mark.parametrize("days", [-3, 40])
def test_clocks_go_on_from_a_reading_of_a_machine_with_another_uptime(days: int) -> None:
    reading_ns = max(time.clock_gettime_ns(time.CLOCK_MONOTONIC) + days * DAY_NS, DAY_NS)
    clocks = Clocks(time.time_ns(), reading_ns, reading_ns + DAY_NS)
    text, _ = output_of(["cat", "/proc/uptime"], Birth(isolate=True, clocks=clocks, elapsed_ns=7_000_000_000))
    tick_ns = 10_000_000  # what /proc/uptime leaves off
    assert -tick_ns <= float(text.split()[0]) * 1e9 - (clocks.boottime_ns + 7_000_000_000) < PATIENCE_S * 1e9


def test_a_fresh_program_starts_with_default_signals_and_no_descriptor_of_ours() -> None:
    text, _ = output_of(["sh", "-c", "grep -E 'SigBlk|SigIgn' /proc/self/status; ls /proc/self/fd | wc -l"], Birth())
    _, blocked, _, ignored, count = text.split()
    assert int(blocked, 16) == 0
    assert int(ignored, 16) & ~OF_THE_C_LIBRARY == 0
    assert count == "4"  # ls itself has the directory open


@pytest.mark.parametrize("isolate", [False, pytest.param(True, marks=pytest.mark.user_namespaces)])
def test_a_program_that_is_not_there_is_an_error_and_leaves_nothing(isolate: bool) -> None:
    with pytest.raises(FileNotFoundError):
        vessel.spawn_program(["no-such-program"], {"PATH": "/usr/bin"}, "/", 0o22, Birth(isolate=isolate))


@pytest.mark.parametrize("isolate", [False, pytest.param(True, marks=pytest.mark.user_namespaces)])
def test_a_vessel_dies_with_the_process_that_spawned_it(isolate: bool) -> None:
    born = born_by_another_process(Birth(isolate=isolate))
    for pid in filter(None, (born.pid, born.init_pid)):
        wait_until_gone(pid)
        with contextlib.suppress(ChildProcessError):  # the first process ends when the vessel is reaped, by whomever
            os.waitpid(pid, 0)


def born_by_another_process(birth: Birth) -> Born:
    """Have a process spawn a vessel, and kill that process."""
    read_end, write_end = os.pipe()
    parent = os.fork()
    if parent == 0:
        try:
            born = vessel.spawn_vessel(birth)
            os.write(write_end, f"{born.pid} {born.inner_pid} {born.init_pid}".encode())
            signal.pause()
        finally:
            os._exit(1)
    os.close(write_end)
    pid, inner_pid, init_pid = map(int, os.read(read_end, 100).split())
    os.close(read_end)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    return Born(pid, inner_pid, init_pid)


def is_open(number: int) -> bool:
    """Whether a descriptor of this process is in use."""
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def test_the_first_process_keeps_nothing_of_who_restores(tmp_path: Path) -> None:
    """A restore looks who holds the program's files for writing: the first process, still a copy of who restores, does not."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(OSError):
            os.open(tmp_path / "out", os.O_WRONLY | os.O_CREAT)
            vessel._keep_only((write_end,), os.open("/dev/null", os.O_RDWR))
            os.write(write_end, " ".join(str(number) for number in range(256) if is_open(number)).encode())
        os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end) as reader:
        held = reader.read()
    os.waitpid(child, 0)
    assert held == f"0 1 2 {write_end}"
