"""Restore netlink sockets: bound to their number again, in their groups.

Data that waits in one is the kernel's answer or report of that moment, which no other source can send again: the program must
read it first.

Facts besides those of every socket: ``port``: the number that it is bound to, 0 for none; ``groups``: those that it has joined;
``peer``: number and mask of groups that it is connected to, empty if it is not; ``busy``: data waits in it, or is still to come.

Source: netlink(7); net/netlink/af_netlink.c.
"""

from __future__ import annotations

import os
import select
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.engine import NOTED, Finding
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.kernel_listings import Listings
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import sockets
from checkpoint.resources.sockets.peer_credentials import Disguise
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "netlink_sockets"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "netlink sockets (routes, links, kernel events, generic netlink, diagnosis)",
        "bound to their number again, with groups and options; the program must ask again for the state that a driver "
        "keeps for a generic one",
    ),
    refused(
        Area.SOCKETS,
        "a netlink socket in which an answer waits, or of a family that keeps more for it (netfilter, audit, connector …)",
        "an answer: wait, failover captures the socket as soon as the program has read it. Another family: open it only "
        "for a moment, then close it",
        "is a netlink socket in which",
        "is a netlink socket of family",
    ),
)

FAMILIES: Final[Mapping[int, str]] = {
    0: "route",
    2: "usersock",
    4: "sock_diag",
    6: "xfrm",
    7: "selinux",
    15: "kobject_uevent",
    16: "generic",
}
"""Families whose sockets have no more state than a number and groups."""
GENERIC: Final = 16
SOL_NETLINK: Final = 270
ADD_MEMBERSHIP: Final = 1
LIST_MEMBERSHIPS: Final = 9
GROUPS_SIZE: Final = 512
"""Bytes of the longest list of groups, one bit each."""
_DUMP_COLUMN: Final = 6
_ADDRESS: Final = struct.Struct("<HHII")
"""struct sockaddr_nl."""


def observe(held: OpenFile, looked: socket.socket, opened: Opened) -> dict[str, Fact]:
    """Its number, its groups, and whether something is under way.

    Raises:
        OSError: it cannot be looked into.
    """
    port, _ = looked.getsockname()
    return sockets.general_facts(held, looked, opened) | {
        "port": port,
        "groups": list(_groups(looked)),
        "peer": _peer(looked),
        "busy": _is_busy(held, looked, opened.listings),
    }


def _groups(looked: socket.socket) -> Iterator[int]:
    packed = looked.getsockopt(SOL_NETLINK, LIST_MEMBERSHIPS, GROUPS_SIZE)
    bits = int.from_bytes(packed, "little")
    return (index + 1 for index in range(bits.bit_length()) if bits >> index & 1)


def _peer(looked: socket.socket) -> list[Fact]:
    port, groups = looked.getpeername()
    return [port, groups] if port or groups else []


def _is_busy(held: OpenFile, looked: socket.socket, listings: Listings) -> bool:
    """Whether a message or an error waits, or the rest of a list is still to come. Source: proc_pid_net(5)."""
    if sockets.readiness(looked) & (select.POLLIN | select.POLLERR | select.POLLHUP):
        return True
    words = listings.line(held.pid, "netlink", held.first.inode)
    return bool(words) and words[_DUMP_COLUMN] != "0"


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The socket as it was observed."""
    if held.observed.get("family") != socket.AF_NETLINK:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a netlink socket cannot be kept."""
    seen = held.observed
    if seen.get("family") != socket.AF_NETLINK:
        return None
    if (family := number_of(seen["protocol"])) not in FAMILIES:
        return (
            f"{held.name} is a netlink socket of family {family}, for which the kernel keeps more than it shows: "
            "let the program close it"
        )
    if seen["busy"]:
        return f"{held.name} is a netlink socket in which an answer of the kernel waits: {AS_SOON_AS} the program has read that"
    return sockets.refuse_filter(held) or other_holders.refuse(held, "a netlink socket")


def findings(held: Iterable[Resource]) -> Iterator[Finding]:
    """Notes about state that may not come back."""
    for one in held:
        if one.kind == KIND and one.facts["protocol"] == GENERIC:
            text = f"a restore loses the state that a driver keeps for the generic netlink socket {one.name}"
            yield Finding(KIND, one.name, NOTED, text)


# --- Restore -----------------------------------------------------------------------------------------------------------


def prepare(table: CallTable, held: Sequence[Resource], first: int, disguise: Disguise) -> dict[int, int]:
    """Make all of them at numbers from ``first`` on: the descriptor of each, by the socket's number in the snapshot.

    The rights of a message depend on the process that opened the socket, too, not only on its sender.

    Source: netlink_ns_capable() in net/netlink/af_netlink.c.
    """
    made: dict[int, int] = {}
    for one in held:
        with disguise.as_owner(table, one):
            opened = sockets.fresh(table, one)
        sockets.set_options(table, one, opened)
        number = first + len(made)
        table.duplicate(opened, number, os.O_CLOEXEC)
        table.close(opened)
        made[number_of(one.facts["socket"])] = number
        _place(table, one, number)
        sockets.set_flags(table, one, number)
    return made


def _place(table: CallTable, one: Resource, made: int) -> None:
    port, peer, groups = number_of(one.facts["port"]), one.facts["peer"], one.facts["groups"]
    assert isinstance(peer, list) and isinstance(groups, list)
    if port:
        lost = f"the netlink socket {one.name} had the number {port}, which is taken here"
        table.attempt(lost, "bind", made, table.place(_packed(port, 0)), _ADDRESS.size)
    for group in groups:
        lost = f"the netlink socket {one.name} is not in group {group!r} any more"
        place = table.place(number_of(group).to_bytes(4, "little"))
        table.attempt(lost, "setsockopt", made, SOL_NETLINK, ADD_MEMBERSHIP, place, 4)
    if peer:
        address = table.place(_packed(number_of(peer[0]), number_of(peer[1])))
        table.call(f"connect {one.name}", "connect", made, address, _ADDRESS.size)


def _packed(port: int, groups: int) -> bytes:
    return _ADDRESS.pack(socket.AF_NETLINK, 0, port, groups)
