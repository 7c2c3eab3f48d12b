"""A driver that ends: its last answers to programs of its robot."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.drivers.local import Connection, close_all, framed
from tests.failover.drivers.serving import LIMIT_S, robot_alone


@pytest.mark.parametrize("reads", [True, False])
def test_the_last_answers_leave_before_connections_are_closed_and_nobody_who_does_not_read_holds_the_end_up(reads: bool) -> None:
    ours, theirs = socket.socketpair()
    connection = Connection(ours)
    content = b"x" * MESSAGE_SIZE_MAX
    assert connection.send(content) and connection.has_unsent
    found: list[bytes] = []

    def read() -> None:
        while part := theirs.recv(1 << 16):
            found.append(part)

    reader = threading.Thread(target=read)
    if reads:
        reader.start()
    close_all([connection], 60_000 if reads else 10)
    if not reads:
        read()
    else:
        reader.join()
    theirs.close()
    assert (b"".join(found) == framed(content)) is reads


TOLD_ANOTHER_THREAD = """
import pathlib, signal, sys, threading, time
import failover

@failover.driver("University/Lab/Lamp")
class Lamp:
    @failover.command
    def light(self) -> None: ...

def tell(main):
    while signal.getsignal(number) is before or not waits(main):
        time.sleep(0.01)
    signal.pthread_kill(threading.get_ident(), number)
    threading.Event().wait()

def waits(thread):
    return all(state(thread) == "S" for _ in range(20) if not time.sleep(0.005))

def state(thread):
    return pathlib.Path(f"/proc/self/task/{thread}/stat").read_text().rpartition(")")[2].split()[0]

number = signal.Signals(int(sys.argv[1]))
before = signal.getsignal(number)
threading.Thread(target=tell, args=[threading.get_native_id()], daemon=True).start()
failover.run(Lamp)
print("it has ended")
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_does_not_end_the_wait_for_messages_ends_the_driver(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel may give it another thread, or it comes right before the wait: Python calls the handler after it only."""
    robot_alone(tmp_path, monkeypatch)
    command = [sys.executable, "-c", TOLD_ANOTHER_THREAD, str(int(number))]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert ran.stdout == "it has ended\n", ran.stderr


ENDED_WHILE_MADE = """
import os, sys
import failover

@failover.driver("University/Lab/Lamp")
class Lamp:
    def __init__(self) -> None:
        os.kill(os.getpid(), int(sys.argv[1]))

    @failover.command
    def light(self) -> None: ...

failover.run(Lamp)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_driver_that_is_ended_before_it_is_ready_ends_in_order(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot_alone(tmp_path, monkeypatch)
    command = [sys.executable, "-c", ENDED_WHILE_MADE, str(int(number))]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
