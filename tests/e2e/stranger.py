"""A stranger on the robots' network, outside the team: listens, replays what it heard, invents, tries to connect.

Each act is a process of its own inside the network of a robot.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

from failover.cli.demo.robots import RobotMachine
from failover.config import team
from failover.config.team import split_address
from tests.e2e.robots import PATIENCE_S, has_cable

RECORD = """
import socket, struct, sys
ETH_P_IP = 0x0800
port, count = int(sys.argv[1]), int(sys.argv[2])
with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(ETH_P_IP)) as wire:
    while count:
        packet = wire.recv(65535)
        head = (packet[0] & 15) * 4
        if packet[9] == socket.IPPROTO_UDP and struct.unpack_from(">H", packet, head + 2) == (port,):
            print(packet[head + 8 :].hex())
            count -= 1
"""

SEND = """
import socket, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
    for line in sys.stdin:
        link.sendto(bytes.fromhex(line), (sys.argv[1], int(sys.argv[2])))
"""

FLOOD = """
import os, socket, sys, time
host, port, frame, seconds = sys.argv[1], int(sys.argv[2]), bytes.fromhex(sys.argv[3]), float(sys.argv[4])
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
end, sent = time.monotonic() + seconds, 0
children = []
for _ in range(len(os.sched_getaffinity(0)) - 1):
    children.append(os.fork())
    if not children[-1]:
        break
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
    link.connect((host, port))
    while time.monotonic() < end:
        for _ in range(100):
            link.send(frame)
        sent += 100
if 0 not in children:
    for child in children:
        os.waitpid(child, 0)
    print(sent)
"""

KNOCK = """
import asyncio, sys
from agent.worker.network.replication_link import Callbacks, Keys, LinkState, ReplicationLink, new_keys
from failover.core.wire.messages import Cancel

async def knock(name, address, server_key):
    public, secret = new_keys()
    refused = asyncio.Event()
    said = []
    def changed(peer, state, reason):
        said.append((state, reason))
        if state in (LinkState.REFUSED, LinkState.CONNECTED):
            refused.set()
    keys = Keys(public, secret, {"door": server_key})
    link = ReplicationLink(name, "127.0.0.1:7999", {"door": address}, keys, Callbacks(print, changed))
    link.open()
    await asyncio.wait_for(refused.wait(), 30)
    link.say("door", Cancel(1))
    await link.close()
    print(*said[-1])

asyncio.run(knock(*sys.argv[1:]))
"""


def _inside(robot: RobotMachine, script: str, *arguments: str, said: str = "") -> str:
    enter = ["nsenter", "--net", f"--target={robot.process.pid}"] if has_cable() and os.geteuid() == 0 else []
    command = [*enter, sys.executable, "-c", script, *arguments]
    return subprocess.run(command, input=said, capture_output=True, text=True, check=True, timeout=PATIENCE_S).stdout


def record(robot: RobotMachine, count: int) -> list[bytes]:
    """The next beats that arrive at the robot. Needs root."""
    _, port = _beat_address(robot)
    return [bytes.fromhex(line) for line in _inside(robot, RECORD, str(port), str(count)).split()]


def send(robot: RobotMachine, frames: Sequence[bytes]) -> None:
    """Send datagrams to where the robot hears beats."""
    host, port = _beat_address(robot)
    _inside(robot, SEND, host, str(port), said="\n".join(frame.hex() for frame in frames))


def flood(robot: RobotMachine, frame: bytes, seconds: float) -> int:
    """Send one datagram to where the robot hears beats, again and again, from each processor at real-time priority. Needs root.

    Returns:
        how often one of the senders sent it.
    """
    host, port = _beat_address(robot)
    return int(_inside(robot, FLOOD, host, str(port), frame.hex(), str(seconds)))


def knock(robot: RobotMachine, claimed: str) -> str:
    """Connect to the robot's bulk lane under a team member's name, with a key of one's own; what came of it."""
    me = team.read(robot.directory / "team").robots[robot.name]
    return _inside(robot, KNOCK, claimed, me.bulk, me.public_key)


def _beat_address(robot: RobotMachine) -> tuple[str, int]:
    return split_address(team.read(robot.directory / "team").robots[robot.name].beats[0], robot.name)
