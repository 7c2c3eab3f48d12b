"""Components must outlive the agent's service: under systemd each guard and keeper gets a transient scope of its own.

A forked child would survive a restart only under ``KillMode=process``; a scope survives restart, stop, SIGKILL and watchdog under
every mode. Where systemd did not start the agent, nothing is needed: nobody kills a process group of ours.

A shutdown ends the agent first and the scopes after it (``Before=`` orders ends the other way round, systemd.unit(5)). A program
that exits cleanly because the machine tells it to is not done: with nobody there to record an end, its standby takes over.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Final

SLICE: Final = "failover.slice"
INVOCATION: Final = "INVOCATION_ID"
"""systemd sets it for every service process."""


STOP_S: Final = 5
"""How long a shutdown waits for a component to obey SIGTERM; one that is frozen never does, and the default is 90 s."""


def launcher() -> tuple[str, ...]:
    """What to put before a guard's command line: nothing, or the way into a scope of its own."""
    if os.geteuid() != 0 or INVOCATION not in os.environ or not os.path.isdir("/run/systemd/system"):
        return ()
    program = shutil.which("systemd-run")
    if program is None:
        return ()
    properties = ["--property=Delegate=yes", f"--property=TimeoutStopSec={STOP_S}s"]
    service = own_service(Path("/proc/self/cgroup").read_text(encoding="utf-8", errors="surrogateescape"))
    if service:
        properties.append(f"--property=Before={service}")
    return (program, "--scope", "--quiet", "--collect", f"--slice={SLICE}", *properties, "--")


def own_service(cgroups: str) -> str:
    """The systemd service that a process belongs to, by its /proc/PID/cgroup; "" if none."""
    for line in cgroups.splitlines():
        controllers, path = line.split(":", 2)[1:]
        if controllers in ("", "name=systemd"):
            units = [part for part in path.split("/") if part.endswith(".service")]
            return units[-1] if units else ""
    return ""
