"""Network links of this robot: wired or wireless, cable in or out, and which traffic may use them.

Heartbeats use every link. Snapshots are large and are a program's memory: they use wired links alone, unless the operator allows
more (``snapshots_over``). The kernel's facts decide what kind a link is. Where the kernel cannot know, because a radio is behind
an Ethernet port, the operator says so (``wireless``).
"""

from __future__ import annotations

import enum
import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from msgspec import Struct

from agent.system import rtnetlink
from agent.system.rtnetlink import KernelLink
from failover.config.team import Robot, for_lookup, split_address

SYSFS: Final = Path("/sys/class/net")
PROC_WIRELESS: Final = Path("/proc/net/wireless")

ARPHRD_LOOPBACK: Final = 772
RADIO_HARDWARE: Final = frozenset({801, 802, 803, 804, 805, 820, 825})
"""ARPHRD_IEEE80211 and its monitors, 802.15.4, PhoNet over a radio, 6LoWPAN. Source: linux/if_arp.h."""

RADIO_DEVICES: Final = frozenset({"wlan", "wwan", "wimax", "bluetooth", "wpan"})
"""DEVTYPE of a device's uevent."""

TUNNELS: Final = frozenset({"tun", "wireguard", "gre", "gretap", "ipip", "sit", "vxlan", "geneve", "l2tp", "xfrm", "ppp"})
"""Kinds of interfaces whose bytes travel over some other one that may be anything."""

NONE_HARDWARE: Final = frozenset({65534, 512})
"""ARPHRD_NONE (tun, wireguard, mobile modems), ARPHRD_PPP."""

TRANSMITTED: Final = 8
"""Column of a line of /proc/net/dev, from 0 after the name: bytes sent."""

DEPTH_MAX: Final = 8
"""Interfaces that stand on one another."""


class Medium(enum.StrEnum):
    """How a link carries its bytes."""

    WIRED = "wired"
    WIRELESS = "wireless"
    LOOPBACK = "loopback"


class Link(Struct, frozen=True):
    """One interface that this robot uses.

    Attributes:
        carrier: it is up, and something is connected at the other end.
        because: the fact that made it wired or wireless.
    """

    name: str
    medium: Medium
    carrier: bool
    because: str = ""
    index: int = 0


class Device(Struct, frozen=True):
    """An interface that a socket can be held to; one that went and came back under its name has another index."""

    name: str
    index: int


EVERY_DEVICE: Final = Device("", 0)
"""A socket that was held to one is held to none: as SO_BINDTODEVICE, socket(7), takes an empty name."""


class Scene(Struct, frozen=True):
    """The kernel's answer at one instant: interfaces by index, and the index of each address's."""

    links: Mapping[int, KernelLink]
    addresses: Mapping[str, int]

    @classmethod
    def now(cls) -> Scene:
        """Ask the kernel.

        Raises:
            OSError: it does not answer.
        """
        return cls({link.index: link for link in rtnetlink.links()}, rtnetlink.addresses())

    def at(self, host: str) -> KernelLink | None:
        """The interface that has this address; None if none has it."""
        return self.links.get(self.addresses.get(host, 0))


class Facts:
    """The signs that an interface is wireless: the operator's word, then the kernel's."""

    def __init__(self, declared: frozenset[str], sysfs: Path = SYSFS, proc: Path = PROC_WIRELESS) -> None:
        self._declared = declared
        self._sysfs = sysfs
        self._proc = proc

    def link(self, one: KernelLink, scene: Scene) -> Link:
        """The facts that are known of an interface."""
        if one.hardware == ARPHRD_LOOPBACK:
            return Link(one.name, Medium.LOOPBACK, one.carrier, "the loopback", one.index)
        because = self._radio(one, scene, DEPTH_MAX)
        if because:
            return Link(one.name, Medium.WIRELESS, one.carrier, because, one.index)
        kind = f" ({one.kind})" if one.kind else ""
        return Link(one.name, Medium.WIRED, one.carrier, f"the kernel knows no radio in it{kind}", one.index)

    def _radio(self, one: KernelLink, scene: Scene, depth: int) -> str:
        """Why an interface counts as wireless; "" if it does not."""
        if one.name in self._declared:
            return "the configuration says so"
        if one.hardware in RADIO_HARDWARE:
            return f"its hardware type is {one.hardware}"
        if one.name in self._listed():
            return "/proc/net/wireless lists it"
        if because := self._sysfs_radio(one):
            return because
        if one.kind in TUNNELS or one.hardware in NONE_HARDWARE:
            return f"it is a tunnel or a modem ({one.kind or one.hardware}): the medium of its bytes cannot be known"
        for other in scene.links.values():
            stands_on = other.index == one.lower and one.kind != "veth"  # a veth's other end is no lower one
            if depth and (stands_on or other.master == one.index) and (because := self._radio(other, scene, depth - 1)):
                return f"{other.name} is below it: {because}"
        return ""

    def _listed(self) -> frozenset[str]:
        """Interfaces of this network namespace with wireless extensions. Source: proc_pid_net(5)."""
        try:
            lines = self._proc.read_text().splitlines()[2:]
        except OSError:
            return frozenset()
        return frozenset(line.partition(":")[0].strip() for line in lines if ":" in line)

    def _sysfs_radio(self, one: KernelLink) -> str:
        """A radio's sign in /sys, which may be of another network namespace, where the same name means another interface."""
        place = self._sysfs / one.name
        try:
            if int((place / "ifindex").read_text()) != one.index:
                return ""
            uevent = (place / "uevent").read_text()
        except (OSError, ValueError):
            return ""
        for name in ("phy80211", "wireless"):
            if (place / name).exists():
                return f"{place / name} exists"
        devices = [line.partition("=")[2] for line in uevent.splitlines() if line.startswith("DEVTYPE=")]
        return f"its device is of type {devices[0]}" if devices and devices[0] in RADIO_DEVICES else ""


class Links:
    """This robot's own addresses on their links. Refreshed whenever the kernel says that something changed.

    Attributes:
        trouble: why nothing is known of the links; "" if all is well.
    """

    def __init__(self, me: Robot, facts: Facts, *, anywhere: bool) -> None:
        """
        Args:
            anywhere: snapshots may travel over wireless links too.
        """
        hosts = [resolved(split_address(address, "address")[0]) for address in (me.bulk, *me.beats)]
        self._hosts = tuple(dict.fromkeys(hosts))
        self._bulk, *self._beats = hosts
        self._facts = facts
        self._anywhere = anywhere
        self._known: dict[str, Link | None] = {}
        self._scene = Scene({}, {})
        self.trouble = ""

    def refresh(self) -> list[str]:
        """Ask the kernel anew; returns the changes, a sentence each."""
        try:
            self._scene = scene = Scene.now()
        except OSError as error:
            self.trouble = f"the kernel does not tell about this robot's links: {error.strerror}; they count as wired"
            return []
        self.trouble = ""
        before, self._known = self._known, {host: self._found(host, scene) for host in self._hosts}
        return [sentence for host in self._hosts if (sentence := self._change(host, before.get(host, NEVER)))]

    def at(self, host: str) -> Link | None:
        """The link that has one of this robot's own addresses; None if none has it now, or it is every link's."""
        return self._known.get(host)

    @property
    def bulk(self) -> Link | None:
        """The link of the address at which snapshots are taken."""
        return self.at(self._bulk)

    def device(self, host: str) -> Device | None:
        """The interface by which a connection to that address of a peer must leave; None where it may take any."""
        return None if host in self._scene.addresses else self._pinned()

    def listening(self, peers: Iterable[str]) -> Device | None:
        """The interface by which connections must come; None where they may take any, as from a peer on this machine."""
        return None if any(host in self._scene.addresses for host in peers) else self._pinned()

    def _pinned(self) -> Device | None:
        link = self.bulk
        if link is None or link.medium is Medium.LOOPBACK or not can_pin(link.name):
            return None
        return Device(link.name, link.index)

    def of_beats(self) -> list[Link | None]:
        """The link of each beat address, in their order."""
        return [self.at(host) for host in self._beats]

    def notes(self) -> list[str]:
        """For the status: each fault of this robot's links, a sentence each."""
        missing = [host for host in self._hosts[1:] if self._known.get(host) is None]
        told = [f"no interface of this robot has its beat address {host} now" for host in missing]
        if hindrance := self.hindrance():
            told.append(f"snapshots wait: {hindrance}")
        return [*([self.trouble] if self.trouble else []), *told]

    def hindrance(self) -> str:
        """Why no snapshot may leave or come now; "" if they may. A cable that is out says so more clearly than a timeout."""
        link = self.bulk
        if link is None:
            return "" if self.trouble else f"no interface of this robot has its bulk address {self._bulk}"
        if not link.carrier:
            return f"{link.name}, which carries snapshots, has no carrier: is its cable out?"
        if link.medium is Medium.WIRELESS and not self._anywhere:
            return (
                f"{link.name}, which carries snapshots, is wireless ({link.because}); give this robot a bulk address on a wired "
                'link, or allow it: snapshots_over = "any"'
            )
        return ""

    def shown(self) -> list[dict[str, object]]:
        """For the status: each link once, with the addresses on it."""
        links = {link.name: link for link in self._known.values() if link is not None}
        return [
            {
                "name": link.name,
                "medium": str(link.medium),
                "because": link.because,
                "carrier": link.carrier,
                "addresses": [host for host, on in self._known.items() if on is not None and on.name == link.name],
                "snapshots": link == self.bulk and not self.hindrance(),
                **_traffic(link.name),
            }
            for link in links.values()
        ]

    def _found(self, host: str, scene: Scene) -> Link | None:
        one = scene.at(host)
        return self._facts.link(one, scene) if one is not None else None

    def _change(self, host: str, before: Link | None) -> str:
        """A sentence on an address whose link is another than before; "" if there is no change."""
        link = self._known[host]
        if link == before:
            return ""
        carries = "snapshots, orders and beats" if host == self._bulk else "beats"
        if link is None:
            return f"no interface has {host} any more, which carried {carries}" if before is not NEVER else ""
        if before is NEVER or before is None:
            out = "" if link.carrier else "; it has no carrier: is its cable out?"
            return f"{carries} travel over {link.name}, which is {link.medium}: {link.because}{out}"
        if not link.carrier:
            return f"{link.name} has no carrier any more (is its cable out?): it carried {carries}"
        if not before.carrier:
            return f"{link.name} has its carrier back: it carries {carries}"
        return f"{carries} travel over {link.name} now, which is {link.medium}: {link.because}"


NEVER: Final = Link("", Medium.LOOPBACK, carrier=False)
"""Before the kernel was asked for the first time."""


def can_pin(name: str) -> bool:
    """Whether a connection can be held to an interface: since Linux 5.7 without any right. Source: socket(7), SO_BINDTODEVICE."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as trial:
        try:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, name.encode() + b"\0")
        except OSError:
            return False
    return True


def resolved(host: str) -> str:
    """The address that a host's name stands for, as the kernel would write it; the name itself if it has none now."""
    try:
        return str(socket.getaddrinfo(for_lookup(host), None, type=socket.SOCK_DGRAM)[0][4][0])
    except OSError:
        return host


def _traffic(name: str) -> dict[str, int | None]:
    """The kernel's counters of an interface. Source: proc_pid_net(5), /proc/net/dev, of our own network namespace."""
    try:
        lines = Path("/proc/net/dev").read_text().splitlines()
    except OSError:
        lines = []
    numbers = next((line.partition(":")[2].split() for line in lines if line.partition(":")[0].strip() == name), [])
    known = len(numbers) > TRANSMITTED
    return {"bytes_in": int(numbers[0]) if known else None, "bytes_out": int(numbers[TRANSMITTED]) if known else None}
