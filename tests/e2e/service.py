"""The agent as a service of a booted machine: installed as the README says, and asked as a client asks."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

from failover.client.control import Control, Output, Result
from tests.e2e import robots
from tests.e2e.machines import CHECKOUT, Machine

SERVICE: Final = "failover-agent.service"
COUNT: Final = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"


def install(machine: Machine) -> None:
    """What a package would do; see the README."""
    units, binaries = CHECKOUT / "systemd", Path(sys.prefix) / "bin"
    for name in ("failover", "failover-agent"):
        machine.run("ln", "-s", str(binaries / name), f"/usr/bin/{name}")
    machine.run("install", "-m644", "-t", "/etc/systemd/system", str(units / SERVICE), str(units / "failover.slice"))
    machine.run("install", "-Dm644", str(units / "failover.sysusers"), "/usr/lib/sysusers.d/failover.conf")
    machine.run("install", "-Dm644", str(units / "failover.tmpfiles"), "/usr/lib/tmpfiles.d/failover.conf")
    machine.run("systemd-sysusers")
    machine.run("systemd-tmpfiles", "--create", "/usr/lib/tmpfiles.d/failover.conf")
    machine.run("install", "-m644", str(units / "agent.toml"), "/etc/failover/agent.toml")
    machine.run("sed", "-i", f's/^robot = .*/robot = "{machine.name}"/', "/etc/failover/agent.toml")
    machine.run("systemctl", "daemon-reload")


def make_team(machine: Machine, **addresses: str) -> None:
    """Begin a team there, with a key for each robot."""
    machine.run("failover", "team", "create", "lab")
    for robot, address in addresses.items():
        machine.run("failover", "team", "enrol", robot, address)


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


def started(machine: Machine, name: str) -> int:
    """A counting component; the PID of its program, there."""
    with control(machine) as link:
        argv = ["/usr/bin/python3", "-S", "-c", COUNT]
        return int(link.ask("run", argv=argv, name=name, env={"PATH": "/usr/bin"}, cwd="/", wait=False)["pid"])


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
