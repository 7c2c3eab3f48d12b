"""Restore packet sockets, which receive and send whole frames: bound to their interface, with memberships and fanout.

Waiting frames are lost, as the network may lose them.

Facts besides those of every socket: ``interface``: the name of the one that it is bound to, "" for all; ``ether_type``: the
protocol that it receives, as bind(2) takes it; ``memberships``: a list of [interface, type, address]; ``rings``: the option that
makes each, and its argument; ``fanout``: group and kind, 0 for none; ``lost``: frames wait.

Source: packet(7).
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.engine import NOTED, Finding
from checkpoint.errors import CaptureError
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import sockets
from checkpoint.resources.sockets.peer_credentials import Disguise

KIND: Final = "packet_sockets"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "packet sockets",
        "bound to their interface again, with filter, memberships and options; frames that wait are lost, as the network may "
        "lose them",
    ),
    refused(
        Area.THERE,
        "a missing interface of a packet socket",
        "rename or add the interface",
        "is a packet socket at the interface",
    ),
)

KINDS: Final = (socket.SOCK_RAW, socket.SOCK_DGRAM)
SOL_PACKET: Final = 263
ADD_MEMBERSHIP: Final = 1
FANOUT: Final = 18
PACKET_VERSION: Final = 10
_RING_SIZE: Final = 28
_RING_SIZE_BEFORE: Final = 16
"""Bytes of struct tpacket_req3, and of tpacket_req."""
_ADDRESS: Final = struct.Struct("<HHiHBB8s")
"""struct sockaddr_ll."""
_REQUEST: Final = struct.Struct("<iHH8s")
"""struct packet_mreq."""


def observe(held: OpenFile, looked: socket.socket, opened: Opened) -> dict[str, Fact]:
    """Where it is bound, and what else it hears.

    Raises:
        OSError: it cannot be looked into.
        CaptureError: the kernel does not tell.
    """
    told = opened.listings.packet_sockets().get(held.first.inode)
    if told is None:
        raise CaptureError(f"cannot ask the kernel about the packet socket {held.name} (sock_diag): load af_packet_diag")
    interface, ether_type, *_ = looked.getsockname()
    return sockets.general_facts(held, looked, opened) | {
        "interface": interface,
        "ether_type": ether_type,
        "memberships": [[_name_of(one.interface), one.type, one.address] for one in told.memberships for _ in range(one.count)],
        "rings": [[option, packed] for option, packed in told.rings.items()],
        "fanout": looked.getsockopt(SOL_PACKET, FANOUT),
        "lost": bool(sockets.readiness(looked) & ~select.POLLPRI),
    }


def _name_of(index: int) -> str:
    with contextlib.suppress(OSError):  # it has gone
        return socket.if_indextoname(index)
    return ""


def is_mine(looked: socket.socket) -> bool:
    """Whether it is of this kind: SOCK_PACKET is of another."""
    return looked.family == socket.AF_PACKET and looked.type in KINDS


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The socket as it was observed."""
    if held.observed.get("family") != socket.AF_PACKET:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a packet socket cannot be kept."""
    if held.observed.get("family") != socket.AF_PACKET:
        return None
    return sockets.refuse_filter(held) or other_holders.refuse(held, "a packet socket")


def findings(held: Iterable[Resource]) -> Iterator[Finding]:
    """Frames that are lost."""
    for one in held:
        if one.kind == KIND and one.facts["lost"]:
            yield Finding(KIND, one.name, NOTED, f"frames that wait in {one.name} are lost when the program comes back")


def mismatches(held: Resource) -> Iterator[str]:
    """Why it could not be bound here."""
    here = {name for _, name in socket.if_nameindex()}
    for name in sorted({str(held.facts["interface"]), *(str(one[0]) for one in _memberships(held))} - here - {""}):
        yield f"{held.name} is a packet socket at the interface {name}, which is missing here: rename or add it"


def _has_third_version(held: Resource) -> bool:
    """Whether its frames have the head of TPACKET_V3, for which a ring is told more."""
    asked = (SOL_PACKET, PACKET_VERSION)
    return any((level, number) == asked and value[:4] == b"\2\0\0\0" for level, number, value in sockets.options_of(held))


def _memberships(held: Resource) -> list[list[Fact]]:
    memberships = held.facts["memberships"]
    assert isinstance(memberships, list)
    return [one for one in memberships if isinstance(one, list)]


# --- Restore -----------------------------------------------------------------------------------------------------------


def prepare(table: CallTable, held: Sequence[Resource], first: int, _: Disguise) -> dict[int, int]:
    """Make all of them at numbers from ``first`` on: the descriptor of each, by the socket's number in the snapshot."""
    made: dict[int, int] = {}
    for one in held:
        opened, number = sockets.make(table, one), first + len(made)
        table.duplicate(opened, number, os.O_CLOEXEC)
        table.close(opened)
        made[number_of(one.facts["socket"])] = number
        _place(table, one, number)
        sockets.set_flags(table, one, number)
    return made


def _place(table: CallTable, one: Resource, made: int) -> None:
    interface, ether_type = str(one.facts["interface"]), number_of(one.facts["ether_type"])
    index = socket.if_nametoindex(interface) if interface else 0
    rings = one.facts["rings"]
    assert isinstance(rings, list)
    for ring in rings:
        assert isinstance(ring, list) and isinstance(ring[1], bytes)
        size = _RING_SIZE if _has_third_version(one) else _RING_SIZE_BEFORE
        what = f"give {one.name} its ring"
        table.call(what, "setsockopt", made, SOL_PACKET, number_of(ring[0]), table.place(ring[1][:size]), size)
    address = _ADDRESS.pack(socket.AF_PACKET, socket.htons(ether_type), index, 0, 0, 0, bytes(8))
    table.call(f"bind {one.name} to the interface {interface or 'all'}", "bind", made, table.place(address), _ADDRESS.size)
    for name, kind, hardware in _memberships(one):
        assert isinstance(hardware, bytes)
        if not name:
            continue
        request = _REQUEST.pack(socket.if_nametoindex(str(name)), number_of(kind), len(hardware), hardware[:8])
        what = f"have {one.name} hear more at {name!s}"
        table.call(what, "setsockopt", made, SOL_PACKET, ADD_MEMBERSHIP, table.place(request), _REQUEST.size)
    if fanout := number_of(one.facts["fanout"]):
        place = table.place(fanout.to_bytes(4, "little"))
        lost = f"{one.name} does not share its frames with others any more (PACKET_FANOUT)"
        table.attempt(lost, "setsockopt", made, SOL_PACKET, FANOUT, place, 4)
