"""The agent as a service of a booted machine: installed as the guide says, and asked as a client asks."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from failover.client.control import Control, Output, Result
from tests.e2e import machines, robots
from tests.e2e.machines import CHECKOUT, Machine

SERVICE: Final = "failover-agent.service"
COUNT: Final = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
POLITE: Final = "import signal, sys\nsignal.signal(signal.SIGTERM, lambda *_: sys.exit(0))\n" + COUNT
"""The same, and it exits with status 0 when it is told to end."""


def install(machine: Machine) -> None:
    """What the guide tells a person to type, line by line; the checkout is set up already."""
    commands = (CHECKOUT / "docs" / "guide.md").read_text().split("```\n")[3]
    lines = [line for line in commands.splitlines() if line not in ("./run setup", ".venv/bin/failover check")]
    typed = "\n".join(lines).replace("$PWD/.venv", sys.prefix)
    machine.run("sh", "-ec", f"cd {CHECKOUT}\n{typed}")


def make_team(machine: Machine, **addresses: str) -> None:
    """Begin a team there, with a key for each robot."""
    machine.run("failover", "team", "create", "lab", "--empty")
    for robot, address in addresses.items():
        machine.run("failover", "team", "enrol", robot, address)


@contextmanager
def robot_with_users(directory: Path, **uids: int) -> Iterator[Machine]:
    """A booted robot, alone in its team, with users who are members of the agent's group. The service is not started yet.

    Args:
        directory: for its root and its boot log.
        uids: each user's number, by name.
    """
    with machines.booted(directory, "robot1") as machine:
        install(machine)
        make_team(machine, robot1="127.0.0.1")
        accounts = "".join(f"u {name} {uid} - /tmp\nm {name} failover\n" for name, uid in uids.items())
        (machine.root / "etc/users.conf").write_text(accounts)
        machine.run("systemd-sysusers", "/etc/users.conf")
        machine.run("sed", "-i", 's/^#group = .*/group = "failover"/', "/etc/failover/agent.toml")
        yield machine
        print(machine.run("journalctl", "--unit", SERVICE, "--no-pager", "--lines=100", check=False).stdout)


ADDRESSES: Final = {"robot1": "10.9.0.1", "robot2": "10.9.0.2"}


@contextmanager
def two_robots(
    directory: Path, install: Callable[[Machine], None], base: Path | None = None
) -> Iterator[tuple[Machine, Machine]]:
    """Two booted robots of one team, joined by a cable; they hear each other.

    Args:
        directory: for their roots and their boot logs.
        install: brings failover to a machine.
        base: their system, as `machines.booted` takes it.
    """
    with ExitStack() as stack:
        first, second = (stack.enter_context(machines.booted(directory, name, base)) for name in ADDRESSES)
        lay_cable(first, second)
        for machine in (first, second):
            install(machine)
        first.run("failover", "team", "create", "lab")
        join(first, second)
        robots.until(lambda: connected(first) and connected(second), "the robots to hear each other")
        yield first, second


def join(first: Machine, second: Machine) -> None:
    """Bring a machine into the other one's team, as the guide says."""
    command = [*first.inside(), "failover", "team", "invite", second.name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as invites:
        try:
            assert invites.stdout is not None
            second.run("failover", "team", "join", invites.stdout.readline().strip())
            _, said = invites.communicate(timeout=robots.PATIENCE_S)
            assert invites.returncode == 0, said
        finally:
            invites.kill()


def lay_cable(first: Machine, second: Machine) -> None:
    """Join two machines by a cable; each gets one of `ADDRESSES`, in their order."""
    ends = [["netns", str(machine.pid)] for machine in (first, second)]
    command = ["ip", "link", "add", "wire", *ends[0], "type", "veth", "peer", "name", "wire", *ends[1]]
    subprocess.run(command, check=True)
    for machine, address in zip((first, second), ADDRESSES.values(), strict=True):
        machine.run("ip", "address", "add", f"{address}/24", "dev", "wire")
        machine.run("ip", "link", "set", "wire", "up")


def connected(machine: Machine) -> bool:
    """Whether it hears its peer, and could send it a snapshot."""
    (peer,) = status(machine)["peers"]
    return bool(peer["state"] == "live" and peer["hears_us"] and peer["lane"] == "connected")


def as_user(machine: Machine, user: str, *command: str) -> tuple[int, str]:
    """Run a user's command there; its exit status, and all that it said.

    Args:
        user: a name, with the groups of its account; or a number, without any.
    """
    groups = "--clear-groups" if user.isdecimal() else "--init-groups"
    become = [] if user == "root" else ["setpriv", f"--reuid={user}", f"--regid={user}", groups]
    ran = machine.run(*become, *command, check=False)
    return ran.returncode, ran.stdout + ran.stderr


def control(machine: Machine) -> Control:
    return Control.open(machine.root / "run" / "failover" / "control.sock")


def status(machine: Machine) -> dict[str, Any]:
    with control(machine) as link:
        return link.ask("status")


def component(machine: Machine, name: str) -> dict[str, Any]:
    """As ``failover status`` shows it; empty where it is unknown, or nobody answers."""
    try:
        return next((one for one in status(machine)["components"] if one["name"].endswith("/" + name)), {})
    except robots.NO_ANSWER:
        return {}


def started(machine: Machine, name: str, script: str = COUNT, user: str = "") -> int:
    """A counting component, somebody's; the PID of its program, there."""
    with control(machine) as link:
        argv = ["/usr/bin/python3", "-S", "-c", script]
        return int(link.ask("run", argv=argv, name=name, env={"PATH": "/usr/bin"}, cwd="/", wait=False, user=user)["pid"])


def counted(machine: Machine, name: str) -> list[int]:
    collected = bytearray()
    with control(machine) as link:
        for reply in link.stream("logs", name=name):
            if isinstance(reply, Output) and reply.stream == 1:
                assert reply.offset == len(collected)
                collected += reply.content
            elif isinstance(reply, Result):
                break
    return [int(line) for line in collected.split()]
