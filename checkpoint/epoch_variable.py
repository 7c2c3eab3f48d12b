"""The fencing token of a program that nobody prepared: the epoch in its environment, always the one under which this copy runs.

A program is born with ``FAILOVER_EPOCH=`` and twenty digits. They stand in its memory, where the kernel shows them as
/proc/self/environ; a restore writes the digits of its own epoch over those of the snapshot. So the token belongs to the copy: the
old one keeps what it had, whatever files or names the two robots share, and nothing is open while the program is captured.

In C, getenv(3) returns the place itself, so it tells the present epoch each time. Other languages copy their environment at their
start: `failover.epoch` asks the C library, a shell script reads /proc/$$/environ. A program that writes over its environment, as
some do to change what ps(1) shows, has no token after that.

A copy that goes on under a later epoch without a restore keeps its token. After a total cut under the rule ``pair``
another copy may have had a later one in between: docs/fencing.md says what that costs.
"""

from __future__ import annotations

from typing import Final

VARIABLE: Final = "FAILOVER_EPOCH"
DIGITS: Final = 20
"""Of any epoch: it is less than 2**64."""

ENVIRONMENT_MAX: Final = 8 << 20
"""Bytes of an environment that are looked through; the kernel allows a quarter of the stack's limit, 2 MiB by default."""

_ASSIGNMENT: Final = f"{VARIABLE}=".encode()


def assignment(epoch: int) -> bytes:
    """What a program is born with."""
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


def epoch_in(environment: bytes) -> int:
    """The epoch that an environment tells; 0 where it tells none."""
    place = place_in(environment)
    return int(environment[place : place + DIGITS]) if place is not None else 0
