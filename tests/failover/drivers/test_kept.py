"""A driver keeps its attributes and its mailbox: killed at any instant, it has carried out each message once, in order."""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import secrets
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from checkpoint.segment.task_messages import VARIABLE, Begin, Safe
from checkpoint.segment.task_messages import encode as encode_packet
from failover.core.messaging.envelope import Envelope, decode, encode
from failover.core.naming.tree import Place
from failover.drivers.here import Here, lives
from failover.drivers.local import LocalWay
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import DriverError, NameUnknownError
from tests.failover.drivers.serving import LIMIT_S, until
from tests.failover.kept_state.test_agent_link import says

ROOT = Path(__file__).parents[3]
PROGRAM = Path(__file__).parent / "counter.py"
SEED = random.randrange(1 << 32)


@contextlib.contextmanager
def counter(here: Here, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The driver as a process of its own; its state lies in the folder."""
    environment = {**os.environ, "FAILOVER_STATE": str(folder), "PYTHONPATH": str(ROOT)}
    with subprocess.Popen([sys.executable, PROGRAM], env=environment, stderr=subprocess.DEVNULL) as one:
        try:
            until(lambda: here.file("Lab/Counter", "calls").exists() and lives(here, "Lab/Counter"))
            yield one
        finally:
            one.kill()


def reached(here: Here) -> Proxy:
    """A proxy, as soon as the driver is registered."""
    found: list[Place] = []

    def is_found() -> bool:
        with contextlib.suppress(NameUnknownError):
            found.append(lookup(here, "counter"))
        return bool(found)

    until(is_found)
    return Proxy(here, found[0])


class Senders:
    """Threads that each send numbers, one after the other, until each is answered."""

    def __init__(self, here: Here, count: int, numbers: int) -> None:
        self.answers: dict[str, list[int]] = {f"s{place}": [] for place in range(count)}
        self._numbers = numbers
        self.threads = [threading.Thread(target=self._send, args=(here, name)) for name in self.answers]
        for thread in self.threads:
            thread.start()

    def _send(self, here: Here, name: str) -> None:
        with reached(here) as proxy:
            for number in range(self._numbers):
                self.answers[name].append(proxy.call("add", sender=name, number=number, timeout=LIMIT_S))

    @property
    def answered(self) -> int:
        """How many messages until now."""
        return sum(map(len, self.answers.values()))

    @property
    def are_done(self) -> bool:
        """Whether all was answered."""
        return not any(thread.is_alive() for thread in self.threads)


def test_each_message_is_carried_out_once_in_order_although_the_driver_is_killed(here: Here, folder: Path) -> None:
    print("seed", SEED)
    dice = random.Random(SEED)
    with counter(here, folder):
        senders = Senders(here, 3, 60)
        until(lambda: all(senders.answers.values()))
    kills = 1
    while not senders.are_done and kills < 5:
        with counter(here, folder):
            answered = senders.answered
            until(lambda before=answered: senders.are_done or senders.answered > before)  # type: ignore[misc]
            time.sleep(dice.random() / 20)  # the instant of death
        kills += 1
    with counter(here, folder):
        until(lambda: senders.are_done)
        with reached(here) as proxy:
            found = proxy.call("read", timeout=LIMIT_S)
    assert found["resumed"] == "restarted" and found["count"] == 180
    for name, answers in senders.answers.items():
        assert [number for sender, number in found["log"] if sender == name] == list(range(60))
        places = [place for place, (sender, _) in enumerate(found["log"], 1) if sender == name]
        assert answers == places, "each answer is that of its message"


def test_a_message_that_was_answered_before_the_death_gets_the_same_answer_after_it(here: Here, folder: Path) -> None:
    message = encode(
        Envelope("counter", "add", {"sender": "t", "number": 1}, id="x-1", sender="robot1/t", boot=7, seq=1, reliable=True)
    )
    way = LocalWay(str(here.file("Lab/Counter", "calls")))
    answers = []
    for _ in range(2):
        with counter(here, folder):
            assert way.await_sent(message, LIMIT_S * 10**9)
            content = way.await_message(LIMIT_S * 10**9)
            assert content is not None
            answers.append(decode(content))
            way._lose()
    way.close()
    assert answers[0].ok == answers[1].ok == 1 and answers[0].hops == answers[1].hops


def test_an_idle_driver_takes_in_what_its_guard_says_and_tells_that_it_has_gone(here: Here, folder: Path) -> None:
    name = f"failover.{secrets.token_hex(8)}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), VARIABLE: f"@{name}"}
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind("\0" + name)
        listener.listen(1)
        listener.settimeout(LIMIT_S)
        with subprocess.Popen([sys.executable, PROGRAM], env=environment, stderr=subprocess.PIPE, text=True) as driver:
            try:
                guard, _ = listener.accept()
                with guard:
                    says(encode_packet(Begin("/Lab/Counter", 3, (1, 2))), descriptors=1)(guard)
                    until(lambda: here.file("Lab/Counter", "calls").exists() and lives(here, "Lab/Counter"))
                    guard.send(encode_packet(Safe(1)))
                    until(lambda: unread(guard) == 0)
                assert driver.stderr is not None
                assert any("has gone" in line for line in driver.stderr)
                assert driver.poll() is None
            finally:
                driver.kill()


def unread(end: socket.socket) -> int:
    """Bytes that the other end has not taken. Source: unix(7), SIOCOUTQ."""
    return struct.unpack("i", fcntl.ioctl(end, termios.TIOCOUTQ, bytes(4)))[0]  # type: ignore[no-any-return]


def test_a_class_is_a_driver_or_a_component_and_not_both() -> None:
    with pytest.raises(DriverError, match="is a component"):

        @failover.driver("Lab/Both")
        @failover.component(name="both")
        class Both:
            count: int = failover.kept(default=0)

            def step(self) -> None: ...
