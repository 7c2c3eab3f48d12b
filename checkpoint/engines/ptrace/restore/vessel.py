"""The facts and rights of a vessel, before it becomes the program."""

from __future__ import annotations

import os
import resource
from collections.abc import Mapping
from typing import Final

from msgspec import Struct

from checkpoint.linux.procfs import procfs
from checkpoint.model import Credentials

CAP_SETGID: Final = 6
CAP_SETUID: Final = 7
CAP_SETPCAP: Final = 8
CAP_SYS_RAWIO: Final = 17
CAP_SYS_CHROOT: Final = 18
CAP_SYS_PTRACE: Final = 19
CAP_SYS_ADMIN: Final = 21
CAP_SYS_RESOURCE: Final = 24
CAP_SYSLOG: Final = 34
CAP_PERFMON: Final = 38
CAP_BPF: Final = 39
CAP_CHECKPOINT_RESTORE: Final = 40


class Vessel(Struct, frozen=True):
    """The facts of a vessel before it becomes the program.

    Attributes:
        inner_pid: its PID as it sees it itself.
        credentials: the user that it runs as.
        affinity: processors that it may use.
        hard_limits: by RLIMIT number; -1 is infinity.
    """

    pid: int
    inner_pid: int
    credentials: Credentials
    affinity: frozenset[int]
    hard_limits: Mapping[int, int]

    def may(self, capability: int) -> bool:
        """Whether a capability is in force."""
        return bool(self.credentials.capabilities[2] >> capability & 1)

    @property
    def may_choose_executable(self) -> bool:
        """Whether it may say what /proc/PID/exe shows."""
        return self.may(CAP_CHECKPOINT_RESTORE) or self.may(CAP_SYS_ADMIN)


def look_at_vessel(pid: int) -> Vessel:
    """Read the facts and rights of a vessel."""
    status = procfs.status(pid)
    credentials = Credentials(status.uids, status.gids, status.groups, status.capabilities)
    return Vessel(pid, status.pids[-1], credentials, frozenset(os.sched_getaffinity(pid)), _hard_limits(pid))


def _hard_limits(pid: int) -> dict[int, int]:
    return {number: resource.prlimit(pid, number)[1] for number in range(16)}
