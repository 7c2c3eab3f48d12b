"""A driver that keeps a ledger of what it was told, who tells it, and a lamp: ``python messengers.py … driver …`` and so on."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import failover
from failover.drivers.here import DIRECTORY, ROBOT, TEAM
from failover.errors import CallRefusedError, MailboxFullError, NameUnknownError, NoAnswerError

PATH: Final = "Lab/Ledger"
SENDER_SHIFT: Final = 24
"""An entry is the sender's number, shifted, and the message's."""

PAGE: Final = 10_000
"""Entries of one answer."""

QUEUE: Final = 64
LIMIT: Final = "limit"
PAUSE_S: Final = 0.005


def be_on(stage: Path, directories: Path, address: str) -> None:
    """Find out on which robot this process runs: by the address that it may bind, as the driver's command is the same on both.

    Args:
        address: of robots, with their number left open; or of whoever knows where it is, the robot's name.
    """
    for number in (1, 2) if "{}" in address else [int(address.removeprefix("robot"))]:
        with contextlib.suppress(OSError), socket.socket() as one:
            if "{}" in address:
                one.bind((address.format(number), 0))
            os.environ |= {
                ROBOT: f"robot{number}",
                TEAM: str(stage / f"robot{number}" / "team"),
                DIRECTORY: str(directories / f"robot{number}"),
            }
            return
    raise SystemExit("this is no robot")


def drive(room: str) -> None:
    """Be the driver; ``room``: the most messages."""

    @failover.driver(PATH, alias="ledger")
    class Ledger:
        count: int = failover.kept(default=0)
        log: NDArray[np.uint32] = failover.kept(shape=(int(room),), dtype=np.uint32)

        @failover.command
        def add(self, sender: int, number: int) -> int:
            self.log[self.count] = sender << SENDER_SHIFT | number
            self.count += 1
            return self.count

        @failover.query
        def read(self, begin: int) -> list[int]:
            return [int(one) for one in self.log[begin : min(begin + PAGE, self.count)]]

    failover.run(Ledger)


def shine(name: str) -> None:
    """Be a driver of this robot alone, without an agent."""

    @failover.driver(f"Lab/{os.environ[ROBOT]}/{name}")
    class Lamp:
        @failover.query
        def read(self) -> str:
            return name

    failover.run(Lamp)


def send(number: str, count: str, record: str) -> None:
    """Post numbers up to the limit beside the record; note beforehand what is posted, then what came of it."""
    sender = int(number)
    file = os.open(record, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
    first = 1 + max((one for kind, one, _ in Record(Path(record)).read().lines if kind == "posted"), default=0)
    while True:
        try:
            proxy = failover.proxy("ledger", sender=f"s{sender}", queue=QUEUE)
            break
        except NameUnknownError:
            time.sleep(PAUSE_S)
    limit, allowed = Path(record).parent / LIMIT, 0
    for message in range(first, int(count) + 1):
        while message > allowed and message > (allowed := int(limit.read_text())):
            time.sleep(PAUSE_S)
        os.write(file, f"posted {message} 0\n".encode())
        while True:
            try:
                proxy.post("add", sender=sender, number=message).add_done_callback(partial(_note, file, message))
                break
            except MailboxFullError:
                time.sleep(PAUSE_S)
    proxy.flush()
    os.write(file, b"done 0 0\n")
    proxy.close()


def _note(file: int, message: int, future: Future[Any]) -> None:
    try:
        os.write(file, f"ok {message} {future.result()}\n".encode())
    except (CallRefusedError, NoAnswerError) as error:
        os.write(file, f"{getattr(error, 'kind', 'unanswered')} {message} 0\n".encode())


class Record:
    """What a sender has written; only what is new is read.

    Attributes:
        lines: (what, message, place in the ledger).
        answered: the newest message that was carried out, as the sender was told.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0
        self.lines: list[tuple[str, int, int]] = []
        self.answered = 0
        self.is_done = False

    def read(self) -> Record:
        """Take in the whole lines that have come since the last time."""
        with contextlib.suppress(FileNotFoundError), self._path.open("rb") as file:
            file.seek(self._at)
            content = file.read()
            content = content[: content.rfind(b"\n") + 1]
            self._at += len(content)
            for line in content.decode().splitlines():
                kind, message, place = line.split()
                self.lines.append((kind, int(message), int(place)))
                self.is_done |= kind == "done"  # the last answer may be noted after it
                if kind == "ok":
                    self.answered = max(self.answered, int(message))
        return self

    def oks(self) -> list[tuple[int, int]]:
        """(message, place) of the messages that were carried out, as the sender was told."""
        return [(message, place) for kind, message, place in self.lines if kind == "ok"]


def main(stage: str, directories: str, address: str, role: str, *arguments: str) -> None:
    """As a driver, a sender or a lamp, on whichever robot this is."""
    be_on(Path(stage), Path(directories), address)
    {"driver": drive, "sender": send, "lamp": shine}[role](*arguments)


if __name__ == "__main__":
    main(*sys.argv[1:])
