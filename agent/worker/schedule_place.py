"""The place of the schedule of a robot without a board: a directory beside the control socket.

The first task makes the schedule in it (`failover.boards.directory`), so that an agent whose robot has no tasks loads nothing
for them. Those who may use the control socket may use it, too.
"""

from __future__ import annotations

import grp
import os
from pathlib import Path
from typing import Final

from agent.errors import AgentError
from failover.boards import SCHEDULE_NAME, SCHEDULE_PLACE

OWNER_MODE: Final = 0o700
GROUP_MODE: Final = 0o2770
"""What is made in the directory belongs to its group."""
BOOT_ID: Final = slice(40, 56)
"""Of the file. Source: failover/core/schedule/SCHEDULE.md."""


def provide(runtime: Path, group: str) -> None:
    """Have the directory. A schedule of an earlier boot goes: its instants are of another clock.

    Args:
        runtime: the agent's runtime directory.
        group: whose members share the schedule with this user; "": none do.

    Raises:
        AgentError: this system has no such group.
        OSError: the directory cannot be made.
    """
    place = runtime / SCHEDULE_PLACE
    place.mkdir(mode=OWNER_MODE, exist_ok=True)
    if group:
        try:
            os.chown(place, -1, grp.getgrnam(group).gr_gid)
        except KeyError as error:
            raise AgentError(f"group = {group!r}: this system has no such group; make it, or leave it empty") from error
    place.chmod(GROUP_MODE if group else OWNER_MODE)
    _forget_earlier_boot(place / SCHEDULE_NAME)


def _forget_earlier_boot(path: Path) -> None:
    boot_id = bytes.fromhex(Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", ""))
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return
    try:
        head = os.read(descriptor, BOOT_ID.stop)
    finally:
        os.close(descriptor)
    if head[BOOT_ID] != boot_id:
        path.unlink()
