"""The agent on this machine: the name by which its agent.toml knows it, and its service."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Final

from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole
from failover.errors import TeamFileError

SYSTEM_DIRECTORY: Final = Path("/etc/failover/team")
SERVICE: Final = "failover-agent.service"
RUNS_SYSTEMD: Final = Path("/run/systemd/system")
"""Source: sd_booted(3)."""

NOT_STARTED: Final = "next: start failover-agent"
UNIT_PATIENCE_S: Final = 90

_ROBOT: Final = re.compile(r"^#?[ \t]*robot[ \t]*=.*$", re.MULTILINE)


def config_beside(directory: Path) -> Path:
    """The agent's configuration that belongs to a team directory."""
    return directory.absolute().parent / "agent.toml"


def said_name(directory: Path) -> str:
    """The name that agent.toml says; "" where it says none, or cannot be read."""
    with contextlib.suppress(OSError, *UNDECODABLE):
        return str(tomllib.loads(config_beside(directory).read_text()).get("robot", ""))
    return ""


def host_name() -> str:
    """This machine's name, up to its first dot."""
    return os.uname().nodename.partition(".")[0]


def own_name(directory: Path) -> str:
    """This robot's name, as its agent has it."""
    return said_name(directory) or host_name()


def check_name(directory: Path, robot: str) -> None:
    """Raises TeamFileError: agent.toml gives this machine another name."""
    if (said := said_name(directory)) not in ("", robot):
        raise TeamFileError(
            f"{config_beside(directory)} says that this robot is {said}, not {robot}; take that line out, or use {said}"
        )


def name_robot(directory: Path, robot: str) -> None:
    """Have agent.toml say this robot's name, where the machine has another one.

    Raises:
        TeamFileError: it cannot be written.
    """
    path = config_beside(directory)
    if own_name(directory) == robot:
        return
    line = f'robot = "{robot}"'
    text = path.read_text() if path.exists() else ""
    text = _ROBOT.sub(lambda _: line, text, count=1) if _ROBOT.search(text) else f"{line}\n{text}"
    try:
        write_whole(path, text.encode(), mode=0o644, lasts="process")
    except OSError as error:
        raise TeamFileError(f"cannot write {path}: {error.strerror}; it must say {line}") from error


def start(directory: Path) -> str:
    """Enable the service and start it, or start it anew, where systemd runs and the team is the system's; a sentence for people.

    Raises:
        TeamFileError: systemd does not start it.
    """
    if directory.absolute() != SYSTEM_DIRECTORY or not RUNS_SYSTEMD.is_dir():
        return NOT_STARTED
    for words in (["enable"], ["reset-failed"], ["restart"]):
        command = ["systemctl", *words, SERVICE]
        try:
            ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=UNIT_PATIENCE_S)
        except (subprocess.TimeoutExpired, OSError) as error:
            raise TeamFileError(
                f"{' '.join(command)} did not end well: {error}; the team stands; give that command again"
            ) from error
        if ran.returncode and words != ["reset-failed"]:
            said = (ran.stderr.strip() or ran.stdout.strip() or "nothing").splitlines()[-1]
            raise TeamFileError(f"systemctl {words[0]} {SERVICE} failed: {said}; failover-agent check names a mistake")
    return "its service runs; failover status shows it"
