"""Resources that cannot be preserved are refused by name before the program is touched; the program runs on unaffected."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.capability import Verdict
from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.errors import ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.resources.files import regular
from checkpoint.resources.open_file import Surroundings
from checkpoint.resources.survey import gather
from tests.capability_table import row_of
from tests.checkpoint.round_trip import (
    ENGINE,
    as_nobody,
    captured,
    ended,
    expect_ok,
    protected,
    start,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

REFUSED = {
    "thread_files": "which its first thread has not",
    "thread_root": "a root directory of its own",
    "thread_namespace": "namespace",
    "child_in_the_same_memory": "shares its memory",
    "child_without_first_thread": "its first thread has ended while 1 others live",
    "traced_child": "traced",
    "unix_rights": "is on its way in a unix socket",
    "unix_waiting_data": "accepted with data",
    "unix_waiting_gone": "client has gone",
    "unix_urgent": "out-of-band",
    "udp_corked": "begun and not sent yet",
    "netlink_socket": "netlink socket of family 12",
    "netlink_answer": "answer of the kernel waits",
    "vsock": "a socket (vsock",
    "fanotify": "fanotify",
    "io_uring": "io_uring",
    "io_uring_mapped": "io_uring",
    "userfaultfd": "userfaultfd",
    "userfaultfd_registered": "userfaultfd",
    "lease_deleted": "lease",
    "kernel_log": "/dev/kmsg",
    "tun": "tun",
    "fuse": "fuse",
    "device_memory": "/dev/mem",
    "system_v_memory": "attached by other processes",
    "system_v_part": "unmapped a part",
    "message_queue": "queue",
    "bpf_map": "bpf",
    "perf_event": "perf",
    "pidfd_other": "pidfd of pid 1",
    "namespace": "does not live",
    "proc_file": "/proc",
    "kernel_switch": "for writing",
    "secret_memory": "secret",
    "own_namespace": "namespace",
    "namespace_of_children": "its children are to live in a pid namespace",
    "owner_group": "process group",
    "directory_notice": "f_notify",
    "no_vdso": "no vdso",
}
"""What each kind of ``tests/tracees/refused.c`` must be called in the refusal: one of the words, in any case."""


def _facts(pid: int) -> tuple[str, str, list[str]]:
    """What a touch would change: mappings, open descriptors, blocked and pending signals."""
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    signals = [line for line in status if line.startswith(("SigPnd", "SigBlk", "SigIgn", "SigCgt", "ShdPnd", "TracerPid"))]
    return Path(f"/proc/{pid}/maps").read_text(), " ".join(sorted(os.listdir(f"/proc/{pid}/fd"))), signals


@pytest.mark.parametrize("kind", [*REFUSED])
def test_what_cannot_be_preserved_is_refused_by_name_and_not_touched(kind: str, compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, kind)) as tracee:
        before = _facts(tracee.pid)
        report = ENGINE.probe(tracee.pid)
        with pytest.raises(UnsupportedError) as refusal:
            ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee")).close()
        assert _facts(tracee.pid) == before
        text = " ".join(refusal.value.reasons).lower()
        assert any(word in text for word in REFUSED[kind].split("|")), text
        assert not report.supported
        assert report.reasons == refusal.value.reasons
        assert [reason for reason in report.reasons if not _is_in_the_table(reason)] == []
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.parametrize(
    ("kind", "named"), [("segments", "segments of its own"), ("ports", "I/O ports"), ("flusher", "PR_SET_IO_FLUSHER")]
)
def test_what_only_the_program_itself_knows_is_refused_when_it_is_asked(
    kind: str, named: str, compiled: Compiled, tmp_path: Path
) -> None:
    """So `probe` does not know, and the pages by which it was asked stay behind."""
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, kind)) as tracee:
        for _ in range(2):
            with pytest.raises(UnsupportedError, match=named) as refusal:
                ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee"))
            assert [reason for reason in refusal.value.reasons if not _is_in_the_table(reason)] == []
        tracee.tell()
        expect_ok(tracee)


def _is_in_the_table(reason: str) -> bool:
    row = row_of(reason)
    return row is not None and row.verdict == Verdict.REFUSED


def test_a_program_that_handles_its_system_calls_itself_is_refused_and_hears_nothing_of_it(
    compiled: Compiled, tmp_path: Path
) -> None:
    """It can only be asked when it stands still, so `probe` does not know."""
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, "user_dispatch")) as tracee:
        before = _facts(tracee.pid)
        with pytest.raises(UnsupportedError, match="handles its system calls itself") as refusal:
            ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee")).close()
        assert _facts(tracee.pid) == before
        assert all(map(_is_in_the_table, refusal.value.reasons))
        tracee.tell()
        expect_ok(tracee)


def test_more_in_open_files_than_there_is_room_for_is_refused_by_name(tmp_path: Path) -> None:
    """Each is small enough, all together are not."""
    with ended(start([sys.executable, "-c", HOARDER, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        with pytest.raises(UnsupportedError, match="MiB in all"):
            session.capture(CaptureOrder(sequence=1))
        (tmp_path / "closed").touch()
        program.wait_for_line("closed")
        session.capture(CaptureOrder(sequence=2))


HOARDER = """
import os, sys, time
files = [os.open(sys.argv[1], os.O_TMPFILE | os.O_RDWR) for _ in range(3)]
for file in files:
    os.write(file, os.urandom(9 << 20))
print("ready", flush=True)
while not os.path.exists(os.path.join(sys.argv[1], "closed")):
    time.sleep(0.002)
os.close(files.pop())
print("closed", flush=True)
time.sleep(1000)
"""


def test_a_program_that_holds_nothing_special_is_not_refused(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, "nothing")) as tracee:
        report = ENGINE.probe(tracee.pid)
        assert report.supported, report.reasons
        captured(tracee)
        tracee.tell()
        expect_ok(tracee)


def test_a_program_of_32_bits_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "small.c"
    source.write_text('void _start(void) { for (;;) { int r; __asm__ volatile("int $0x80" : "=a"(r) : "a"(29) : "memory"); } }\n')
    build = ["gcc", "-m32", "-nostdlib", "-static", "-fno-pie", "-no-pie", "-o", tmp_path / "small", source]
    if subprocess.run(build, capture_output=True, check=False).returncode:
        pytest.skip("this compiler cannot build for 32 bits")
    with ended(start([tmp_path / "small"], tmp_path)) as program:
        program.wait_until(lambda: os.readlink(f"/proc/{program.pid}/exe").endswith("small"), "its executable")
        with pytest.raises((UnsupportedError, ProbeError)) as refusal:
            ENGINE.protect(program.pid, ProtectOrder("/test/small")).close()
        assert "32" in str(refusal.value) + " ".join(getattr(refusal.value, "reasons", ()))


def test_no_such_pid_is_said_so() -> None:
    child = subprocess.Popen(["/bin/true"])
    child.wait()
    with pytest.raises(ProbeError, match=str(child.pid)):
        ENGINE.probe(child.pid)
    with pytest.raises(ProbeError, match=str(child.pid)):
        ENGINE.protect(child.pid, ProtectOrder("/test/gone"))


@pytest.mark.parametrize("pid", [0, -1, 1 << 40])
def test_a_number_that_is_no_pid_is_said_so(pid: int) -> None:
    with pytest.raises(ProbeError):
        ENGINE.probe(pid)


def test_a_kernel_thread_is_refused() -> None:
    kthreadd = next((pid for pid in (2,) if Path(f"/proc/{pid}/comm").exists()), 0)
    if not kthreadd or Path(f"/proc/{kthreadd}/comm").read_text().strip() != "kthreadd":
        pytest.skip("no kernel thread is visible here")
    with pytest.raises(ProbeError, match="kernel"):
        ENGINE.probe(kthreadd)


def test_a_zombie_is_refused() -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    try:
        with pytest.raises(ProbeError, match=r"zombie|ended|dead"):
            ENGINE.probe(child)
    finally:
        os.waitpid(child, 0)


def test_ourselves_is_refused() -> None:
    with pytest.raises((ProbeError, UnsupportedError)):
        ENGINE.protect(os.getpid(), ProtectOrder("/test/self"))


@pytest.mark.command("strace")
def test_a_program_that_somebody_else_traces_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, "nothing")) as tracee:
        strace = subprocess.Popen(["strace", "-o", "/dev/null", "-p", str(tracee.pid)], stderr=subprocess.PIPE)
        try:
            tracee.wait_until(lambda: _tracer(tracee.pid) == strace.pid, "the other tracer")
            with pytest.raises(ProbeError, match=r"traced|tracer"):
                ENGINE.protect(tracee.pid, ProtectOrder("/test/traced"))
        finally:
            strace.send_signal(signal.SIGINT)
            strace.communicate()
        tracee.wait_until(lambda: _tracer(tracee.pid) == 0, "no tracer")
        captured(tracee)
        tracee.tell()
        expect_ok(tracee)


def _tracer(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith("TracerPid:"))


def test_a_stranger_is_not_let_in(compiled: Compiled, tmp_path: Path) -> None:
    """An ordinary user and a process of root's."""
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, "nothing")) as tracee:
        text = as_nobody(lambda: f"let in: {ENGINE.protect(tracee.pid, ProtectOrder('/test/stranger'))}")
        assert text.startswith("ProbeError: "), text
        tracee.tell()
        expect_ok(tracee)


def test_a_program_that_turns_into_something_unsupported_runs_on_and_can_be_captured_again(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", TURNCOAT, tmp_path], tmp_path)
    with ended(program):
        program.wait_for_line("ready")
        with protected(program) as session:
            first = session.capture(CaptureOrder(sequence=1))
            session.acknowledge(first.position)
            (tmp_path / "open").touch()
            program.wait_for_line("a pidfd")
            with pytest.raises(UnsupportedError, match="pidfd"):
                session.capture(CaptureOrder(base=False, sequence=2))
            (tmp_path / "end").touch()
            program.wait_for_line("no pidfd")
            again = session.capture(CaptureOrder(base=False, sequence=3))
            assert again.position.sequence == 3
        (tmp_path / "go").touch()
        assert program.finish() == 0


TURNCOAT = """
import os, sys, time
def wait_for(name):
    while not os.path.exists(os.path.join(sys.argv[1], name)):
        time.sleep(0.002)
print("ready", flush=True)
wait_for("open")
held = os.pidfd_open(1)
print("a pidfd", flush=True)
wait_for("end")
os.close(held)
print("no pidfd", flush=True)
wait_for("go")
"""


WAITS_WITH_A_PIDFD = """
import ctypes, os, select, sys
libc, events = ctypes.CDLL(None, use_errno=True), ctypes.create_string_buffer(64)
def step(name):
    print(name, flush=True)
    while not os.path.exists(os.path.join(sys.argv[1], "after " + name)):
        libc.usleep(2000)
step("ready")
epoll, pidfd = select.epoll(), os.pidfd_open(1)
print("waits", flush=True)
while not os.path.exists(os.path.join(sys.argv[1], "after waits")):
    if libc.epoll_wait(epoll.fileno(), events, 1, 100) < 0:
        print("interrupted", flush=True)
epoll.close()
os.close(pidfd)
step("closed")
"""


def test_a_program_that_was_refused_is_not_stopped_again_while_it_would_be_refused(tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", WAITS_WITH_A_PIDFD, tmp_path], tmp_path)) as program, protected(program) as session:
        program.wait_for_line("ready")
        session.capture(CaptureOrder(sequence=1))
        (tmp_path / "after ready").touch()
        program.wait_for_line("waits")
        for sequence in range(2, 30):
            with pytest.raises(UnsupportedError, match="pidfd"):
                session.capture(CaptureOrder(sequence=sequence))
        (tmp_path / "after waits").touch()
        program.wait_for_line("closed")
        assert program.output.count("interrupted") <= 1
        assert session.capture(CaptureOrder(sequence=30)).is_base


def test_a_stopped_program_is_still_stopped_after_a_capture(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("refused", "-O2"), tmp_path, "nothing")) as tracee:
        os.kill(tracee.pid, signal.SIGSTOP)
        tracee.wait_until(lambda: _state(tracee.pid) == "T", "it stopped")
        captured(tracee)
        tracee.wait_until(lambda: _state(tracee.pid) == "T", "it stopped again")  # it has some way there
        deadline = time.monotonic() + 0.1
        while time.monotonic() < deadline:
            assert _state(tracee.pid) == "T"
        tracee.tell()
        os.kill(tracee.pid, signal.SIGCONT)
        expect_ok(tracee)


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_a_program_that_ends_while_its_files_are_looked_at_has_ended_also_for_an_ordinary_user(tmp_path: Path) -> None:
    """He may not look into it any more, which is not the same as a file that no path leads to."""

    def act() -> str:
        place = tempfile.mkdtemp()
        with open(os.path.join(place, "out"), "w") as out, subprocess.Popen(["sleep", "1000"], stdout=out) as process:
            held = next(one for one in gather(process.pid) if one.name == "fd 1")
            assert regular.refuse(held, Surroundings()) is None
            process.kill()
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            with pytest.raises(ProcessGoneError, match="ended while its files were looked at"):
                regular.refuse(held, Surroundings())
        shutil.rmtree(place)
        return "ok"

    assert as_nobody(act) == "ok"
