"""Starts guards, and what forks keepers, as transient systemd services: they inherit nothing from the agent's service.

A child of the agent would be in the agent service's cgroup. The child, its program and every restored program would then have
what that service has: its limits, capability bounding set, group, score for the OOM killer, seccomp filters, view of the files.
The parent of a transient service is systemd, which gives it what every service gets. The guard then gives the program what it
would inherit from the user who asked for it (`checkpoint.linux.spawn.inherited_limits`).

A shutdown ends the agent first and these services after it (``Before=`` orders ends the other way round, systemd.unit(5)).
A program that exits cleanly because the machine tells it to is not done: the agent records no end, and its standby takes over.

Where systemd did not start the agent, guards and keepers are its children and inherit what it was started with.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final, Literal

from checkpoint.linux.systemd_service import own_service

SLICE: Final = "failover.slice"
STARTED: Final = "SYSTEMD_EXEC_PID"
"""By it systemd (since version 248) names the process that it started; that process's children inherit the variable."""

STOP_S: Final = 5
"""How long a shutdown waits for a component to obey SIGTERM; one that is frozen never does, and the default is 90 s."""

ASK_S: Final = 2.5
"""How long systemd may take to answer a question; it has more to do just then. Without an answer a restart counts as a stop.

Less than the main loop waits for that answer (`agent.main_loop.departure.ASK_NS`).
"""

Kind = Literal["guard", "keepers", "hook", "directory"]

PROPERTIES: Final[dict[Kind, tuple[str, ...]]] = {
    "guard": ("Delegate=yes", f"TimeoutStopSec={STOP_S}s", "OOMScoreAdjust=-900", "UMask=0077"),
    "keepers": (f"TimeoutStopSec={STOP_S}s", "LimitNOFILE=65536", "UMask=0077", "OOMPolicy=continue"),
    "directory": (
        f"TimeoutStopSec={STOP_S}s",
        "UMask=0077",
        "NoNewPrivileges=yes",
        "PrivateDevices=yes",
        "ProtectHome=read-only",
    ),
    "hook": (f"TimeoutStopSec={STOP_S}s", "KillSignal=SIGKILL"),
}
"""Without its guard a program ends, so memory is taken from others first. A keeper is replaced, and the others live on. Of a hook
nothing outlives its limit, for what comes after it begins then: asked to end first, it could take as long as a stop may.
"""


def starter() -> str:
    """The command that asks systemd for a transient service; "" where systemd did not start our parent, or does not obey us.

    Called by the worker, whose parent is the service's main process. An agent that is merely a descendant of some service (of a
    CI runner, of a desktop's terminal) may live in namespaces where systemd's services are strangers.
    """
    if os.geteuid() != 0 or os.environ.get(STARTED) != str(os.getppid()) or not os.path.isdir("/run/systemd/system"):
        return ""
    return shutil.which("systemd-run") or ""


def in_a_unit(program: str, kind: Kind, name: str) -> list[str]:
    """What to put before a command line so that it runs in a service ``failover-KIND-NAME.service`` of its own.

    Args:
        program: what `starter` found.
    """
    service = own_service(_own_cgroups())
    order = (f"Before={service}",) if service else ()
    properties = [f"--property={one}" for one in (*PROPERTIES[kind], *order)]
    unit = f"--unit=failover-{kind}-{name}"
    begun = "oneshot" if kind == "hook" else "exec"  # systemd-run waits until that has come about: the end of a hook
    return [program, "--quiet", "--collect", f"--service-type={begun}", unit, f"--slice={SLICE}", *properties, "--"]


def is_restarted() -> bool:
    """Whether systemd ends this process's service in order to start it again: it is carrying out such a job.

    A stop, a shutdown, and a signal that came from elsewhere are none. Source: systemctl(1), ``list-jobs``.
    """
    systemctl, unit = shutil.which("systemctl"), own_service(_own_cgroups())
    if not starter() or systemctl is None or not unit:
        return False
    asked = [systemctl, "list-jobs", "--no-legend", "--no-pager", "--plain", "--full", unit]
    try:
        found = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=ASK_S, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return any(line.split()[1:3] == [unit, "restart"] for line in found.stdout.splitlines())


def _own_cgroups() -> str:
    return Path("/proc/self/cgroup").read_text(encoding="utf-8", errors="surrogateescape")
