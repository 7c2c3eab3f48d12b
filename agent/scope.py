"""Components must outlive the agent's service: under systemd each guard and keeper gets a transient scope of its own.

A forked child would survive a restart only under ``KillMode=process``; a scope survives restart, stop, SIGKILL and watchdog under
every mode. Where systemd did not start the agent, nothing is needed: nobody kills a process group of ours.
"""

from __future__ import annotations

import os
import shutil
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
    properties = ("--property=Delegate=yes", f"--property=TimeoutStopSec={STOP_S}s")
    return (program, "--scope", "--quiet", "--collect", f"--slice={SLICE}", *properties, "--")
