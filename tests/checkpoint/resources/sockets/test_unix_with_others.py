"""Unix sockets that lead to another process: after a restore they behave as if that had died, or is there again by its name."""

from __future__ import annotations

import array
import contextlib
import ctypes.util
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, Terms
from checkpoint.errors import UnsupportedError
from tests.checkpoint.round_trip import (
    ENGINE,
    PATIENCE_S,
    Program,
    as_nobody,
    at_last,
    captured_and_killed,
    captured_at_last,
    ended,
    protected,
    restored,
    start,
)
from tests.failover.cli.test_verbs import failover

pytestmark = [pytest.mark.root]

PYTHON = shutil.which("python3", path="/usr/bin:/usr/local/bin")
"""That an ordinary user may execute, too."""
DAEMON = shutil.which("dbus-daemon")

ASKS = """
import errno, os, select, socket, sys, time

def told(act, *arguments):
    try:
        return act(*arguments)
    except OSError as error:
        return errno.errorcode[error.errno]

kind, path, sends = getattr(socket, sys.argv[1]), sys.argv[2], sys.argv[3].encode()
waits = int(sys.argv[4])
talks = socket.socket(socket.AF_UNIX, kind)
talks.connect(path)
if sys.argv[5:] == ["pair"]:
    content, (end,), _, _ = socket.recv_fds(talks, 1, 1)
    talks = socket.socket(fileno=end)
if sends:
    talks.send(sends)
polled = select.poll()
polled.register(talks, select.POLLIN | select.POLLOUT | select.POLLRDHUP)
while waits and not polled.poll()[0][1] & select.POLLIN:
    time.sleep(0.001)
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.01)
print("polled", polled.poll(0)[0][1])
talks.setblocking(False)
for _ in range(4):
    print("read", told(talks.recv, 100))
for _ in range(2):
    print("sent", told(talks.send, b"more"))
print("polled", polled.poll(0)[0][1], flush=True)
"""
"""Asks a server, leaves its answer unread until it is told to go on, and says what it finds at its end then."""

SERVES = """
import os, socket, time
with socket.socket(socket.AF_UNIX) as listener:
    listener.bind("served")
    listener.listen()
    first, _ = listener.accept()
    print("ready", flush=True)
    while not os.path.exists("go"):
        time.sleep(0.01)
    print("read", first.recv(100), first.recv(100))
    second, _ = listener.accept()
    print("read", second.recv(100))
    second.sendall(b"welcome")
    print("done", flush=True)
"""
"""Has a client, and accepts another one when it is told to."""

LOGS = """
import os, socket, time
log = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
log.connect(os.environ["LOG"])
log.send(b"before")
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.01)
log.send(b"after")
print("done", flush=True)
"""

TAKES = """
import os, socket, sys, time
talks = socket.socket(socket.AF_UNIX)
talks.connect(sys.argv[1])
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.01)
content, (file,), _, _ = socket.recv_fds(talks, 100, 1)
print(content, os.pread(file, 100, 0), talks.recv(100), flush=True)
"""

FAMILY = """
import os, socket, sys, time
ours, theirs = socket.socketpair()
if child := os.fork():
    theirs.close()
    while not os.path.exists("go"):
        time.sleep(0.01)
    content = ours.recv(100), ours.recv(100)
    print("parent", *content, flush=True)
    ours.close()
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
ours.close()
talks = socket.socket(socket.AF_UNIX)
talks.connect(sys.argv[1])
talks.sendall(b"ask")
theirs.sendall(b"between")
print("ready", flush=True)
while not os.path.exists("go"):
    time.sleep(0.01)
theirs.shutdown(socket.SHUT_WR)
theirs.recv(100)
print("child", talks.recv(100), talks.recv(100), flush=True)
"""

ANSWERS = """
import os, socket, sys, time
listener = socket.socket(socket.AF_UNIX)
listener.bind(sys.argv[1])
os.chmod(sys.argv[1], 0o777)
listener.listen()
print("ready", flush=True)
accepted, _ = listener.accept()
accepted.recv(100)
accepted.sendall(b"onetwo")
time.sleep(1000)
"""

LAUNCHES = """
import socket, subprocess, sys
ours, theirs = socket.socketpair()
ours.sendall(b"hello")
child = subprocess.Popen([sys.executable, "-c", sys.argv[1], str(theirs.fileno())], pass_fds=[theirs.fileno()])
print(child.pid, flush=True)
child.wait()
"""

INHERITS = """
import os, socket, sys, time
with socket.socket(fileno=int(sys.argv[1])) as talks:
    print("ready", flush=True)
    while not os.path.exists("go"):
        time.sleep(0.01)
    print("read", talks.recv(100), talks.recv(100), flush=True)
"""

SD_BUS = """
import ctypes, os, sys, time
sd = ctypes.CDLL("libsystemd.so.0")
sd.sd_bus_get_unique_name.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_char_p)]

def opened():
    bus = ctypes.c_void_p()
    assert sd.sd_bus_new(ctypes.byref(bus)) >= 0
    assert sd.sd_bus_set_address(bus, os.environ["DBUS_SESSION_BUS_ADDRESS"].encode()) >= 0
    assert sd.sd_bus_set_bus_client(bus, 1) >= 0
    assert sd.sd_bus_start(bus) >= 0
    return bus

def ask(bus):
    words = [b"org.freedesktop.DBus", b"/org/freedesktop/DBus", b"org.freedesktop.DBus", b"GetId"]
    return sd.sd_bus_call_method(bus, *words, None, None, None)

bus, count = opened(), 0
while not os.path.exists("go"):
    if (failed := ask(bus)) < 0:
        print("lost", failed, flush=True)
        sd.sd_bus_unref(bus)
        bus = opened()
        continue
    name = ctypes.c_char_p()
    sd.sd_bus_get_unique_name(bus, ctypes.byref(name))
    count += 1
    print(count, name.value.decode(), flush=True)
    time.sleep(0.02)
"""
"""A client of sd-bus that opens the bus again when it has lost it."""

LIBDBUS = """
import ctypes
dbus = ctypes.CDLL("libdbus-1.so.3")
dbus.dbus_bus_get.restype = ctypes.c_void_p
dbus.dbus_connection_read_write_dispatch.argtypes = [ctypes.c_void_p, ctypes.c_int]
bus = dbus.dbus_bus_get(0, None)
assert bus
print("ready", flush=True)
while dbus.dbus_connection_read_write_dispatch(bus, 20):
    pass
"""
"""A client of libdbus as that is by default: it exits when the bus is gone."""


class Peer:
    """Another process's end of what a program has: of ours."""

    def __init__(self, path: Path, kind: int, answers: bytes = b"") -> None:
        self._kind, self._answers = kind, answers
        self._kept: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, kind)
        self._listener.bind(str(path))
        self._listener.settimeout(PATIENCE_S)
        if kind != socket.SOCK_DGRAM:
            self._listener.listen()

    def serve(self) -> None:
        """Accept one client, read what it says, and answer."""
        accepted = self.accepted()
        assert accepted.recv(100) == b"ask"
        for piece in self._answers.split():
            accepted.send(piece)

    def give_pair(self) -> None:
        """Give one client an end of a pair; what is written to the other waits there."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._kept.append(ours)
        ours.send(b"first")
        with self.accepted() as accepted, theirs:
            socket.send_fds(accepted, [b"x"], [theirs.fileno()])

    def give_file(self, path: Path) -> None:
        """Send one client a file that it does not take yet."""
        with path.open("rb") as file:
            self.accepted().sendmsg([b"take"], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [file.fileno()]))])

    def heard(self) -> bytes:
        """The next datagram."""
        return self._listener.recv(100)

    def accepted(self) -> socket.socket:
        """The next connection."""
        accepted, _ = self._listener.accept()
        self._kept.append(accepted)
        return accepted

    def close(self) -> None:
        """Close all, as the kernel does for a process that ends."""
        for one in (*self._kept, self._listener):
            one.close()


CASES = {
    "stream": ("SOCK_STREAM", "ask", "1", Peer.serve, b"one two"),
    "stream_read": ("SOCK_STREAM", "ask", "0", Peer.serve, b""),
    "packets": ("SOCK_SEQPACKET", "ask", "1", Peer.serve, b"one two"),
    "pair": ("SOCK_STREAM", "", "1", Peer.give_pair, b"pair"),
    "not_accepted": ("SOCK_STREAM", "", "0", None, b""),
    "not_accepted_sent": ("SOCK_STREAM", "ask", "0", None, b""),
    "datagrams": ("SOCK_DGRAM", "ask", "0", None, b""),
}
"""Kind of the socket, what the program sends, whether it awaits an answer, what its peer does, and with which content."""


@contextlib.contextmanager
def begun(case: str, directory: Path, path: Path) -> Iterator[tuple[Program, Peer]]:
    """A program at its end of a socket, and the other end."""
    kind, sends, waits, act, content = CASES[case]
    peer = Peer(path, getattr(socket, kind), content)
    more = ["pair"] if case == "pair" else []
    try:
        with ended(start([sys.executable, "-c", ASKS, kind, path, sends, waits, *more], directory)) as program:
            if act is not None:
                act(peer)
            program.wait_for_line("ready")
            yield program, peer
    finally:
        peer.close()


def last_words(program: Program) -> list[str]:
    """What it finds at its end when it is told to look."""
    program.tell()
    assert program.finish() == 0, program.complaints
    return program.output.splitlines()


@pytest.mark.parametrize("case", CASES)
def test_a_program_finds_at_its_end_what_it_finds_when_its_peer_dies(case: str, tmp_path: Path) -> None:
    alive, dead = tmp_path / "dead", tmp_path / "restored"
    alive.mkdir()
    dead.mkdir()
    with begun(case, alive, tmp_path / "first") as (program, peer):
        peer.close()
        (tmp_path / "first").unlink()
        expected = last_words(program)
    with begun(case, dead, tmp_path / "second") as (program, peer):
        state = captured_and_killed(program)
        peer.close()
        (tmp_path / "second").unlink()
        with ended(restored(state, dead)) as program:
            for _ in range(2):  # and as well when it was captured in that state
                state = captured_and_killed(program)
                program = restored(state, dead)
            with ended(program):
                assert last_words(program) == expected


@pytest.mark.parametrize("case", ["stream", "packets", "pair", "not_accepted"])
def test_the_report_and_each_checkpoint_say_what_ends(case: str, tmp_path: Path) -> None:
    with begun(case, tmp_path, tmp_path / "peer") as (program, _):
        report = ENGINE.probe(program.pid)
        assert report.supported, report.reasons
        where = "another process" if case == "pair" else str(tmp_path / "peer")
        assert any(f"with {where} ends" in note and "may exit" in note for note in report.notes), report.notes
        with protected(program) as session:
            assert any(f"with {where} ends" in note for note in captured_at_last(session, CaptureOrder()).notes)
            program.tell()
            program.finish()


def test_a_connection_that_is_opened_later_is_told_with_the_next_checkpoint(tmp_path: Path) -> None:
    opens = f"""
import os, socket, time
print("ready", flush=True)
while not os.path.exists("open"):
    time.sleep(0.01)
talks = [socket.create_connection(("127.0.0.1", int(os.environ["PORT"]))), socket.socket(socket.AF_UNIX)]
talks[1].connect({str(tmp_path / "peer")!r})
print("open", flush=True)
while not os.path.exists("close"):
    time.sleep(0.01)
for one in talks:
    one.close()
print("closed", flush=True)
time.sleep(1000)
"""
    peer = Peer(tmp_path / "peer", socket.SOCK_STREAM)
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as listener, contextlib.ExitStack() as stack:
        stack.callback(peer.close)
        env = {**os.environ, "PORT": str(listener.getsockname()[1])}
        program = stack.enter_context(ended(start([sys.executable, "-c", opens], tmp_path, env=env)))
        program.wait_for_line("ready")
        with protected(program) as session:
            notes = [captured_at_last(session, CaptureOrder(sequence=1)).notes]
            for number, step in enumerate(("open", "close"), start=2):
                (tmp_path / step).touch()
                program.wait_for_line("open" if step == "open" else "closed")
                notes.append(captured_at_last(session, CaptureOrder(sequence=number)).notes)
    told = [(any("TCP connection" in note for note in some), any("unix socket" in note for note in some)) for some in notes]
    assert told == [(False, False), (True, True), (False, False)], notes


@pytest.mark.parametrize("case", ["stream", "not_accepted", "pair"])
def test_an_operator_may_have_it_refused(case: str, tmp_path: Path) -> None:
    order = ProtectOrder("/test/asks", terms=Terms(refuses_connections=True))
    with (
        begun(case, tmp_path, tmp_path / "peer") as (program, _),
        pytest.raises(UnsupportedError, match='connections = "refuse"') as refused,
    ):
        at_last(lambda: ENGINE.protect(program.pid, order))
    assert "unix socket" in str(refused.value)


def test_an_operator_may_have_a_tcp_connection_refused(tmp_path: Path) -> None:
    asks = (
        "import os, socket; talks = socket.create_connection(('127.0.0.1', int(os.environ['PORT']))); print('ready', flush=True)"
    )
    order = ProtectOrder("/test/asks", terms=Terms(refuses_connections=True))
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as listener:
        env = {**os.environ, "PORT": str(listener.getsockname()[1])}
        with ended(start([sys.executable, "-c", f"{asks}; talks.recv(1)"], tmp_path, env=env)) as program:
            program.wait_for_line("ready")
            with pytest.raises(UnsupportedError, match=r'TCP connection.*connections = "refuse"'):
                at_last(lambda: ENGINE.protect(program.pid, order))


def test_a_server_loses_its_client_and_serves_the_next(tmp_path: Path) -> None:
    """Also one that waited to be accepted: it stays behind."""
    with ended(start([sys.executable, "-c", SERVES], tmp_path)) as program, contextlib.ExitStack() as stack:
        program.wait_until(lambda: (tmp_path / "served").exists(), "its socket")
        clients = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(3)]
        for one in clients[:2]:
            one.settimeout(PATIENCE_S)
            program.wait_until(lambda one=one: one.connect_ex(str(tmp_path / "served")) == 0, "its listening")  # type: ignore[misc]
            one.sendall(b"hello")
            program.wait_for_line("ready")
        report = ENGINE.probe(program.pid)
        assert report.supported, report.reasons
        assert any("1 connection that waits at" in note for note in report.notes), report.notes
        state = captured_and_killed(program)
        with ended(restored(state, tmp_path)) as program:
            clients[2].settimeout(PATIENCE_S)
            clients[2].connect(str(tmp_path / "served"))
            clients[2].sendall(b"again")
            program.tell()
            assert clients[2].recv(100) == b"welcome"
            assert program.finish() == 0
            assert program.output.splitlines()[1:] == ["read b'hello' b''", "read b'again'", "done"]


def test_an_end_that_another_process_has_accepted_needs_no_name_here(tmp_path: Path) -> None:
    """It bears the listener's, at which that process still listens."""
    peer = Peer(tmp_path / "peer", socket.SOCK_STREAM)
    words = [sys.executable, "-c", ASKS, "SOCK_STREAM", str(tmp_path / "peer"), "", "1", "pair"]
    with contextlib.closing(peer), ended(start(words, tmp_path)) as program, socket.socket(socket.AF_UNIX) as client:
        with peer.accepted() as control:
            client.connect(str(tmp_path / "peer"))
            client.sendall(b"hello")
            socket.send_fds(control, [b"x"], [peer.accepted().fileno()])
            program.wait_for_line("ready")
        state = captured_and_killed(program)
        client.close()
        with ended(restored(state, tmp_path)) as program:
            assert last_words(program)[2:4] == ["read b'hello'", "read b''"]


def test_processes_of_a_program_keep_what_leads_from_one_to_the_other(tmp_path: Path) -> None:
    """One of them has a connection with another process, too, which ends."""
    peer = Peer(tmp_path / "peer", socket.SOCK_STREAM, b"answer")
    with contextlib.closing(peer):
        program = start([sys.executable, "-c", FAMILY, str(tmp_path / "peer")], tmp_path, isolate=True)
        with ended(program):
            peer.serve()
            program.wait_for_line("ready")
            state = captured_and_killed(program)
        with ended(restored(state, tmp_path)) as program:
            assert last_words(program)[1:] == ["parent b'between' b''", "child b'answer' b''"]


@pytest.mark.parametrize("name", ["path", "abstract"])
def test_a_logger_is_there_again_by_its_name(name: str, tmp_path: Path) -> None:
    place = tmp_path / "log" if name == "path" else Path(f"\0failover-test-{os.getpid()}")
    logger = Peer(place, socket.SOCK_DGRAM)
    script = LOGS.replace('os.environ["LOG"]', repr(str(place)))
    with ended(start([sys.executable, "-c", script], tmp_path)) as program:
        program.wait_for_line("ready")
        state = captured_and_killed(program)
    logger.close()  # of the robot that has died
    place.unlink() if name == "path" else None
    logger = Peer(place, socket.SOCK_DGRAM)
    with contextlib.ExitStack() as stack:
        stack.callback(logger.close)
        program = stack.enter_context(ended(restored(state, tmp_path)))
        assert last_words(program) == ["ready", "done"]
        assert logger.heard() == b"after"


def test_a_file_that_was_on_its_way_from_another_process_arrives(tmp_path: Path) -> None:
    (tmp_path / "given").write_text("content")
    peer = Peer(tmp_path / "peer", socket.SOCK_STREAM)
    with ended(start([sys.executable, "-c", TAKES, tmp_path / "peer"], tmp_path)) as program:
        peer.give_file(tmp_path / "given")
        program.wait_for_line("ready")
        state = captured_and_killed(program)
        peer.close()
        with ended(restored(state, tmp_path)) as program:
            assert last_words(program)[1:] == ["b'take' b'content' b''"]


@pytest.mark.skipif(not PYTHON, reason="the system has no Python that an ordinary user may execute")
def test_an_ordinary_users_program_finds_the_same_at_its_end_of_root_s_server() -> None:
    assert PYTHON is not None
    with tempfile.TemporaryDirectory() as place:
        directory = Path(place)
        directory.chmod(0o777)
        server = subprocess.Popen([sys.executable, "-c", ANSWERS, directory / "peer"], stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None and server.stdout.readline() == "ready\n"

        def act() -> str:
            with ended(start([PYTHON, "-c", ASKS, "SOCK_STREAM", str(directory / "peer"), "ask", "1"], directory)) as program:
                program.wait_for_line("ready")
                state = captured_and_killed(program)
            with ended(restored(state, directory, own_eyes=True)) as program:
                return ", ".join(last_words(program)[2:])

        try:
            found = as_nobody(act)
        finally:
            server.kill()
            server.wait()
            server.stdout.close()
        reads = "read b'onetwo', read b'', read b'', read b''"
        assert found.startswith(f"{reads}, sent EPIPE, sent EPIPE, polled"), found


def test_the_commands_say_what_ends_and_take_the_rule(tmp_path: Path) -> None:
    path = tmp_path / "peer"
    words = [sys.executable, "-c", ASKS, "SOCK_STREAM", str(path), "ask", "1"]
    peer = Peer(path, socket.SOCK_STREAM, b"answer")
    with contextlib.closing(peer), (tmp_path / "out").open("wb") as out:
        program = subprocess.Popen(words, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=out, stderr=out)
        try:
            peer.serve()
            deadline = time.monotonic() + PATIENCE_S
            while not (tmp_path / "out").stat().st_size:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            checked = failover("check", str(program.pid), "--json")
            assert checked.returncode == 0 and f"with {path} ends" in checked.stdout and "may exit" in checked.stdout, checked
            file = str(tmp_path / "snapshot")
            refused = failover("capture", str(program.pid), "-o", file, "--connections", "refuse")
            assert refused.returncode == 1 and 'connections = "refuse" rules out' in refused.stderr, refused
            assert program.poll() is None and not os.path.exists(file)
            captured = failover("capture", str(program.pid), "-o", file)
            assert captured.returncode == 0 and f"with {path} ends when the program comes back" in captured.stderr, captured
        finally:
            program.kill()
            program.wait()
    (tmp_path / "go").touch()
    back = failover("restore", file, "--wait", cwd=tmp_path)
    assert back.returncode == 0 and f"with {path} ends\n" in back.stderr, back
    found = (tmp_path / "out").read_text()
    assert "read b'answer'\nread b''\n" in found and "sent EPIPE" in found, found


def test_an_end_that_who_started_the_program_has_too_stands_not_against_a_capture(tmp_path: Path) -> None:
    """A launcher keeps both ends of a pair, of which its child has inherited one."""
    with (tmp_path / "out").open("wb") as out:
        launcher = subprocess.Popen(
            [sys.executable, "-c", LAUNCHES, INHERITS], cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=out
        )
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not (tmp_path / "out").read_bytes().endswith(b"ready\n"):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        pid = (tmp_path / "out").read_text().split()[0]
        assert failover("check", pid).returncode == 0
        captured = failover("capture", pid, "-o", str(tmp_path / "snapshot"))
        assert captured.returncode == 0, captured
    finally:
        launcher.kill()
        launcher.wait()
    (tmp_path / "go").touch()
    back = failover("restore", str(tmp_path / "snapshot"), "--wait", cwd=tmp_path)
    assert back.returncode == 0 and (tmp_path / "out").read_text().endswith("read b'hello' b''\n"), back


@contextlib.contextmanager
def bus(directory: Path) -> Iterator[dict[str, str]]:
    """A D-Bus of its own; the environment by which clients find it."""
    assert DAEMON is not None
    address = f"unix:path={directory / 'bus'}"
    daemon = subprocess.Popen(
        [DAEMON, "--session", "--nofork", "--nopidfile", f"--address={address}"], stdin=subprocess.DEVNULL, cwd=directory
    )
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not (directory / "bus").exists():
            assert daemon.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        yield {**os.environ, "DBUS_SESSION_BUS_ADDRESS": address}
    finally:
        daemon.kill()
        daemon.wait()


@pytest.mark.skipif(not (DAEMON and ctypes.util.find_library("systemd")), reason="no dbus-daemon, or no libsystemd")
def test_a_client_of_d_bus_that_reconnects_comes_back(tmp_path: Path) -> None:
    with bus(tmp_path) as env, ended(start([sys.executable, "-c", SD_BUS], tmp_path, env=env)) as program:
        program.wait_for_output(100)
        state = captured_and_killed(program)
        before = len(program.output.splitlines())
        with ended(restored(state, tmp_path)) as program:
            program.wait_until(lambda: len(program.output.splitlines()) > before + 5, "the bus again")
            program.tell()
            assert program.finish() == 0, program.complaints
    lines = program.output.splitlines()
    counts = [int(line.split()[0]) for line in lines if not line.startswith("lost")]
    names = {line.split()[1] for line in lines if not line.startswith("lost")}
    assert counts == list(range(1, len(counts) + 1))
    assert sum(line.startswith("lost") for line in lines) == 1 and len(names) == 2, lines


@pytest.mark.skipif(not (DAEMON and ctypes.util.find_library("dbus-1")), reason="no dbus-daemon, or no libdbus")
def test_a_client_of_d_bus_that_exits_without_the_bus_is_told_of_beforehand(tmp_path: Path) -> None:
    with bus(tmp_path) as env, ended(start([sys.executable, "-c", LIBDBUS], tmp_path, env=env)) as program:
        program.wait_for_line("ready")
        notes = ENGINE.probe(program.pid).notes
        assert any("libdbus" in note and "may exit" in note for note in notes), notes
        state = captured_and_killed(program)
        with ended(restored(state, tmp_path)) as program:
            assert program.finish() == 1  # by libdbus itself
