"""Addresses of members: which cannot be right, and which this machine has."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import ipaddress
import socket
import struct
from collections.abc import Mapping
from typing import Final

from failover.config.team import Robot, for_lookup, split_address
from failover.errors import TeamFileError

SIOCGIFADDR: Final = 0x8915
SIOCGIFFLAGS: Final = 0x8913
IFF_UP: Final = 1
"""Source: linux/sockios.h, linux/if.h, netdevice(7)."""

ELSEWHERE: Final = ("192.0.2.1", 9)
"""A documentation address (RFC 5737): nothing is sent there; the kernel only chooses the interface of its default route."""

Number = ipaddress.IPv4Address | ipaddress.IPv6Address


def check_addresses(name: str, member: Robot, others: Mapping[str, Robot]) -> None:
    """Refuse addresses at which this member could not be reached by the others.

    Raises:
        TeamFileError: names the address and the reason.
    """
    theirs = {
        place: other
        for other, robot in others.items()
        if other != name
        for place in _places(robot)
        if place[0] == "bulk" or robot.site == member.site  # no heartbeat leaves a site
    }
    ours = [split_address(address, f"robot {name}") for address in member.beats]
    bulk = split_address(member.bulk, f"robot {name}")
    if len(set(ours)) < len(ours):
        raise TeamFileError(f"{name}: {_doubled(ours)} stands twice among its beat addresses; each link has one of its own")
    for host, port in {*ours, bulk}:
        number = _number(host)
        if number is not None and (why := _useless(number)):
            raise TeamFileError(f"{name}: {host} is {why}; give the address of a network interface of {name}")
        if ("beats", host, port) in theirs and (host, port) in ours:
            raise TeamFileError(f"{name}: {theirs['beats', host, port]} has the beat address {host}:{port} already")
    if ("bulk", *bulk) in theirs:
        raise TeamFileError(f"{name}: {theirs[('bulk', *bulk)]} has the bulk address {bulk[0]}:{bulk[1]} already")
    _check_loopback(name, member, others)


def _check_loopback(name: str, member: Robot, others: Mapping[str, Robot]) -> None:
    """The loopback serves a team of which all members are on one machine, and no other."""
    for other, robot in others.items():
        if other != name and is_local_only(member) != is_local_only(robot):
            here, there = (name, other) if is_local_only(member) else (other, name)
            raise TeamFileError(
                f"{here} has a loopback address, at which {there} cannot reach it; give {here} the address of a network interface"
            )


def _places(robot: Robot) -> list[tuple[str, str, int]]:
    beats = [("beats", *split_address(address, "beat address")) for address in robot.beats]
    return [*beats, ("bulk", *split_address(robot.bulk, "bulk address"))]


def _doubled(places: list[tuple[str, int]]) -> str:
    host, port = next(place for place in places if places.count(place) > 1)
    return f"{host}:{port}"


def _number(host: str) -> Number | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _useless(number: Number) -> str:
    if number.is_unspecified:
        return "the address of no interface"
    if number.is_multicast:
        return "a multicast address"
    if number == ipaddress.IPv4Address("255.255.255.255"):
        return "the broadcast address"
    if isinstance(number, ipaddress.IPv4Address) and number.is_reserved:
        return "a reserved address"
    return ""


def is_local_only(robot: Robot) -> bool:
    """Whether one of its addresses is of the loopback."""
    hosts = [split_address(address, "address")[0] for address in (*robot.beats, robot.bulk)]
    return any(host == "localhost" or ((number := _number(host)) is not None and number.is_loopback) for host in hosts)


def check_own(name: str, member: Robot) -> None:
    """Refuse an address of this robot that no interface of this machine has.

    Raises:
        TeamFileError: names it, and those that there are.
    """
    for address in (*member.beats, member.bulk):
        host, _ = split_address(address, f"robot {name}")
        if _number(host) is not None and not is_ours(host):
            there = ", ".join(own_addresses()) or "none but the loopback"
            raise TeamFileError(f"{host} is no address of this machine, which has {there}; --address names the one for {name}")


def is_ours(host: str) -> bool:
    """Whether a number is an address of this machine; a name is not looked up, for that can take its time."""
    with contextlib.suppress(OSError, ValueError):
        found = socket.getaddrinfo(for_lookup(host), 0, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)
        family, kind, protocol, _, address = found[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
            return True
    return False


def own_addresses() -> list[str]:
    """The IPv4 addresses of interfaces that are up, without the loopback, in the order of the interfaces."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, interface in socket.if_nameindex():
            question = struct.pack("256s", interface.encode()[:15])
            with contextlib.suppress(OSError):  # it has none, or has just gone
                (flags,) = struct.unpack_from("=h", fcntl.ioctl(asked, SIOCGIFFLAGS, question), 16)
                number = ipaddress.IPv4Address(fcntl.ioctl(asked, SIOCGIFADDR, question)[20:24])
                if flags & IFF_UP and not number.is_loopback:
                    found.append(str(number))
    return found


def usual_address() -> str:
    """The address by which this machine most probably reaches its neighbours.

    Raises:
        TeamFileError: there is none, or more than one and no default route.
    """
    there = own_addresses()
    if len(there) == 1:
        return there[0]
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(ELSEWHERE)
        return str(probe.getsockname()[0])
    if not there:
        raise TeamFileError("this machine has no network address but the loopback's; connect it, or name one: --address HOST")
    raise TeamFileError(f"this machine has the addresses {', '.join(there)} and no default route; name one: --address HOST")


def address_towards(host: str, port: int) -> str:
    """The address of this machine by which it reaches another one.

    Raises:
        TeamFileError: it does not.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(for_lookup(host), port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0])
    except OSError as error:
        reason = error.strerror or "no route" if error.errno != errno.ENETUNREACH else "no network leads there"
        raise TeamFileError(f"cannot reach {host}: {reason}; connect this machine to its network") from error
