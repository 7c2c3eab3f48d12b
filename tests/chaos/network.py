"""The network of the test team: bridges as switches, one cable for each link of a member, and every way in which it fails.

The test team is a network namespace of its own; each member has another, and a veth pair leads from there to a port of a switch.
A cut from one member to another is a filter at the receiver's port that drops frames by their sender's hardware address: the
other direction passes. tc(8) with a classic BPF program does it on any kernel; netfilter and netem need not be there.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

DROP: Final = 2
PASS: Final = 0xFFFFFFFF
"""TC_ACT_SHOT and TC_ACT_UNSPEC. Source: linux/pkt_cls.h."""

SENDER_TAIL: Final = 8
"""Offset in a frame of the last four bytes of the sender's hardware address."""

FIRST_NETWORK: Final = 72
"""10.72.0.0/24 is link 0, 10.73.0.0/24 link 1."""

QUEUE_SIZE: Final = 20_000
BURST_SIZE: Final = 4_000
"""Bytes that wait before, and pass at once through, a link that is saturated."""

Way = tuple[int, int, int]
"""Sender, receiver, link: all that goes this way is lost."""


@dataclass(slots=True)
class Network:
    """Which ports there are and what is cut. Members and links are numbers.

    Attributes:
        down: (member, link) whose cable is out.
        ways: that are cut.
    """

    links: int
    ports: dict[tuple[int, int], int] = field(default_factory=dict)
    down: set[tuple[int, int]] = field(default_factory=set)
    ways: set[Way] = field(default_factory=set)

    def build(self) -> None:
        """Put the switches up."""
        _ip(*(f"link add switch{link} type bridge" for link in range(self.links)), "link set lo up")
        _ip(*(f"link set switch{link} up" for link in range(self.links)))

    def plug(self, member: int, link: int, pid: int) -> None:
        """Lay a cable from a switch into the network namespace of a process."""
        port, card = port_of(member, link), card_of(link)
        _ip(
            f"link add {port} type veth peer name {card} address {hardware_of(member, link)} netns {pid}",
            f"link set {port} master switch{link} up",
        )
        _tc(f"qdisc add dev {port} clsact")
        inside = ["nsenter", "--net", f"--target={pid}"]
        address = f"address add {address_of(member, link)}/24 dev {card}"
        _ip("link set lo up", address, f"link set {card} up", inside=inside)
        self.ports[member, link] = pid
        self._filter([(member, link)])
        self._lift([(member, link)])

    def unplug(self, member: int) -> None:
        """Its network namespace is about to go, and what its dying sockets still say must not be heard."""
        for link in range(self.links):
            if self.ports.pop((member, link), None) is not None:
                _ip(f"link delete {port_of(member, link)}")

    def cut(self, ways: Iterable[Way]) -> None:
        """Lose everything that goes these ways."""
        self._change(self.ways | set(ways))

    def mend(self, ways: Iterable[Way]) -> None:
        """Let it pass again."""
        self._change(self.ways - set(ways))

    def pull(self, plugs: Sequence[tuple[int, int]]) -> None:
        """Pull cables (member, link) out at the switch: no carrier at either end."""
        self.down |= set(plugs)
        self._lift(plugs)

    def push(self, plugs: Sequence[tuple[int, int]]) -> None:
        """Plug them in again."""
        self.down -= set(plugs)
        self._lift(plugs)

    def saturate(self, member: int, link: int, kbit_s: int) -> None:
        """Let so little pass in either direction."""
        for inside, device in self._ends(member, link):
            limits = f"rate {kbit_s}kbit burst {BURST_SIZE} limit {QUEUE_SIZE}"
            _tc(f"qdisc add dev {device} root tbf {limits}", inside=inside)

    def relieve(self, member: int, link: int) -> None:
        """Let everything pass again, if it is still the same cable."""
        for inside, device in self._ends(member, link):
            _run([*inside, "tc", "qdisc", "delete", "dev", device, "root"], "", check=False)

    def _ends(self, member: int, link: int) -> list[tuple[list[str], str]]:
        pid = self.ports.get((member, link))
        if pid is None:
            return []
        return [([], port_of(member, link)), (["nsenter", "--net", f"--target={pid}"], card_of(link))]

    def _change(self, ways: set[Way]) -> None:
        changed = {(receiver, link) for _, receiver, link in self.ways ^ ways}
        self.ways = ways
        self._filter(sorted(changed))

    def _filter(self, ports: Iterable[tuple[int, int]]) -> None:
        commands = []
        for member, link in ports:
            if (member, link) not in self.ports:
                continue
            device = port_of(member, link)
            commands.append(f"filter delete dev {device} egress")
            senders = sorted(sender for sender, receiver, over in self.ways if (receiver, over) == (member, link))
            commands += [f"filter add dev {device} egress protocol all {_drop(sender, link)}" for sender in senders]
        if commands:
            _tc(*commands)

    def _lift(self, ports: Iterable[tuple[int, int]]) -> None:
        ports = [port for port in ports if port in self.ports]
        if ports:
            _ip(*(f"link set {port_of(*port)} {'down' if port in self.down else 'up'}" for port in ports))


def address_of(member: int, link: int) -> str:
    """Of a member, on a link."""
    return f"10.{FIRST_NETWORK + link}.0.{member + 1}"


def hardware_of(member: int, link: int) -> str:
    """Of its card."""
    return f"02:00:00:00:{link:02x}:{member + 1:02x}"


def port_of(member: int, link: int) -> str:
    """The switch's end of the cable."""
    return f"port{member}-{link}"


def card_of(link: int) -> str:
    """The member's end of the cable."""
    return f"wire{link}"


def _drop(sender: int, link: int) -> str:
    """A filter that loses what this sender says. Four instructions: load, compare, lose, pass."""
    tail = int(hardware_of(sender, link).replace(":", "")[-8:], 16)
    program = f"4,32 0 0 {SENDER_TAIL},21 0 1 {tail},6 0 0 {DROP},6 0 0 {PASS}"
    return f'prio {sender + 1} bpf direct-action bytecode "{program}"'


def _ip(*commands: str, inside: Sequence[str] = ()) -> None:
    _run([*inside, "ip", "-batch", "-"], "\n".join(commands))


def _tc(*commands: str, inside: Sequence[str] = ()) -> None:
    _run([*inside, "tc", "-batch", "-"], "\n".join(commands))


def _run(command: Sequence[str], batch: str, *, check: bool = True) -> None:
    ran = subprocess.run(command, input=batch + "\n", capture_output=True, text=True, check=False)
    if ran.returncode and check:
        raise RuntimeError(f"{' '.join(command)}: {ran.stderr.strip() or ran.returncode}; it was told\n{batch}")
