"""Somebody else's child under protection: it does not end with its guard by itself, and must not run without one.

Without its guard nobody freezes it in time, and it is resumed from its checkpoint: then it would run twice.
"""

from __future__ import annotations

import logging
import os
import signal

log = logging.getLogger("failover.component")


class Guest:
    """One process, which cannot be mistaken for a later one of its number."""

    def __init__(self, component: str, pid: int) -> None:
        """
        Raises:
            ProcessLookupError: it has ended.
        """
        self._component, self._pid = component, pid
        self._pidfd = os.pidfd_open(pid)

    def end(self) -> None:
        """End it, if we may: one of another user's than the agent's cannot be ended without a capability."""
        try:
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
        except ProcessLookupError:
            pass
        except PermissionError:
            log.error("%s: pid %d lost its guard and runs on beside its successor: end it by hand", self._component, self._pid)

    def close(self) -> None:
        """Think no more of it."""
        os.close(self._pidfd)
