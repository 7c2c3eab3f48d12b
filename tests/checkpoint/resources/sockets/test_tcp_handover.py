"""TCP connections with others that move along: the peer, in a network of its own, sees one unbroken stream of bytes."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from checkpoint.model import Snapshot
from checkpoint.resources.sockets.tcp import TAKEN
from checkpoint.snapshot import format
from tests.failover.cli.test_verbs import COMMAND

pytestmark = [pytest.mark.root]

TALKERS = Path(__file__).parents[2] / "talkers.py"
PYTHON = getattr(sys, "_base_executable", sys.executable)
PATIENCE_S = 60.0
PORT = "7000"
ROOT = Path(__file__).resolve().parents[4]
HOLD = """
import os, signal
from checkpoint.engine import CaptureOrder, ProtectOrder, Terms; from checkpoint.engines.registry import engine_named
from tests.checkpoint.round_trip import at_last, captured_at_last
order = ProtectOrder("/test/talks", terms=Terms(connections=True))
session = at_last(lambda: engine_named("ptrace").protect({pid}, order))
captured_at_last(session, CaptureOrder(hold=True))
os.kill(os.getpid(), signal.SIGKILL)
"""
"""A keeper that dies while a program stands still for it."""
ADDRESSES = {4: ("10.77.0.9/24", "10.77.0.1/24"), 6: ("fd77::9/64", "fd77::1/64")}
"""Of the program, which moves, and of its peer."""
LOOPBACK = {4: "127.0.0.1", 6: "::1"}
OWN = {4: ("10.77.0.2/24", "10.77.0.3/24"), 6: ("fd77::2/64", "fd77::3/64")}
"""Of the two machines."""


def run(*words: str) -> str:
    """What a command said that must succeed."""
    ran = subprocess.run(words, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert ran.returncode == 0, f"{' '.join(words)}: {ran.stdout}{ran.stderr}"
    return ran.stdout


def until(condition: Callable[[], object], what: str) -> None:
    """Poll until something holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.01)


@dataclass(slots=True)
class Machines:
    """Two machines and a peer, each a network namespace, at one wire.

    Attributes:
        version: of IP.
        homes: where the program's address is now.
    """

    directory: Path
    version: int

    def name(self, machine: str) -> str:
        return f"failover-{os.getpid()}-{machine}"

    def ip(self, machine: str, *words: str) -> None:
        run("ip", "-n", self.name(machine), *words)

    def inside(self, machine: str) -> list[str]:
        """What to put before a command that is to run there, with the same files."""
        return ["nsenter", f"--net=/run/netns/{self.name(machine)}"]

    def give_address(self, machine: str) -> None:
        """The program's address is that machine's from now on, and the wire knows."""
        self.add_address(machine, "eth0", ADDRESSES[self.version][0])
        self.ip("peer", "neigh", "flush", "all")

    def add_address(self, machine: str, interface: str, address: str) -> None:
        self.ip(machine, "addr", "add", address, "dev", interface, *(["nodad"] if self.version == 6 else []))

    def take_address(self, machine: str) -> None:
        self.ip(machine, "addr", "del", ADDRESSES[self.version][0], "dev", "eth0")

    def start(self, machine: str, part: str, *how: str, between: Sequence[str] = ()) -> subprocess.Popen[bytes]:
        """Start a talker there; what it says is in a file of its name.

        Args:
            between: other addresses than `ADDRESSES`.
        """
        own, host = (address.partition("/")[0] for address in between or ADDRESSES[self.version])
        with (self.directory / part).open("ab") as output:
            return subprocess.Popen(
                [*self.inside(machine), PYTHON, str(TALKERS), part, host, PORT, own, *how],
                cwd=self.directory,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

    def said(self, part: str) -> list[str]:
        return (self.directory / part).read_text().splitlines()

    def failover(self, machine: str, *words: str, before: Sequence[str] = ()) -> subprocess.CompletedProcess[str]:
        command = [*self.inside(machine), *before, *COMMAND, *words]
        ran = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
        assert "Traceback" not in ran.stderr + ran.stdout
        return ran


@pytest.fixture(params=[4, 6])
def machines(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Machines]:
    """Two machines and a peer; the first has the program's address."""
    yield from laid(Machines(tmp_path, request.param))


@pytest.fixture
def machines_4(tmp_path: Path) -> Iterator[Machines]:
    """The same with IPv4 alone, for what does not depend on that."""
    yield from laid(Machines(tmp_path, 4))


def laid(made: Machines) -> Iterator[Machines]:
    """The wires of three machines, for the body."""
    try:
        for machine in ("one", "two", "peer"):
            run("ip", "netns", "add", made.name(machine))
            made.ip(machine, "link", "set", "lo", "up")
        made.ip("peer", "link", "add", "wire", "type", "bridge")
        for machine in ("one", "two"):
            made.ip("peer", "link", "add", machine, "type", "veth", "peer", "name", "eth0", "netns", made.name(machine))
            made.ip("peer", "link", "set", machine, "master", "wire", "up")
            made.ip(machine, "link", "set", "eth0", "up")
        made.ip("peer", "link", "set", "wire", "up")
        made.add_address("peer", "wire", ADDRESSES[made.version][1])
        for machine, address in zip(("one", "two"), OWN[made.version], strict=True):
            made.add_address(machine, "eth0", address)
        made.give_address("one")
        yield made
    finally:
        for machine in ("one", "two", "peer"):
            subprocess.run(["ip", "netns", "del", made.name(machine)], capture_output=True, check=False)


@contextlib.contextmanager
def laid_alone(made: Machines) -> Iterator[Machines]:
    """One machine without a wire, for the body."""
    run("ip", "netns", "add", made.name("one"))
    try:
        made.ip("one", "link", "set", "lo", "up")
        yield made
    finally:
        subprocess.run(["ip", "netns", "del", made.name("one")], capture_output=True, check=False)


def conversation(machines: Machines, ending: str = "", *how: str) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
    """A program and its peer, which have filled their connection in both directions, but for the one that ends."""
    called = machines.start("peer", "called", *(["ends"] if ending == "called" else []))
    until(lambda: machines.said("called") == ["listens"], "the peer to listen")
    caller = machines.start("one", "caller", *how, *(["ends"] if ending == "caller" else []))
    until(lambda: machines.said("caller") == ["ready"] and machines.said("called")[-1:] == ["ready"], "both ends to be full")
    return caller, called


def captured(machines: Machines, pid: int, *words: str) -> Path:
    """The program's snapshot, after which it has ended."""
    file = machines.directory / "snapshot"
    ran = machines.failover("one", "capture", str(pid), "-o", str(file), "--force", *words)
    assert ran.returncode == 0, ran.stderr
    return file


def refused_capture(machines: Machines, pid: int, *words: str, before: Sequence[str] = ()) -> str:
    """Why a program's connections cannot be taken along; no snapshot is left."""
    file = machines.directory / "refused"
    command = ["capture", str(pid), "-o", str(file), "--connections", "carry", *words]
    ran = machines.failover("one", *command, before=before)
    assert ran.returncode == 1
    assert not list(machines.directory.glob("*refused*"))
    return ran.stderr


def restored(machines: Machines, machine: str, file: Path, *words: str) -> tuple[int, str]:
    """The program's PID where it goes on, and what was said of that."""
    ran = machines.failover(machine, "restore", str(file), *words)
    assert ran.returncode == 0, ran.stderr
    return int(ran.stdout), ran.stderr


def asked_again(machines: Machines) -> int:
    """How often the peer's kernel has asked in vain whether there is room for what it has to say. Source: ss(8), -o."""
    shown = run("ip", "netns", "exec", machines.name("peer"), "ss", "-Htno", "sport", "=", f":{PORT}")
    found = re.search(r"timer:\(\w+,[^,]*,(\d+)\)", shown)
    return int(found[1]) if found else 0


def decoded(file: Path) -> Snapshot:
    """What a snapshot's file says."""
    with file.open("rb") as opened:
        return format.decode(opened.fileno())


def finish(machines: Machines, pid: int, called: subprocess.Popen[bytes]) -> None:
    """Have both read what they were told, and wait for their end."""
    (machines.directory / "go").touch()
    try:
        until(lambda: len(machines.said("caller")) > 1, "the program's verdict")
        until(lambda: called.poll() is not None, "the peer's verdict")
    finally:
        called.kill()
        called.wait()
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass


def expect_unbroken(machines: Machines, pid: int, called: subprocess.Popen[bytes]) -> None:
    """Both have read all that the other has said, in one piece."""
    finish(machines, pid, called)
    assert (machines.said("caller")[-1], machines.said("called")[-1]) == ("ok", "ok")


def test_a_connection_goes_along_with_all_that_waits_in_it(machines: Machines) -> None:
    caller, called = conversation(machines)
    file = captured(machines, caller.pid, "--connections", "carry")
    caller.wait()
    before = asked_again(machines)
    until(lambda: asked_again(machines) > before, "the peer to ask once more where nobody is left who could answer")
    machines.take_address("one")
    pid, notes = restored(machines, "two", file)
    assert "is reset (" not in notes, notes
    assert f"add {ADDRESSES[machines.version][0].partition('/')[0]} to one of its interfaces" in notes
    machines.give_address("two")
    expect_unbroken(machines, pid, called)


def test_so_does_one_whose_ends_use_no_timestamps(machines_4: Machines) -> None:
    run(*machines_4.inside("one"), "sh", "-c", "echo 0 >/proc/sys/net/ipv4/tcp_timestamps")
    test_a_connection_goes_along_with_all_that_waits_in_it(machines_4)


@pytest.mark.parametrize("ending", ["caller", "called"])
def test_so_does_one_that_has_ended_at_one_side(machines_4: Machines, ending: str) -> None:
    caller, called = conversation(machines_4, ending)
    file = captured(machines_4, caller.pid, "--connections", "carry")
    caller.wait()
    machines_4.take_address("one")
    pid, notes = restored(machines_4, "two", file)
    assert "is reset (" not in notes, notes
    machines_4.give_address("two")
    expect_unbroken(machines_4, pid, called)


def test_it_may_come_back_to_the_same_machine_again_and_again(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    pid = caller.pid
    for _ in range(3):
        file = captured(machines_4, pid, "--connections", "carry")
        pid, notes = restored(machines_4, "one", file)
        assert "is reset (" not in notes, notes
    caller.wait()
    expect_unbroken(machines_4, pid, called)


def test_a_program_that_is_left_running_keeps_its_connection_and_no_snapshot_may_have_it(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    refused = refused_capture(machines_4, caller.pid, "--leave-running")
    assert "only one of the two can have a connection, and the program keeps it; leave out --leave-running" in refused
    file = captured(machines_4, caller.pid, "--leave-running")
    assert not any(TAKEN in held.facts for held in decoded(file).resources)
    expect_unbroken(machines_4, caller.pid, called)
    caller.wait()


def test_without_the_right_the_capture_is_refused_and_the_program_talks_on(machines_4: Machines) -> None:
    """As an ordinary user, who has no CAP_NET_ADMIN."""
    caller, called = conversation(machines_4)
    refused = refused_capture(machines_4, caller.pid, before=["setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin"])
    assert "cannot take along the TCP connection fd 3 with 10.77.0.1 port 7000 (" in refused
    assert "it takes CAP_NET_ADMIN" in refused
    assert f"Pid {caller.pid} runs on, with its connections. To capture it without them: --connections reset" in refused
    expect_unbroken(machines_4, caller.pid, called)
    caller.wait()


def test_a_capture_says_which_connections_go_along(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    file = machines_4.directory / "snapshot"
    ran = machines_4.failover("one", "capture", str(caller.pid), "-o", str(file), "--connections", "carry")
    assert ran.returncode == 0, ran.stderr
    caller.wait()
    assert "the TCP connection fd 3 with 10.77.0.1 port 7000 goes along; its peer hears nothing until the restore" in ran.stderr
    assert "is reset" not in ran.stderr
    pid, _ = restored(machines_4, "one", file, "--connections", "carry")
    expect_unbroken(machines_4, pid, called)


def test_a_restore_that_is_to_take_up_all_is_refused_where_it_cannot_and_may_be_tried_again(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    file = captured(machines_4, caller.pid, "--connections", "carry")
    caller.wait()
    machines_4.ip("two", "link", "set", "eth0", "down")
    ran = machines_4.failover("two", "restore", str(file), "--connections", "carry")
    assert ran.returncode == 1
    assert "cannot be taken up: no route leads to 10.77.0.1 from here: Network is unreachable. Without them:" in ran.stderr
    pid, _ = restored(machines_4, "one", file, "--connections", "carry")
    expect_unbroken(machines_4, pid, called)


def test_a_restore_that_is_to_take_up_all_is_refused_where_the_capture_left_one(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    file = captured(machines_4, caller.pid)
    caller.wait()
    ran = machines_4.failover("one", "restore", str(file), "--connections", "carry")
    assert ran.returncode == 1
    assert "the TCP connection fd 3 with 10.77.0.1 port 7000 cannot be taken up: its capture did not take it along" in ran.stderr
    called.kill()
    called.wait()


@pytest.mark.parametrize("version", [4, 6])
@pytest.mark.parametrize("part", ["caller", "called"])
def test_either_end_of_a_connection_within_one_machine_goes_along(version: int, part: str, tmp_path: Path) -> None:
    """Over the loopback: the peer is another program of the same machine."""
    with laid_alone(Machines(tmp_path, version)) as machine:
        host = LOOPBACK[version]
        talkers = {"called": machine.start("one", "called", between=(host, host))}
        until(lambda: machine.said("called") == ["listens"], "the peer to listen")
        talkers["caller"] = machine.start("one", "caller", between=(host, host))
        until(lambda: all(machine.said(one)[-1:] == ["ready"] for one in talkers), "both ends to be full")
        file = captured(machine, talkers[part].pid, "--connections", "carry")
        talkers.pop(part).wait()
        (other,) = talkers.values()
        pid, notes = restored(machine, "one", file, "--connections", "carry")
        assert "TCP" not in notes, notes
        expect_unbroken(machine, pid, other)


def test_a_program_that_was_to_be_ended_and_was_not_goes_on_talking(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    nowhere = machines_4.directory / "nowhere" / "snapshot"
    ran = machines_4.failover("one", "capture", str(caller.pid), "-o", str(nowhere), "--connections", "carry")
    assert ran.returncode == 1
    assert "the program was not ended" in ran.stderr
    expect_unbroken(machines_4, caller.pid, called)
    caller.wait()


def test_one_that_fell_silent_with_its_keeper_is_heard_again_by_the_next(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    script = HOLD.format(pid=caller.pid)
    keeper = subprocess.run([*machines_4.inside("one"), sys.executable, "-c", script], check=False, cwd=ROOT)
    assert keeper.returncode == -signal.SIGKILL
    file = captured(machines_4, caller.pid, "--connections", "carry")
    caller.wait()
    pid, _ = restored(machines_4, "one", file)
    expect_unbroken(machines_4, pid, called)


def test_where_no_way_leads_to_the_peer_it_is_reset_and_that_is_said(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    file = captured(machines_4, caller.pid, "--connections", "carry")
    caller.wait()
    machines_4.ip("two", "link", "set", "eth0", "down")
    pid, notes = restored(machines_4, "two", file)
    assert "with 10.77.0.1 port 7000 is reset (no route leads to 10.77.0.1 from here: Network is unreachable)" in notes
    called.kill()
    finish(machines_4, pid, called)
    assert machines_4.said("caller")[-1] == "Connection reset by peer (104)"


def test_it_is_reset_where_who_restores_wants_it_so(machines_4: Machines) -> None:
    caller, called = conversation(machines_4)
    file = captured(machines_4, caller.pid, "--connections", "carry")
    caller.wait()
    pid, notes = restored(machines_4, "one", file, "--connections", "reset")
    assert "is reset (the program resumes from an older state)" in notes
    called.kill()
    finish(machines_4, pid, called)
    assert machines_4.said("caller")[-1] == "Connection reset by peer (104)"


def test_one_that_is_reset_where_it_was_silent_is_reset_at_its_peer_too(machines_4: Machines) -> None:
    """As after a crash that brings a program back onto the machine that it had left."""
    caller, called = conversation(machines_4)
    file = captured(machines_4, caller.pid, "--connections", "carry")
    caller.wait()
    pid, _ = restored(machines_4, "one", file, "--connections", "reset")
    finish(machines_4, pid, called)
    assert machines_4.said("called")[-1] in ("Connection reset by peer (104)", "Broken pipe (32)")


def test_one_that_is_on_its_way_in_a_message_is_not_taken_along(machines_4: Machines) -> None:
    caller, called = conversation(machines_4, "", "posts")
    assert "(it was on its way in a unix socket; once received, it is taken along)" in refused_capture(machines_4, caller.pid)
    file = captured(machines_4, caller.pid)
    caller.wait()
    pid, _ = restored(machines_4, "one", file)
    finish(machines_4, pid, called)
    assert machines_4.said("caller")[-1] == "Connection reset by peer (104)"
