"""The actuator that all programs of the team drive: outside every robot, it records each command, its sender, instant and order.

Run as ``python -m tests.chaos.actuator DIRECTORY COMPONENT…``. No fault reaches it: a unix socket exists for every network
namespace. The kernel says which process sent a command and when. A queue keeps the order in which commands were given, so the
check whether two copies acted at once needs no clock. A program that cannot have a socket (awk) writes to a named pipe, which
keeps the order as well, and reports the instant itself.

What a program says: ``COMPONENT STEP BEFORE SEAL EPOCH NETWORK`` commands a step, ``COMPONENT safe STEP SEAL`` reports what it
was told is safe. A seal follows from random numbers drawn in each step, so no two histories have the same; BEFORE is the seal of
the step before. The record has one line each: ``INSTANT PROCESS`` and the message; instants are nanoseconds of CLOCK_MONOTONIC.
"""

from __future__ import annotations

import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SOCKET: Final = "actuator"
RECORD: Final = "record"
SO_TIMESTAMPNS: Final = 35
"""asm-generic/socket.h; the kernel stamps a datagram of a unix socket when it is sent (net/unix/af_unix.c)."""

MESSAGE_SIZE: Final = 512
ANCILLARY_SIZE: Final = 256
PIPE_SIZE: Final = 1 << 20
_INSTANT: Final = struct.Struct("qq")
_CREDENTIALS: Final = struct.Struct("iii")


@dataclass(frozen=True, slots=True)
class Command:
    """One step that a copy of a program ordered.

    Attributes:
        at_ns: CLOCK_MONOTONIC.
        copy: names the running copy: no two that ever ran have the same.
        before, seal: of the step before, and of this one.
        epoch: the fencing token that the program found; 0 for none.
        network: the network namespace it was in, so: the robot. Of a program that cannot tell: when its process began.
    """

    at_ns: int
    copy: str
    component: str
    step: int
    before: int
    seal: int
    epoch: int
    network: str


@dataclass(frozen=True, slots=True)
class Safe:
    """A program was told that this step is safe."""

    at_ns: int
    component: str
    step: int
    seal: int


def pipe_of(directory: Path, component: str) -> Path:
    """The named pipe of a program that cannot have a socket."""
    return directory / f"{component}.pipe"


def read(line: str) -> Command | Safe:
    """One line of the record.

    Raises:
        ValueError: no program says such a thing.
    """
    at_ns, process, component, *words = line.split()
    if words[0] == "safe":
        return Safe(int(at_ns), component, int(words[1]), int(words[2]))
    step, before, seal, epoch, network = words
    return Command(int(at_ns), f"{process} {network}", component, int(step), int(before), int(seal), int(epoch or 0), network)


class Record:
    """The actuator's record, read as it grows."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._rest = b""

    def fresh(self) -> Iterator[Command | Safe]:
        """The lines written since the last call, in order."""
        *lines, self._rest = (self._rest + self._file.read()).split(b"\n")
        for line in lines:
            yield read(line.decode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def main(directory: Path, components: list[str]) -> None:
    """Hear until killed."""
    selector = selectors.DefaultSelector()
    hearing = _listen(directory / SOCKET)
    selector.register(hearing, selectors.EVENT_READ)
    for component in components:
        selector.register(_pipe(pipe_of(directory, component)), selectors.EVENT_READ)
    with (directory / RECORD).open("a", buffering=1) as record:
        print("ready", flush=True)
        while True:
            for key, _ in selector.select():
                lines = _datagrams(hearing) if key.fileobj is hearing else _piped(int(key.fd))
                record.writelines(lines)


def _listen(path: Path) -> socket.socket:
    hearing = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    hearing.bind(str(path))
    hearing.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
    hearing.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    return hearing


def _pipe(path: Path) -> int:
    """Open for both, so that it never ends."""
    os.mkfifo(path)
    return os.open(path, os.O_RDWR | os.O_NONBLOCK)


def _datagrams(hearing: socket.socket) -> Iterator[str]:
    while True:
        try:
            said, ancillary, _, _ = hearing.recvmsg(MESSAGE_SIZE, ANCILLARY_SIZE)
        except BlockingIOError:
            return
        at_ns, pid = time.monotonic_ns(), 0
        for _, kind, value in ancillary:
            if kind == SO_TIMESTAMPNS:
                seconds, rest = _INSTANT.unpack(value)
                at_ns = _monotonic_ns(seconds * 10**9 + rest)
            elif kind == socket.SCM_CREDENTIALS:
                pid, _, _ = _CREDENTIALS.unpack(value)
        yield f"{at_ns} {pid} {said.decode().strip()}\n"


def _piped(descriptor: int) -> Iterator[str]:
    """Whole lines: each was one write(2) of less than PIPE_BUF, and its last word says when (seconds since 1970)."""
    for line in os.read(descriptor, PIPE_SIZE).decode().splitlines():
        said, _, at_s = line.rpartition(" ")
        yield f"{_monotonic_ns(int(float(at_s) * 1e9))} 0 {said}\n"


def _monotonic_ns(wall_ns: int) -> int:
    """An instant of the calendar, on the monotonic clock, which no program sets."""
    return time.monotonic_ns() - (time.time_ns() - wall_ns)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
