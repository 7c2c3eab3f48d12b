"""When the main loop ends: at once; or, where another agent starts at once, after the peers have promised to wait for that one.

A signal begins it. The worker is asked whether systemd carries out a restart; without systemd `COMES_BACK` says so. Nothing here
acts: each method answers what the loop is to do next.
"""

from __future__ import annotations

import enum
import signal
from typing import Final

NANOSECONDS_A_SECOND: Final = 1_000_000_000

ASK_NS: Final = 3 * NANOSECONDS_A_SECOND
"""How long an end waits for the worker to find out whether it is a restart."""

DISK_NS: Final = 2 * NANOSECONDS_A_SECOND
"""How long a restart waits for this robot's own disk, once all that it waits for from its peers is there, or is not to come."""

LEAVE_NS: Final = 5 * NANOSECONDS_A_SECOND
"""How long a restart waits, beyond the grace, for what the core still waits for."""

COMES_BACK: Final = signal.SIGUSR1
"""Told by this, the agent announces that another one starts at once, as it does when systemd restarts it; then it ends."""

STOP_S: Final = 15
"""How long systemd waits for the next word of an agent that waits for its peers before it restarts."""

NEEDS_SHARE: Final = 5
"""It says so this often in that time, also where no watchdog is on."""


class Next(enum.Enum):
    """What the loop is to do: go on, ask the worker, have the core announce the restart, or end."""

    GO_ON = enum.auto()
    ASK = enum.auto()
    ANNOUNCE = enum.auto()
    END = enum.auto()


class Departure:
    """The end of one life of an agent.

    Args:
        grace_ns: for how long the peers are asked to wait.

    Attributes:
        is_begun: an end was asked for.
        is_restart: the peers are asked to wait.
    """

    def __init__(self, grace_ns: int) -> None:
        self._grace_ns = grace_ns
        self.is_begun = self.is_restart = self._is_announced = False
        self._until_ns = self._disk_ns = self._needs_ns = 0

    def signalled(self, numbers: bytes, now_ns: int) -> Next:
        """These signals came. A second one ends it as it is.

        The one by which systemd carries out a restart that was announced before is no second one.
        """
        if signal.SIGINT in numbers:
            return Next.END
        if self.is_begun:
            is_second = not self._is_announced or COMES_BACK in numbers
            self._is_announced = False
            return Next.END if is_second else Next.GO_ON
        if COMES_BACK in numbers:
            self._is_announced = signal.SIGTERM not in numbers
            return self._announce(now_ns)
        self.is_begun, self._until_ns = True, now_ns + ASK_NS
        return Next.ASK

    def answered(self, is_restart: bool, now_ns: int) -> Next:
        """The worker has found out whether it is a restart."""
        if self.is_restart:
            return Next.GO_ON
        return self._announce(now_ns) if is_restart else Next.END

    def _announce(self, now_ns: int) -> Next:
        self.is_begun = self.is_restart = True
        self._until_ns = now_ns + self._grace_ns + LEAVE_NS
        return Next.ANNOUNCE

    def may_end(self, may_go: bool, waits_for_disk: bool, now_ns: int) -> bool:
        """Whether an end that was begun need not wait any more.

        Args:
            may_go: the core waits for nothing. waits_for_disk: what it has ordered waits.
        """
        if now_ns >= self._until_ns or not self.is_restart:
            return now_ns >= self._until_ns
        self._disk_ns = (self._disk_ns or now_ns + DISK_NS) if may_go and waits_for_disk else 0
        return may_go and now_ns >= self._disk_ns

    def needs_s(self, now_ns: int) -> int:
        """How many seconds more systemd is to wait, from time to time while a restart waits; else 0."""
        if not self.is_restart or now_ns < self._needs_ns:
            return 0
        self._needs_ns = now_ns + STOP_S * NANOSECONDS_A_SECOND // NEEDS_SHARE
        return STOP_S
