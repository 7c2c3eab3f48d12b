"""The fencing token of an unmodified program: an environment variable that holds the epoch under which this copy runs.

A program is started with ``FAILOVER_EPOCH=`` and twenty digits. They are in its memory, where the kernel shows them as
/proc/self/environ. A restore writes the digits of its own epoch over those of the snapshot. The first capture of a copy that
continues under a later epoch writes them, too. So the token belongs to the copy: the old copy keeps its token, even if the two
robots share files or names. Nothing is open while the program is captured.

In C, getenv(3) returns the place itself, so it returns the present epoch each time. Other languages copy their environment at
their start: `failover.epoch` asks the C library, a shell script reads /proc/$$/environ. A program that writes over its
environment, as some do to change what ps(1) shows, has no token after that.

The copy may be running meanwhile, so the last digit is written first. A reader that reads the digits in their order sees at most
the new epoch: the first digits of the old one, the last ones of the new one.
"""

from __future__ import annotations

from typing import Final, Protocol

VARIABLE: Final = "FAILOVER_EPOCH"
DIGITS: Final = 20
"""Digits of any epoch: it is less than 2**64."""

ENVIRONMENT_MAX: Final = 8 << 20
"""Bytes of an environment that are looked through; the kernel allows a quarter of the stack's limit, 2 MiB by default."""

_ASSIGNMENT: Final = f"{VARIABLE}=".encode()


class Memory(Protocol):
    """The memory of a process."""

    def read(self, address: int, size: int) -> bytes:
        """Read bytes at an address."""
        ...

    def write_each(self, contents: list[tuple[int, bytes]]) -> None:
        """Pieces, one after the other."""
        ...


def assignment(epoch: int) -> bytes:
    """The variable that a program is born with."""
    return _ASSIGNMENT + digits(epoch)


def digits(epoch: int) -> bytes:
    """An epoch, in as many bytes as any other."""
    return b"%020d" % epoch


def place_in(environment: bytes) -> int | None:
    """Offset of the digits in an environment as the kernel shows it; None where they do not stand."""
    offset = 0
    for entry in environment.split(b"\0"):
        told = entry[len(_ASSIGNMENT) :]
        if entry.startswith(_ASSIGNMENT) and len(told) == DIGITS and told.isdigit():
            return offset + len(_ASSIGNMENT)
        offset += len(entry) + 1
    return None


def renew(memory: Memory, start: int, end: int, epoch: int) -> None:
    """Write the epoch under which a copy goes on into its environment, where the digits stand there and say another.

    Args:
        start, end: of the environment, as the kernel tells them (proc_pid_stat(5)).

    Raises:
        CaptureError: its memory cannot be written.
    """
    if not 0 < end - start <= ENVIRONMENT_MAX:
        return
    environment = memory.read(start, end - start)
    place = place_in(environment)
    if place is not None and epoch_in(environment) != epoch:
        told = digits(epoch)
        memory.write_each([(start + place + index, told[index : index + 1]) for index in reversed(range(DIGITS))])


def epoch_in(environment: bytes) -> int:
    """The epoch that an environment tells; 0 where it tells none."""
    place = place_in(environment)
    return int(environment[place : place + DIGITS]) if place is not None else 0
