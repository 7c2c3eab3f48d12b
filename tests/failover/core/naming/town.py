"""Many processes that share their names, in virtual time, over a network that delays, loses and can be cut."""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable, Iterable

from failover.core.naming import scan
from failover.core.naming.records import Record
from failover.core.naming.scan import MULTICAST, SECOND, Scan
from failover.errors import NameUnknownError

MS = 1_000_000
DELAY_NS_MAX = 5 * MS
ENVELOPE = 40
"""Bytes that a transport adds to a message: IP and TCP headers of one segment."""


class Town:
    """The processes by their origin; an origin's address is the origin itself."""

    def __init__(
        self, seed: int, origins: Iterable[str], *, names: int, loss: float = 0.0, seeds: Iterable[str] | None = None
    ) -> None:
        """
        Args:
            names: how many each registers.
            seeds: the addresses that each knows at first; None: all.
        """
        origins = tuple(origins)
        self.random = random.Random(seed)
        self.now_ns = 0
        self.loss = loss
        self.parts: dict[str, int] = {}
        self.sent: Counter[str] = Counter()
        self.came: Counter[str] = Counter()
        self.scans: dict[str, Scan] = {}
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._number = 0
        self._decoded: dict[bytes, scan.Message] = {}
        for origin in origins:
            self.add(origin, names=names, seeds=origins if seeds is None else seeds)

    def add(self, origin: str, *, names: int, seeds: Iterable[str], boot: int = 1, multicast: bool = False) -> Scan:
        one = Scan(origin, boot, self.now_ns, address=origin, seeds=seeds, multicast=multicast)
        self.scans[origin] = one
        for number in range(names):
            one.put(record(origin, number), self.now_ns)
        self.wake(origin)
        return one

    def kill(self, origin: str) -> None:
        del self.scans[origin]

    def wake(self, origin: str) -> None:
        """Look again when this process wants to act."""
        one = self.scans[origin]

        def tick() -> None:
            if self.scans.get(origin) is one and one.next_ns() <= self.now_ns:
                self._post(origin, one.tick(self.now_ns))
                self.wake(origin)

        self.at(max(one.next_ns(), self.now_ns), tick)

    def at(self, when_ns: int, act: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._events, (when_ns, self._number, act))

    def run(self, seconds: float) -> None:
        end_ns = self.now_ns + int(seconds * SECOND)
        while self._events and self._events[0][0] <= end_ns:
            self.now_ns, _, act = heapq.heappop(self._events)
            act()
        self.now_ns = end_ns

    def _post(self, sender: str, sends: list[scan.Send]) -> None:
        encoded: dict[int, bytes] = {}
        for send in sends:
            content = encoded.get(id(send.message)) or encoded.setdefault(id(send.message), scan.encode(send.message))
            for to in list(self.scans) if send.to == MULTICAST else [send.to]:
                if to != sender:
                    self._carry(sender, to, content)

    def _carry(self, sender: str, to: str, content: bytes) -> None:
        self.sent[sender] += len(content) + ENVELOPE
        if self.parts.get(sender, 0) != self.parts.get(to, 0) or self.random.random() < self.loss:
            return

        def arrive() -> None:
            if (one := self.scans.get(to)) is None or self.parts.get(sender, 0) != self.parts.get(to, 0):
                return
            self.came[to] += len(content) + ENVELOPE
            message = self._decoded.get(content)
            if message is None:
                decoded = scan.decode(content)
                assert decoded is not None
                if len(self._decoded) > 1_000:
                    self._decoded.clear()
                message = self._decoded[content] = decoded
            self._post(to, one.heard(message, self.now_ns))
            self.wake(to)

        self.at(self.now_ns + self.random.randrange(DELAY_NS_MAX), arrive)

    # --- What is asked of it ----------------------------------------------------------------------------------------------

    def resolves(self, asked: str, path: str) -> str:
        """The origin that a process resolves a name to; "" for none."""
        try:
            return self.scans[asked].tree(self.now_ns).resolve(path).origin
        except NameUnknownError:
            return ""

    def wrong(self, asked: Iterable[str], origins: Iterable[str]) -> list[str]:
        """Which names of these origins a process does not resolve to what they register at this instant."""
        found = []
        for origin in origins:
            live = {path: entry.body for path, entry in self.scans[origin].own.entries.items() if entry.body}
            for one in asked:
                table = self.scans[one]._tables.get(origin)
                seen = {} if table is None else {path: entry.body for path, entry in table.entries.items() if entry.body}
                if seen != live:
                    found.append(f"{one} has {len(seen)} names of {origin}, which has {len(live)}, or others")
        return found


def record(origin: str, number: int, **changes: object) -> Record:
    """The driver of an engine, with a schema of its own, as such a record is."""
    verbs = {"set": {"duty": {"type": "number", "minimum": -1, "maximum": 1}}, "read": {}}
    return Record(
        f"University/Lab/{origin}/Engines/{number}/PWM",
        addresses=(f"tcp://10.0.0.{len(origin)}:{5_000 + number}", f"ipc:///run/failover/{origin}/{number}"),
        verbs=verbs,
        owner="user1",
        labels={"serial": f"A-{number:04}", **changes},  # type: ignore[dict-item]
    )
