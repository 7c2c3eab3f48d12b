"""Robots that are emulated machines: in one team with a robot of this machine, or with one another."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from checkpoint.arch import TRY_UNPROVED
from failover.cli.demo import robots as demo
from failover.cli.demo.robots import ADDRESS, NAMES, Pace, RobotMachine, Stage
from tests.e2e import robots
from tests.machines.emulated import Machine

THERE: Final = Path("/root/robot")
"""Where a robot's things lie in its machine."""
ENVIRONMENT: Final = f"PYTHONPATH=/opt/site:/root/failover {TRY_UNPROVED}=1"
ALONE: Final = "unshare --pid --fork --kill-child --mount-proc"
"""So that nothing of a robot outlives it."""
BEAT_MS: Final = 200
LEASE_MS: Final = 4000
"""A beat takes its time where every instruction is twenty."""
TAP: Final = "fo-{}"


def address_of_card(name: str) -> str:
    """Of the network card at the end of a robot's wire."""
    return f"52:54:00:71:07:{NAMES.index(name) + 1:02x}"


def tap_of(name: str) -> str:
    """The end of a robot's wire that is here, before it is given to the other robot."""
    return TAP.format(os.getpid()) + f"-{NAMES.index(name)}"


def to_this_machine(name: str) -> tuple[str, ...]:
    """A wire whose other end is a network interface here; see `Machine.booted`."""
    return _card(name, f"tap,id=wire,ifname={tap_of(name)},script=no,downscript=no")


def to_one_another(port: int) -> Mapping[str, tuple[str, ...]]:
    """A wire between two emulated machines, of which the first must be there before the second; by a port of loopback."""
    ways = ("listen", "connect")
    return {name: _card(name, f"socket,id=wire,{way}=127.0.0.1:{port}") for name, way in zip(NAMES, ways, strict=True)}


def _card(name: str, backend: str) -> tuple[str, ...]:
    return ("-netdev", backend, "-device", f"virtio-net-pci,netdev=wire,mac={address_of_card(name)},romfile=")


class Guest(RobotMachine):
    """A robot that is an emulated machine. Its agent's socket has an end here, by ssh, whose process is ``process``."""

    machine: Machine

    @property
    def start_s(self) -> float:
        """Every instruction of its agent's start is twenty here, and two machines may start at a time."""
        return 600.0

    def switch_on(self) -> None:
        """It runs already."""

    def cut_power(self) -> int:
        """End the machine, from one instant to the next."""
        assert self.machine.emulator is not None
        self.machine.emulator.kill()
        self.machine.emulator.wait()
        self.end()
        return 1

    def end(self) -> None:
        """End its agent, if the machine still runs, and our connection to it."""
        assert self.machine.emulator is not None
        if self.machine.emulator.poll() is None:
            self.machine.run(f"kill -KILL $(cat {THERE}/pid); rm -rf {THERE}", timeout_s=60)
        self.process.kill()
        self.process.wait()


class MixedStage(Stage):
    """Two robots of which one or both are emulated machines that run already."""

    def __init__(self, directory: Path, guests: Mapping[str, Machine]) -> None:
        # one end of a wire is a tunnel here, of which an agent cannot know what carries it
        super().__init__(directory, robots.means(), 'snapshots_over = "any"\n', pace=Pace(BEAT_MS, LEASE_MS))
        self._guests = guests

    def start_robot(self, name: str) -> RobotMachine:
        """As for others; a machine is sent its keys and configuration, and its agent answers on a socket here too."""
        if name not in self._guests:
            return super().start_robot(name)
        machine, directory = self._guests[name], self.directory / name
        (directory / "run").mkdir()
        (directory / "agent.toml").write_text(self.configuration(name, THERE))
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w") as archive:
            for part in ("team", "agent.toml"):
                archive.add(directory / part, part)
        told(machine, f"mkdir -p {THERE}/state {THERE}/run && tar -C {THERE} -x --no-same-owner", packed.getvalue())
        agent = f"python3 -m agent.main --config {THERE}/agent.toml"
        command = f"cd /root/failover && echo $$ >{THERE}/pid && exec {ALONE} env {ENVIRONMENT} {agent}"
        ends = f"{directory / 'run' / 'control.sock'}:{THERE / 'run' / 'control.sock'}"
        told(machine, self._wire(name))
        with (directory / "agent.log").open("wb") as log:
            ssh = machine.ssh(command, "-L", ends)
            process = subprocess.Popen(ssh, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        return Guest(name, directory, process, machine)

    def _wire(self, name: str) -> str:
        found = f"$(ip -o link | awk -F': ' '/{address_of_card(name)}/ {{ print $2 }}')"
        return f"ip address add {ADDRESS.format(NAMES.index(name) + 1)}/24 dev {found} && ip link set {found} up"

    def join(self) -> None:
        """Give a robot of this machine the end of the other's wire."""
        for index, robot in enumerate(self.robots):
            if isinstance(robot, Guest):
                continue
            demo.wait_for_network(robot)
            tap = tap_of(NAMES[1 - index])
            demo.run(["ip", "link", "set", tap, "netns", str(robot.process.pid)])
            demo.run(demo.ip_inside(robot, "link", "set", "lo", "up"))
            demo.run(demo.ip_inside(robot, "address", "add", ADDRESS.format(index + 1) + "/24", "dev", tap))
            demo.run(demo.ip_inside(robot, "link", "set", tap, "up"))

    def start(self) -> None:
        """Both, until they hear each other."""
        self.directory.mkdir()
        super().start()
        first, second = self.robots
        robots.until(lambda: robots.connected(first) and robots.connected(second), "the robots to hear each other", 300.0)

    def shown(self) -> str:
        """What both have said, for a test that fails."""
        with contextlib.suppress(OSError):
            return "\n".join(f"--- {one.name}\n{one.log.read_text(errors='replace')[-6000:]}" for one in self.robots)
        return ""


def told(machine: Machine, command: str, content: bytes = b"") -> None:
    """Have a machine obey."""
    done = machine.run(command, content=content)
    assert done.returncode == 0, done.stdout.decode(errors="replace")
