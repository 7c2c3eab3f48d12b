"""The systemd service that a process belongs to, and whether systemd starts that service again when its process ends.

Source: systemd.service(5), "Restart="; systemctl(1), "show"; systemd's docs/CGROUP_DELEGATION.md.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final, NamedTuple

ASK_S: Final = 2.5
"""How long systemd may take to answer; without an answer nothing is said."""

NEVER: Final = ("", "no")


class Service(NamedTuple):
    """A service, and what its ``Restart=`` says."""

    unit: str
    restart: str


def own_service(cgroups: str) -> str:
    """The systemd service that a process belongs to, by its /proc/PID/cgroup; "" if none."""
    return _service_and_user(cgroups)[0]


def restarted_service(pid: int) -> Service | None:
    """The service that ends with a process or one below it, if systemd starts it again, in whatever cases.

    None where that is not known, too; and where its main process is none of these: a job of cron, the shell of an editor.
    """
    try:
        cgroups = Path(f"/proc/{pid}/cgroup").read_text(encoding="utf-8", errors="surrogateescape")
    except OSError:
        return None
    unit, user = _service_and_user(cgroups)
    systemctl = shutil.which("systemctl")
    if not unit or systemctl is None or user not in ("", str(os.geteuid())):
        return None
    asked = [systemctl, *(["--user"] if user else []), "show", "--property=Restart,MainPID", "--", unit]
    try:
        found = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=ASK_S, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return None
    said = dict(line.split("=", 1) for line in found.stdout.splitlines() if "=" in line)
    restart, main = said.get("Restart", ""), said.get("MainPID", "")
    if found.returncode or restart in NEVER or not main.isdecimal():
        return None
    from checkpoint.linux.procfs.descendants import ancestors  # here: a witness, which asks only for its own, needs no registers

    return Service(unit, restart) if pid in (int(main), *ancestors(int(main))) else None


def _service_and_user(cgroups: str) -> tuple[str, str]:
    """The innermost service, and the uid of the user whose systemd runs it; "" for the machine's."""
    for line in filter(None, cgroups.split("\n")):  # a group that a user named may hold other processes
        controllers, path = line.split(":", 2)[1:]
        if controllers in ("", "name=systemd"):
            units = [part for part in path.split("/") if part.endswith(".service")]
            if units:  # else systemd does not use this hierarchy, or the process is in none of its services
                owner = units[-2] if len(units) > 1 else ""
                return units[-1], owner.removeprefix("user@").removesuffix(".service") if owner.startswith("user@") else ""
    return "", ""
