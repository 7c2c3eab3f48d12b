"""Notifies systemd: sd_notify(3) without a library. Silent where systemd did not start the agent."""

from __future__ import annotations

import os
import socket

NANOSECONDS_A_MICROSECOND = 1_000


class Notifier:
    """Lines to the socket that systemd named; each a ``KEY=value`` of sd_notify(3)."""

    def __init__(self, address: str) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)

    def tell(self, *lines: str) -> None:
        """Send the lines in one datagram; a service manager that is gone or busy is not waited for."""
        if not self._address:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            return  # the watchdog is the judge of a lost line

    def ready(self, status: str) -> None:
        """The agent beats; units that depend on it may start."""
        self.tell("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def alive(self) -> None:
        """Feed the watchdog; called by the loop itself and by nothing else."""
        self.tell("WATCHDOG=1")

    def needs(self, seconds: int) -> None:
        """An end may take so many seconds more from now, whatever the unit allows. Source: sd_notify(3), EXTEND_TIMEOUT_USEC."""
        self.tell(f"EXTEND_TIMEOUT_USEC={seconds * 1_000_000}")

    def stopping(self) -> None:
        """An orderly end has begun."""
        self.tell("STOPPING=1")


def notifier() -> Notifier:
    """For the socket in ``$NOTIFY_SOCKET``; children do not inherit the variable."""
    return Notifier(os.environ.pop("NOTIFY_SOCKET", ""))


def watchdog_period_ns() -> int:
    """How often to feed systemd's watchdog: a third of its patience; 0 where it is off for us. Source: sd_watchdog_enabled(3)."""
    patience_us = int(os.environ.pop("WATCHDOG_USEC", "0") or 0)
    watched = os.environ.pop("WATCHDOG_PID", str(os.getpid()))
    return patience_us * NANOSECONDS_A_MICROSECOND // 3 if int(watched) == os.getpid() else 0
