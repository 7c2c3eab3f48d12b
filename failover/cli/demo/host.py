"""One robot's computer, simulated by a process: it starts the agent, adopts every orphan, and all of its processes die with it.

Run as ``python -m failover.cli.demo.host [--pids] -- COMMAND…``. With ``--pids`` the robot has a PID namespace and a /proc of its
own, so that it sees no process of another robot, and the kernel ends all of it when its first process ends. Without, the
host is a subreaper: a robot's processes are its descendants, even those that fork twice.

The command starts when a byte comes on standard input: by then the robot's network exists. End of file there means that the
process that started the host has ended.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NoReturn

from checkpoint.linux.spawn import namespaces

PR_SET_CHILD_SUBREAPER: Final = 36  # linux/prctl.h

REFUSED: Final = 71
"""Exit status when a PID namespace was asked for and cannot be had (EX_OSERR)."""


def main(argv: Sequence[str]) -> int:
    """Be the robot's computer until its agent and everything that it left have ended."""
    own_pids = argv[:1] == ["--pids"]
    command = list(argv[argv.index("--") + 1 :])
    namespaces.prctl(namespaces.PR_SET_PDEATHSIG, signal.SIGTERM)
    if not own_pids:
        namespaces.prctl(PR_SET_CHILD_SUBREAPER, 1)
        return _host(command)
    entered = namespaces.enter(pids=True, clocks=False)
    if not entered.pids:
        print("; ".join(entered.notes), file=sys.stderr)
        return REFUSED
    init = os.fork()
    if init == 0:
        _be_init(command)
    signal.signal(signal.SIGTERM, lambda *_: os.kill(init, signal.SIGKILL))
    _, status = os.waitpid(init, 0)
    return os.waitstatus_to_exitcode(status) & 0xFF


def _be_init(command: list[str]) -> NoReturn:
    """PID 1: when it ends, the kernel ends everything in its namespace."""
    status = REFUSED
    try:
        namespaces.prctl(namespaces.PR_SET_PDEATHSIG, signal.SIGKILL)
        namespaces.mount_proc()
        status = _host(command)
    finally:
        os._exit(status)


def _host(command: list[str]) -> int:
    """Wait for the word, start the agent, and reap each process that ends, until none is left."""
    if not os.read(0, 1):
        return REFUSED
    agent = os.fork()
    if agent == 0:
        os.dup2(os.open(os.devnull, os.O_RDWR), 0)
        with contextlib.suppress(OSError):
            os.execv(command[0], command)
        os._exit(127)
    signal.signal(signal.SIGTERM, lambda *_: _end_descendants())
    agent_status = 0
    while True:
        try:
            pid, status = os.wait()
        except ChildProcessError:
            return os.waitstatus_to_exitcode(agent_status) & 0xFF
        if pid == agent:
            agent_status = status


def _end_descendants() -> None:
    for pid in descendants(os.getpid()):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def descendants(root: int) -> list[int]:
    """Every living process below ``root``, parents first."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):
                state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
                if state != "Z":
                    children.setdefault(int(parent), []).append(int(entry.name))
    found: list[int] = []
    ahead = [root]
    while ahead:
        below = children.get(ahead.pop(), [])
        found += below
        ahead += below
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
