"""An adopted process: started by another program, named by its PID, and told apart from a later process with that PID.

Under protection it does not end with its guard by itself, and must not run without one. Without its guard, no process freezes it
in time, and another robot resumes it from its checkpoint; then it would run twice.

Source: pidfd_open(2), which polls as readable once the process has ended.
"""

from __future__ import annotations

import logging
import os
import select
import signal

from checkpoint.linux.spawn.inherited_limits import Inheritance

log = logging.getLogger("failover.component")


class Guest:
    """One process, which cannot be mistaken for a later one of its number.

    Attributes:
        rights: user and groups that it had when a client named it; None: no client named it.
    """

    def __init__(self, pid: int, rights: Inheritance | None = None) -> None:
        """
        Raises:
            ProcessLookupError, OSError: it has ended, or there is no such process.
        """
        self.pid, self.rights = pid, rights
        self._pidfd = os.pidfd_open(pid)

    def fileno(self) -> int:
        """Its pidfd, which stays this object's."""
        return self._pidfd

    @property
    def has_ended(self) -> bool:
        """Whether its number may be another process's by now. While False, every fact read by that number was its own."""
        watch = select.poll()
        watch.register(self._pidfd, select.POLLIN)
        return bool(watch.poll(0))

    def end(self, component: str) -> None:
        """End it, if we may: one of another user's than the agent's cannot be ended without a capability."""
        try:
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
        except ProcessLookupError:
            pass
        except PermissionError:
            log.error("%s: pid %d lost its guard and runs on beside its successor: end it by hand", component, self.pid)

    def close(self) -> None:
        """Think no more of it."""
        os.close(self._pidfd)
