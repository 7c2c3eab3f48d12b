"""Descriptors of every kind: captured, killed and restored three times in a row; then the program checks what it has.

One tracee for a family of kinds, one case for each thing that could be lost: see ``tests/tracees``.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, RestoreOptions
from checkpoint.engines.ptrace.restore import checks
from checkpoint.errors import CheckpointError, MismatchError, UnsupportedError
from checkpoint.linux.procfs import mounts, procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import descriptor as procfs_descriptor
from checkpoint.resources.events import aio, eventfd
from checkpoint.resources.events import timerfd as timerfd_kind
from checkpoint.resources.files import overmounted
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.restore_context import number_of
from tests.checkpoint.round_trip import (
    ENGINE,
    captured_and_killed,
    captured_at_last,
    covered,
    ended,
    expect_ok,
    expect_three_lives,
    protected,
    restored,
    start,
    start_tracee,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

CASES = {
    "event_descriptors": (
        "eventfd_counter eventfd_semaphore eventfd_full eventfd_many pidfd_self pidfd_thread namespaces ended_processes "
        "ended_directory "
        "timer_relative timer_absolute_monotonic timer_absolute_realtime timer_absolute_boottime timer_periodic timer_unread "
        "timer_disarmed signalfd_waiting "
        "epoll_simple epoll_ready epoll_nested epoll_once epoll_edge epoll_exclusive epoll_renumbered epoll_waiting"
    ),
    "path_descriptors": (
        "inotify_directories inotify_gaps inotify_deleted fifo_both fifo_reader fifo_deleted fifo_signals pipe_reopened "
        "path_only kernel_files file_locks leases pipe_of_packets own_streams"
    ),
    "memory_objects": "memfd_executed memfd_content memfd_sealed memfd_mapped posix_named posix_unlinked",
    "sockets": (
        "pair_stream pair_datagram pair_packets pair_much pair_options pair_half_closed rights_stream "
        "rights_datagram pair_orphan listener_path "
        "listener_abstract unix_with_itself unix_datagrams unix_fresh tcp_listener_4 tcp_listener_6 tcp_fresh udp_queue "
        "udp_options udp_group udp_group_of_other_family filtered tcp_shared_port"
    ),
    "unix_sockets": (
        "ghost_left ghost_directory name_taken_again waiting_stream waiting_packets named_senders named_pair makers travelling "
        "reset_stream reset_packets"
    ),
    "kernel_sockets": "netlink raw light_datagrams packets",
    "aio": "aio_events aio_around",
    "socket_settings": (
        "of_datagrams of_datagrams_6 of_streams of_listeners of_unix of_raw of_raw_6 numbered_like_tcp wide_senders"
    ),
    "internet_sockets": "udp_shut_down foreign_address rare_options closed_connection_4 closed_connection_6",
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("program", "case"), [(program, case) for program, cases in CASES.items() for case in cases.split()])
def test_what_a_program_has_open_is_as_it_was_after_three_restores(
    program: str, case: str, compiled: Compiled, tmp_path: Path
) -> None:
    tracee = start_tracee(compiled(program, "-O2"), tmp_path, case)
    expect_three_lives(tracee, tmp_path)


@pytest.fixture
def untold_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of event counters the kernel does not tell the kind, as before Linux 6.5."""
    told = Descriptor.fields.fget
    assert told is not None

    def untold(one: Descriptor) -> Mapping[str, str]:
        return {name: value for name, value in told(one).items() if name != "eventfd-semaphore"}

    monkeypatch.setattr(Descriptor, "fields", property(untold))
    monkeypatch.setattr(eventfd, "is_told", lambda one: False)


@pytest.mark.parametrize("case", CASES["event_descriptors"].split()[:4])
@pytest.mark.usefixtures("untold_kinds")
def test_event_counters_are_as_they_were_where_the_kernel_does_not_tell_of_which_kind_they_are(
    case: str, compiled: Compiled, tmp_path: Path
) -> None:
    expect_three_lives(start_tracee(compiled("event_descriptors", "-O2"), tmp_path, case), tmp_path)


@pytest.mark.usefixtures("untold_kinds")
def test_whoever_waits_for_an_event_counter_does_not_notice_that_it_was_asked_of_which_kind_it_is(
    compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("blocked", "-O2", "-pthread"), tmp_path)) as tracee:
        with protected(tracee) as session:
            for _ in range(5):
                captured_at_last(session, CaptureOrder())
        tracee.tell()
        expect_ok(tracee)


@pytest.mark.parametrize(("interval_ms", "ticks"), [(0, 1), (20, 3)])
def test_a_timer_that_goes_off_between_two_questions_has_gone_off(interval_ms: int, ticks: int) -> None:
    timer = timerfd(1_000_000, interval_ms)
    try:
        seen = procfs_descriptor(os.getpid(), timer)
        assert seen is not None and "ticks: 0" in seen.text
        arm(timer, 20, interval_ms)
        time.sleep(0.07)
        found = timerfd_kind.observe(OpenFile(os.getpid(), (seen,)), ())
        assert found["ticks"] == ticks or (interval_ms and number_of(found["ticks"]) > ticks)
        assert (number_of(found["value_ns"]) > 0) == bool(interval_ms)
    finally:
        os.close(timer)


@pytest.mark.parametrize("interval_ms", [0, 20])
def test_a_timer_that_has_not_gone_off_has_all_that_is_left(interval_ms: int) -> None:
    timer = timerfd(50_000, interval_ms)
    try:
        seen = procfs_descriptor(os.getpid(), timer)
        assert seen is not None
        found = timerfd_kind.observe(OpenFile(os.getpid(), (seen,)), ())
        assert found["ticks"] == 0 and 0 < number_of(found["value_ns"]) <= 50_000_000_000
    finally:
        os.close(timer)


def test_a_periodic_timer_that_is_due_and_has_not_gone_off_yet_is_not_taken_for_a_disarmed_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The kernel says of both that nothing is left: it notes that one goes off a moment after it should, on a busy machine."""
    genuine = timerfd_kind._times

    def of_a_late_one(timer: int) -> tuple[int, int, int]:
        interval_ns, value_ns, asked_ns = genuine(timer)
        return interval_ns, 0 if value_ns < 1_000_000 else value_ns, asked_ns

    monkeypatch.setattr(timerfd_kind, "_times", of_a_late_one)
    timer = timerfd(1_000_000, 60_000)
    try:
        seen = procfs_descriptor(os.getpid(), timer)
        assert seen is not None
        arm(timer, 1, 60_000)
        found = timerfd_kind.observe(OpenFile(os.getpid(), (seen,)), ())
        assert found["ticks"] == 1 and 59_000_000_000 < number_of(found["value_ns"]) <= 60_000_000_000
        arm(timer, 0, 60_000)
        found = timerfd_kind.observe(OpenFile(os.getpid(), (seen,)), ())
        assert (found["ticks"], found["value_ns"]) == (0, 0)
    finally:
        os.close(timer)


def timerfd(first_ms: int, interval_ms: int) -> int:
    """A timer of ours that runs."""
    timer = int(ctypes.CDLL(None).timerfd_create(time.CLOCK_MONOTONIC, os.O_CLOEXEC))
    assert timer >= 0
    arm(timer, first_ms, interval_ms)
    return timer


def arm(timer: int, first_ms: int, interval_ms: int) -> None:
    words = [word for ms in (interval_ms, first_ms) for word in divmod(ms * 1_000_000, 1_000_000_000)]
    assert ctypes.CDLL(None).timerfd_settime(timer, 0, struct.pack("<4q", *words), None) == 0


def test_direct_requests_of_which_nobody_can_tell_that_they_are_done_are_refused(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = os.stat(tmp_path)
    if not os.path.exists(aio.COUNTED.format(os.major(about.st_dev), os.minor(about.st_dev))):
        pytest.skip(f"needs a directory on a disk: {tmp_path} is on none")
    with ended(start_tracee(compiled("aio", "-O2"), tmp_path, "aio_direct")) as tracee:
        monkeypatch.setattr(aio, "COUNTED", "/nowhere/{}:{}/inflight")
        with pytest.raises(UnsupportedError, match="direct I/O"):
            ENGINE.protect(tracee.pid, ProtectOrder("/test/direct"))
        monkeypatch.undo()
        ENGINE.protect(tracee.pid, ProtectOrder("/test/direct")).close()


def test_a_namespace_in_which_the_program_does_not_live_is_refused(tmp_path: Path) -> None:
    leaves = "import ctypes, os, time; f = os.open('/proc/self/ns/uts', 0); ctypes.CDLL(None).unshare(0x4000000)\n"
    with ended(start([sys.executable, "-c", leaves + "print('ready', flush=True); time.sleep(600)"], tmp_path)) as program:
        program.wait_for_line("ready")
        with pytest.raises(UnsupportedError, match="a namespace in which the program does not live"):
            ENGINE.protect(program.pid, ProtectOrder("/test/elsewhere"))


def test_files_that_a_mount_covers_are_as_they_were_after_three_restores(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("path_descriptors", "-O2"), tmp_path, "covered")
    with covered(tmp_path / "place"):
        expect_three_lives(tracee, tmp_path)


def test_a_file_that_a_mount_covers_is_not_opened_for_an_ordinary_user(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("path_descriptors", "-O2"), tmp_path, "covered")
    with covered(tmp_path / "place"), ended(tracee):
        snapshot = captured_and_killed(tracee)
        with pytest.raises(MismatchError, match="which a mount covers, is opened again for root alone"):
            checks.require(snapshot, RestoreOptions(own_eyes=True), os.getpid())


@pytest.mark.parametrize("name", ["ä ö", "a\\b", "line\nbreak", "next\x85 line\u2028", os.fsdecode(b"\xff\x0c\r")])
def test_a_mount_point_is_read_whatever_its_name(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told = b"".join(b"\\%03o" % byte if byte in b" \t\n\\" else bytes((byte,)) for byte in os.fsencode(f"/mnt/{name}"))
    lines = b"22 1 8:1 / / rw - ext4 x rw\n23 22 0:5 / " + told + b" rw - tmpfs x rw\n"
    monkeypatch.setattr(procfs, "read_bytes", lambda *_: lines)
    assert overmounted._mount_point(mounts.mounts_of(1), "23") == f"/mnt/{name}"
    assert overmounted._mount_point(mounts.mounts_of(1), "") == overmounted._mount_point(mounts.mounts_of(1), "7") == ""
    places = [("/file", "22"), (f"/mnt/{name}/file", "23"), (f"/mnt/{name}", "23"), (f"/mnt/{name}er", "22")]
    assert [mounts.innermost(mounts.mounts_of(1), path) for path, _ in places] == [number for _, number in places]


def test_a_file_that_was_just_replaced_by_one_of_its_inode_number_is_not_taken_for_a_covered_one(tmp_path: Path) -> None:
    """As a database does with its journal: its path led to nothing a moment ago, and to the same inode now."""
    with (tmp_path / "journal").open("wb") as file:
        number, inode = file.fileno(), os.fstat(file.fileno()).st_ino
        text = Path(f"/proc/self/fdinfo/{number}").read_text()
        first = SimpleNamespace(number=number, inode=inode, target=file.name, text=text)
        held: Any = SimpleNamespace(pid=os.getpid(), first=first)
        assert overmounted.place_of(held) is None
        with covered(tmp_path):
            place = overmounted.place_of(held)
            assert place is not None and tmp_path.is_relative_to(place[0])


def test_a_file_that_a_mount_covers_and_that_has_changed_stops_the_restore(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("path_descriptors", "-O2"), tmp_path, "covered")
    with covered(tmp_path / "place"), ended(tracee):
        snapshot = captured_and_killed(tracee)
    (tmp_path / "place" / "file").write_text("short")
    with covered(tmp_path / "place"), pytest.raises(CheckpointError, match="which a mount covers, has another content"):
        restored(snapshot, tmp_path)


def test_a_named_pipe_is_made_where_it_is_missing(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("path_descriptors", "-O2"), tmp_path, "fifo_gone")
    with ended(tracee):
        snapshot = captured_and_killed(tracee)
    (tmp_path / "pipe").unlink()
    with ended(restored(snapshot, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_shared_memory_is_made_where_it_is_missing(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("memory_objects", "-O2"), tmp_path, "posix_named")
    with ended(tracee):
        snapshot = captured_and_killed(tracee)
    Path(tracee.output.splitlines()[0]).unlink()
    with ended(restored(snapshot, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_a_named_pipe_that_somebody_else_has_open_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("path_descriptors", "-O2"), tmp_path, "fifo_reader")) as tracee:
        with open(tmp_path / "pipe", "wb"), subprocess.Popen(["cat", tmp_path / "pipe"]) as cat:
            try:
                tracee.wait_until(lambda: str(tmp_path / "pipe") in _targets(cat.pid), "the other reader")
                with pytest.raises(UnsupportedError, match=f"pid {cat.pid}"):
                    ENGINE.protect(tracee.pid, ProtectOrder("/test/fifo"))
            finally:
                cat.kill()


def test_a_lock_that_somebody_else_has_taken_meanwhile_stops_the_restore(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("path_descriptors", "-O2"), tmp_path, "file_locks")
    with ended(tracee):
        snapshot = captured_and_killed(tracee)
    with open(tmp_path / "whole", "rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(CheckpointError, match=f"lock.*{tmp_path}/whole"):
            restored(snapshot, tmp_path)


def _targets(pid: int) -> list[str]:
    """Where its descriptors lead; one that it closes meanwhile leads nowhere."""
    found = []
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found.append(os.readlink(one))
    return found


def test_a_listener_whose_name_another_process_has_taken_is_refused_by_name(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("sockets", "-O2"), tmp_path, "listener_path")
    with ended(tracee):
        snapshot = captured_and_killed(tracee)
    (tmp_path / "listens.sock").unlink()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "listens.sock"))
        listener.listen()
        names = [held.facts.get("name") for held in snapshot.resources]
        assert b"listens.sock\0" in names or b"listens.sock" in names
        with pytest.raises(CheckpointError, match=r"listens\.sock"):
            restored(snapshot, tmp_path)


def test_shared_memory_that_another_process_has_mapped_is_refused(compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled("memory_objects", "-O2"), tmp_path, "posix_named")
    with ended(tracee):
        path = Path(tracee.output.splitlines()[0])
        maps = (
            f"import mmap, os, time; m = mmap.mmap(os.open('{path}', os.O_RDWR), 0); print('ready', flush=True); time.sleep(600)"
        )
        (tmp_path / "other").mkdir()
        with ended(start([sys.executable, "-c", maps], tmp_path / "other")) as other:
            other.wait_for_line("ready")
            with pytest.raises(UnsupportedError, match=f"pid {other.pid}"):
                ENGINE.protect(tracee.pid, ProtectOrder("/test/shared"))
        path.unlink()
