"""One radio in virtual time: the medium of IEEE 802.11b with an access point, for `slotted.Team` and ``benchmarks/fig6.py``.

A robot's frame goes to the access point as unicast: acknowledged, sent again up to 7 times. The access point sends it on to all
robots as multicast at 1 Mbit/s: no acknowledgement, so a collision there loses it. Alien stations add echo requests and replies.

The distributed coordination function: a station with something to send waits until the medium was idle for DIFS, then for a
random number of idle slots; the count stops while the medium is busy. Equal counts collide; a unicast sender then doubles its
window. Not modelled: capture, fading, stations that do not hear each other, rate adaptation, RTS/CTS, post-backoff (each frame
draws its own count).

Source: IEEE 802.11-2007, clause 9.2 (DCF) and 15.3.3 (802.11b: slot 20 µs, SIFS 10, long preamble 192).
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from random import Random
from typing import Any, Final

from msgspec import Struct

US: Final = 1_000
SLOT_NS: Final = 20 * US
SIFS_NS: Final = 10 * US
DIFS_NS: Final = 50 * US
PLCP_NS: Final = 192 * US
WINDOW_MIN: Final = 32
WINDOW_MAX: Final = 1_024
RETRIES_MAX: Final = 7
ACK_SIZE: Final = 14
HEADERS_SIZE: Final = 64
"""Bytes of 802.11, LLC, IP and UDP around what is sent."""

QUEUE_MAX: Final = 100
"""Frames that wait at one station; a full queue drops the newest (as drivers do)."""


class Rates(Struct, frozen=True):
    """In Mbit/s: unicast, and what the access point sends to all; acknowledgements go at the basic rate."""

    unicast: float = 54
    multicast: float = 1
    basic: float = 2


def air_ns(size: int, rate: float) -> int:
    """How long so many bytes of content occupy the medium."""
    return PLCP_NS + round((size + HEADERS_SIZE) * 8_000 / rate)


class Packet(Struct):
    """One thing to send.

    Attributes:
        sender: index of the robot it comes from, -1 for an alien.
        born_ns: when it was handed to the first station.
    """

    size: int
    sender: int
    born_ns: int
    content: Any = None
    is_multicast: bool = False
    retries: int = 0


class Station:
    """A sender with its queue; ``arrived``: called with the packet where it has reached its next hop."""

    __slots__ = ("arrived", "count", "lost", "queue", "ready_ns", "window")

    def __init__(self, arrived: Callable[[Packet], None], lost: Callable[[Packet], None]) -> None:
        self.arrived = arrived
        self.lost = lost
        self.queue: deque[Packet] = deque()
        self.window = WINDOW_MIN
        self.count = 0
        self.ready_ns = 0


class Agenda:
    """What is going to happen, in order; equal instants in the order of asking."""

    def __init__(self) -> None:
        self.now_ns = 0
        self._waiting: list[tuple[int, int, Callable[[Any], None], Any]] = []
        self._asked = 0

    def at(self, instant_ns: int, what: Callable[[Any], None], with_what: Any = None) -> None:
        """Have this called then."""
        self._asked += 1
        heapq.heappush(self._waiting, (instant_ns, self._asked, what, with_what))

    def run(self, until_ns: int) -> None:
        """Let time pass."""
        waiting, pop = self._waiting, heapq.heappop
        while waiting and waiting[0][0] <= until_ns:
            self.now_ns, _, what, with_what = pop(waiting)
            what(with_what)
        self.now_ns = until_ns


class Radio:
    """The medium and its access point.

    Args:
        heard: called with each packet that a robot sent, at the instant at which all robots have it.
        lost: called with each packet that nobody will have.
    """

    def __init__(
        self,
        agenda: Agenda,
        random: Random,
        heard: Callable[[Packet], None],
        lost: Callable[[Packet], None],
        rates: Rates = Rates(),  # noqa: B008 (frozen)
    ) -> None:
        self._agenda = agenda
        self._random = random
        self._heard = heard
        self._rates = rates
        self._lost = lost
        self._stations: dict[int, Station] = {}
        self._point = Station(self._from_point, lost)
        self._contenders: list[Station] = []
        self._idle_ns = 0
        self._is_busy = False
        self._spans_ns: dict[tuple[int, bool], int] = {}
        self._turn = 0
        self._turn_index = -1
        self._ack_ns = SIFS_NS + PLCP_NS + round(ACK_SIZE * 8_000 / rates.basic)

    def send(self, packet: Packet) -> None:
        """A robot, or the alien of a negative number, hands a packet to its card."""
        station = self._stations.get(packet.sender)
        if station is None:
            station = self._stations[packet.sender] = Station(self._at_point, self._lost)
        self._put(station, packet)

    def _at_point(self, packet: Packet) -> None:
        """The access point has it: on to all robots; an echo request is answered."""
        if packet.sender >= 0:
            self._put(self._point, Packet(packet.size, packet.sender, packet.born_ns, packet.content, is_multicast=True))
        else:
            self._put(self._point, Packet(packet.size, packet.sender, packet.born_ns))

    def _from_point(self, packet: Packet) -> None:
        if packet.is_multicast:
            self._heard(packet)

    def _put(self, station: Station, packet: Packet) -> None:
        if len(station.queue) >= QUEUE_MAX:
            station.lost(packet)
            return
        station.queue.append(packet)
        if len(station.queue) == 1:
            self._contend(station)

    # --- The distributed coordination function ----------------------------------------------------------------------------

    def _contend(self, station: Station) -> None:
        """It has something to send: it draws its count."""
        station.count = int(self._random.random() * station.window)
        station.ready_ns = self._agenda.now_ns
        self._contenders.append(station)
        if not self._is_busy:
            self._plan()

    def _index(self, station: Station) -> int:
        """The slot after the medium became idle in which it sends."""
        waited = station.ready_ns - self._idle_ns
        return station.count + (-(-waited // SLOT_NS) if waited > 0 else 0)

    def _plan(self) -> None:
        """When the next one sends, if nothing else comes meanwhile."""
        if not self._contenders:
            self._turn_index = -1
            return
        index = min([self._index(station) for station in self._contenders])
        if index != self._turn_index:
            self._turn += 1
            self._turn_index = index
            self._agenda.at(self._idle_ns + DIFS_NS + index * SLOT_NS, self._transmit, self._turn)

    def _transmit(self, turn: int) -> None:
        if turn != self._turn or self._is_busy:
            return
        if len(self._contenders) == 1:
            senders, self._contenders = self._contenders, []
        else:
            senders = self._first_of_many(self._turn_index)
        self._is_busy = True
        self._turn += 1
        end_ns = self._agenda.now_ns + max(self._on_air_ns(station.queue[0]) for station in senders)
        self._agenda.at(end_ns, self._over, senders)

    def _first_of_many(self, index: int) -> list[Station]:
        """Who sends in this slot; the others have waited so long in vain."""
        indices = [(self._index(station), station) for station in self._contenders]
        senders = [station for at, station in indices if at == index]
        for at, station in indices:
            if at != index:  # those slots it has waited, the medium being idle since it was ready
                station.count -= max(index - (at - station.count), 0)
                station.ready_ns = 0
        self._contenders = [station for at, station in indices if at != index]
        return senders

    def _on_air_ns(self, packet: Packet) -> int:
        kind = (packet.size, packet.is_multicast)
        span_ns = self._spans_ns.get(kind)
        if span_ns is None:
            size, is_multicast = kind
            unicast_ns = air_ns(size, self._rates.unicast) + self._ack_ns
            span_ns = self._spans_ns[kind] = air_ns(size, self._rates.multicast) if is_multicast else unicast_ns
        return span_ns

    def _over(self, senders: list[Station]) -> None:
        """The medium is idle again."""
        self._is_busy = False
        self._idle_ns = self._agenda.now_ns
        self._turn_index = -1
        if len(senders) == 1:
            station = senders[0]
            packet = station.queue.popleft()
            station.window = WINDOW_MIN
            self._again(station)
            station.arrived(packet)
        else:
            for station in senders:
                self._collided(station)
        self._plan()

    def _collided(self, station: Station) -> None:
        packet = station.queue[0]
        if not packet.is_multicast and packet.retries < RETRIES_MAX:
            packet.retries += 1
            station.window = min(station.window * 2, WINDOW_MAX)
        else:
            station.queue.popleft()
            station.window = WINDOW_MIN
            station.lost(packet)
        self._again(station)

    def _again(self, station: Station) -> None:
        """The next one of its queue, if there is one."""
        if station.queue:
            station.count = int(self._random.random() * station.window)
            station.ready_ns = 0
            self._contenders.append(station)
