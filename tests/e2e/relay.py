"""Three drivers in a row, who asks them, and clocks of robots that are apart: ``python relay.py STAGE DIRECTORIES ROLE``.

Each robot is a machine of its own here, so its clock is another one, too: `set_clock` shifts that of the process, and lets it not
know. A process in a time namespace usually knows (`failover.boards.boottime`), and counts by the clock of its machine.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
from pathlib import Path
from typing import Final

CLONE_NEWTIME: Final = 0x80
SHIFTS_S: Final = {"robot1": 5 * 3600, "robot2": -5}
"""What each robot's clock is ahead of the one that the test knows: hours, as of robots that were not booted together."""

PATHS: Final = ("Lab/robot1/First", "Lab/robot2/Second", "Lab/robot1/Third")
ROLES: Final = {"first": "robot1", "second": "robot2", "third": "robot1", "ask": "robot1"}


def set_clock(shift_s: int) -> None:
    """Live in a time namespace with this offset. One for children, without an offset, is what the process is told of.

    Source: time_namespaces(7): /proc/PID/timens_offsets is about ``time_for_children``.
    """
    libc = ctypes.CDLL(None, use_errno=True)

    def made(offset_s: int) -> None:
        if libc.unshare(CLONE_NEWTIME):
            raise OSError(ctypes.get_errno(), "unshare")
        Path("/proc/self/timens_offsets").write_text(f"monotonic {offset_s} 0\nboottime {offset_s} 0\n")

    made(shift_s)
    namespace = os.open("/proc/self/ns/time_for_children", os.O_RDONLY)
    if libc.setns(namespace, CLONE_NEWTIME):
        raise OSError(ctypes.get_errno(), "setns")
    os.close(namespace)
    made(0)


def drive(role: str) -> None:
    """Be one of the drivers; all but the last ask the next one."""
    import failover

    place = [*ROLES].index(role)
    following: list[failover.Proxy] = []

    @failover.driver(PATHS[place])
    class Relay:
        asked: int = failover.kept(default=0)

        @failover.query
        def ask(self, depth: int) -> int:
            self.asked += 1
            if depth == 0:
                return 0
            if not following:
                following.append(failover.proxy(PATHS[place + 1]))
            return 1 + int(following[0].call("ask", depth=depth - 1, timeout=60))

    failover.run(Relay)


def ask() -> None:
    """Send a message over all three; say its id, what ``failover path`` tells of it, and the stamps that the drivers have."""
    import contextlib
    import io

    import failover
    from failover.cli import main
    from failover.drivers.here import here
    from failover.drivers.lookup import lookup
    from failover.drivers.proxy import Proxy

    with failover.proxy(PATHS[0]) as first:
        for _ in range(2):  # the second one finds all connections open
            assert first.call("ask", depth=2, timeout=60) == 2
        assert first.last is not None
        name, began = first.last.re, first.last.hops[0]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        status = main.main(["path", name, "--json"])
    assert status == 0
    with Proxy(here(), lookup(here(), PATHS[2])) as third:
        (hops,) = third.call("_ways", {"began": [began.who, began.came]})
    print(json.dumps({"told": json.loads(said.getvalue()), "hops": hops}), flush=True)


def main(stage: str, directories: str, role: str) -> None:
    """As a driver, or as who asks."""
    robot = ROLES[role]
    set_clock(SHIFTS_S[robot])  # before anything begins a thread
    from tests.e2e.messengers import be_on

    be_on(Path(stage), Path(directories), robot)
    if role == "ask":
        ask()
    else:
        drive(role)


if __name__ == "__main__":
    main(*sys.argv[1:])
