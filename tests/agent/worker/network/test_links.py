"""Wired or wireless links, by the kernel's own facts; and the messages when a cable is pulled."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from agent.system.rtnetlink import KernelLink
from agent.worker.network.links import Facts, Link, Links, Medium, Scene
from failover.config.team import Robot

ETHERNET, NO_HARDWARE, LOOPBACK, MONITOR = 1, 65534, 772, 803


def scene(*links: KernelLink) -> Scene:
    return Scene({link.index: link for link in links}, {f"10.0.0.{link.index}": link.index for link in links})


def interface(index: int, name: str, *, hardware: int = ETHERNET, kind: str = "", lower: int = 0, master: int = 0) -> KernelLink:
    return KernelLink(index, name, hardware, kind, lower, master, carrier=True)


class Sysfs:
    """A /sys/class/net as the kernel lays it out."""

    def __init__(self, directory: Path) -> None:
        self.sys, self.proc = directory / "net", directory / "wireless"
        self.sys.mkdir()

    def add(self, name: str, index: int, uevent: str = "", inside: Sequence[str] = ()) -> None:
        for part in ("", *inside):
            (self.sys / name / part).mkdir(parents=True, exist_ok=True)
        (self.sys / name / "ifindex").write_text(f"{index}\n")
        (self.sys / name / "uevent").write_text(f"{uevent}INTERFACE={name}\n")

    def medium(self, one: KernelLink, *others: KernelLink, declared: str = "") -> Link:
        return Facts(frozenset(declared.split()), self.sys, self.proc).link(one, scene(one, *others))


@pytest.fixture
def sysfs(tmp_path: Path) -> Sysfs:
    return Sysfs(tmp_path)


@pytest.mark.parametrize("inside", ["wireless", "phy80211"])
def test_a_card_with_a_radio_is_wireless(sysfs: Sysfs, inside: str) -> None:
    sysfs.add("wlp3s0", 3, inside=[inside])
    link = sysfs.medium(interface(3, "wlp3s0"))
    assert link.medium is Medium.WIRELESS and inside in link.because


@pytest.mark.parametrize("kind", ["wlan", "wwan", "bluetooth"])
def test_a_device_that_says_what_it_is_is_believed(sysfs: Sysfs, kind: str) -> None:
    sysfs.add("x0", 3, uevent=f"DEVTYPE={kind}\n")
    assert sysfs.medium(interface(3, "x0")).medium is Medium.WIRELESS


def test_an_ethernet_card_a_veth_and_a_bridge_of_them_are_wired(sysfs: Sysfs) -> None:
    sysfs.add("eth0", 2, uevent="DEVTYPE=gadget\n")
    card, veth = interface(2, "eth0", master=5), interface(3, "v0", kind="veth", lower=9, master=5)
    bridge = interface(5, "br0", kind="bridge")
    for one in (card, veth, bridge):
        assert sysfs.medium(one, *(other for other in (card, veth, bridge) if other is not one)).medium is Medium.WIRED


def test_what_stands_on_a_radio_is_wireless(sysfs: Sysfs) -> None:
    sysfs.add("wlan0", 3, inside=["phy80211"])
    card, bridged = interface(3, "wlan0"), interface(3, "wlan0", master=5)
    for above in (interface(6, "wlan0.7", kind="vlan", lower=3), interface(6, "mv0", kind="macvlan", lower=3)):
        assert sysfs.medium(above, card).medium is Medium.WIRELESS
    for above in (interface(5, "br0", kind="bridge"), interface(5, "bond0", kind="bond")):
        link = sysfs.medium(above, bridged)
        assert link.medium is Medium.WIRELESS and "wlan0 is below it" in link.because


def test_a_veth_whose_other_end_has_a_radios_number_in_another_namespace_is_wired(sysfs: Sysfs) -> None:
    sysfs.add("wlan0", 3, inside=["phy80211"])
    assert sysfs.medium(interface(7, "v0", kind="veth", lower=3), interface(3, "wlan0")).medium is Medium.WIRED


def test_tunnels_and_modems_count_as_wireless_for_nobody_knows_what_carries_them(sysfs: Sysfs) -> None:
    tunnels = (
        interface(3, "wg0", kind="wireguard"),
        interface(4, "tun0", hardware=NO_HARDWARE),
        interface(5, "vx0", kind="vxlan"),
    )
    for one in tunnels:
        assert sysfs.medium(one).medium is Medium.WIRELESS, one


def test_a_monitor_interface_is_wireless_and_the_loopback_neither(sysfs: Sysfs) -> None:
    assert sysfs.medium(interface(3, "mon0", hardware=MONITOR)).medium is Medium.WIRELESS
    assert sysfs.medium(interface(1, "lo", hardware=LOOPBACK)).medium is Medium.LOOPBACK


def test_what_has_wireless_extensions_is_wireless(sysfs: Sysfs) -> None:
    sysfs.proc.write_text("Inter-| sta-|\n face | tus |\n  ra0: 0000 54. -56. -256\n")
    assert sysfs.medium(interface(3, "ra0")).medium is Medium.WIRELESS
    assert sysfs.medium(interface(4, "eth0")).medium is Medium.WIRED


def test_a_sysfs_of_another_network_namespace_is_not_believed(sysfs: Sysfs) -> None:
    sysfs.add("eth0", 44, inside=["phy80211"])
    assert sysfs.medium(interface(3, "eth0")).medium is Medium.WIRED


def test_the_operators_word_counts_where_the_kernel_cannot_know(sysfs: Sysfs) -> None:
    link = sysfs.medium(interface(3, "eth1"), declared="eth0 eth1")
    assert (link.medium, link.because) == (Medium.WIRELESS, "the configuration says so")


# What the robot makes of it


def at(monkeypatch: pytest.MonkeyPatch, *links: KernelLink) -> None:
    monkeypatch.setattr(Scene, "now", lambda: scene(*links))


def ours(sysfs: Sysfs, *, anywhere: bool = False, declared: str = "") -> Links:
    facts = Facts(frozenset(declared.split()), sysfs.sys, sysfs.proc)
    return Links(Robot(("10.0.0.2:1", "10.0.0.3:1"), "10.0.0.2:2"), facts, anywhere=anywhere)


def test_a_pulled_cable_is_said_once_and_again_when_it_is_back(sysfs: Sysfs, monkeypatch: pytest.MonkeyPatch) -> None:
    links = ours(sysfs)
    wire, air = interface(2, "eth0"), interface(3, "wlan0")
    at(monkeypatch, wire, air)
    assert [sentence.split(":")[0] for sentence in links.refresh()] == [
        "snapshots, orders and beats travel over eth0, which is wired",
        "beats travel over wlan0, which is wired",
    ]
    assert links.hindrance() == ""
    at(monkeypatch, KernelLink(2, "eth0", ETHERNET, carrier=False), air)
    assert links.refresh() == ["eth0 has no carrier any more (is its cable out?): it carried snapshots, orders and beats"]
    assert links.refresh() == []
    assert links.hindrance() == "eth0, which carries snapshots, has no carrier: is its cable out?"
    at(monkeypatch, wire, air)
    assert links.refresh() == ["eth0 has its carrier back: it carries snapshots, orders and beats"]
    at(monkeypatch, air)
    assert links.refresh() == ["no interface has 10.0.0.2 any more, which carried snapshots, orders and beats"]
    assert "no interface of this robot has its bulk address 10.0.0.2" in links.hindrance()
    assert links.notes() == [f"snapshots wait: {links.hindrance()}"]


@pytest.mark.parametrize(("anywhere", "hindered"), [(False, True), (True, False)])
def test_snapshots_over_a_radio_need_the_operators_word(
    sysfs: Sysfs, monkeypatch: pytest.MonkeyPatch, anywhere: bool, hindered: bool
) -> None:
    at(monkeypatch, interface(2, "eth0"), interface(3, "wlan0"))
    links = ours(sysfs, anywhere=anywhere, declared="eth0")
    links.refresh()
    assert ("is wireless" in links.hindrance()) == hindered


def test_a_kernel_that_does_not_tell_is_said_and_hinders_nothing(sysfs: Sysfs, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> Scene:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Scene, "now", refuse)
    links = ours(sysfs)
    assert links.refresh() == []
    assert links.hindrance() == "" and "does not tell" in links.notes()[0]


IN_A_NAMESPACE = """
import select, subprocess, sys
from agent.system import rtnetlink
from agent.worker.network.links import Facts, Scene

def ip(*words):
    subprocess.run(["ip", *words], check=True)

def shown(name):
    scene = Scene.now()
    link = next(link for link in scene.links.values() if link.name == name)
    found = Facts(frozenset()).link(link, scene)
    return f"{found.name} {found.medium} {'carrier' if found.carrier else 'no carrier'}"

def stirred(listener):
    ready = select.select([listener], [], [], 20)[0]
    rtnetlink.drain(listener)
    return bool(ready)

ip("link", "add", "w0", "type", "veth", "peer", "name", "w1")
ip("address", "add", "10.9.8.7/24", "dev", "w0")
ip("link", "add", "br0", "type", "bridge")
for name in ("w0", "w1"):
    ip("link", "set", name, "up")
ip("link", "set", "w1", "master", "br0")
assert Scene.now().at("10.9.8.7").name == "w0"
print(shown("w0"), shown("br0"), shown("lo"), sep="\\n")
listener = rtnetlink.changes()
ip("link", "set", "w1", "down")
assert stirred(listener)
print(shown("w0"))
ip("address", "del", "10.9.8.7/24", "dev", "w0")
assert stirred(listener) and Scene.now().at("10.9.8.7") is None
"""


@pytest.mark.root
@pytest.mark.command("unshare")
@pytest.mark.command("ip")
def test_the_kernel_tells_of_real_interfaces_and_of_a_cable_that_is_pulled() -> None:
    command = ["unshare", "--net", sys.executable, "-c", IN_A_NAMESPACE]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=os.getcwd(), timeout=60)
    assert ran.returncode == 0, ran
    expected = ["w0 wired carrier", "br0 wired no carrier", "lo loopback no carrier", "w0 wired no carrier"]
    assert ran.stdout.splitlines() == expected
