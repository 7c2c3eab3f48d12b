"""Orders persist → send → act, without letting a slow disk delay a heartbeat.

While a vote record is on its way to the disk, nothing that depends on it leaves: acts wait, and so does the content of
heartbeats. But "I live" depends on nothing: a heartbeat that is due meanwhile leaves without its entries, with the ``settled`` of
the last durable one, so that peers still know exactly what they were told before. Echoes extend the leases of the robots that
hear them. The outbox withholds an echo from a robot whose primacy the waiting vote record gives up, because the vote that follows
counts on that lease running out. It withholds every promise to wait for a robot: that one may be what is on its way to the disk.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import msgspec
from msgspec import Struct, field

from failover.core.acts import Act, Ready, SetLease
from failover.core.beat_pace import least_ns
from failover.core.types import VoteRecord
from failover.core.wire.messages import Beat


class Due(Struct, frozen=True):
    """The obligations that may leave now, in this order: ``persist`` to the disk, ``beats`` to the peers, ``acts`` to the worker.

    Attributes:
        persist: (number, vote record); `Outbox.kept` is told the number once it is durable.
    """

    persist: tuple[int, VoteRecord] | None = None
    beats: tuple[Beat, ...] = ()
    acts: tuple[Act, ...] = ()


NOTHING: Final = Due()
"""What most heartbeats of others make due."""


class Outbox(Struct):
    """The obligations of one node.

    Attributes:
        durable: the vote record that is on the disk.
        beat_ns: period after which a beat is always due.

    Invariant: acts leave in the order in which they were ordered, each after every vote record ordered before it.
    """

    durable: VoteRecord
    beat_ns: int
    _newest: VoteRecord | None = None
    _ordered: int = 0
    _kept: int = 0
    _acts: deque[tuple[int, Act]] = field(default_factory=deque)
    _withheld: Beat | None = None
    _settled: int = 0
    _beaten_ns: int = 0

    @property
    def waiting(self) -> bool:
        """Whether a vote record is on its way to the disk."""
        return self._kept < self._ordered

    @property
    def unleased(self) -> tuple[str, ...]:
        """The components whose guards wait for a lease that waits for the disk."""
        return tuple(act.component for _, act in self._acts if isinstance(act, SetLease) and act.until_ns)

    def take(self, ready: Ready, now_ns: int) -> Due:
        """Take in new obligations; return those that may leave now: `NOTHING` if there are none."""
        if ready.persist is None and not ready.send and not ready.act and not self._acts and self._kept >= self._ordered:
            self._withheld = None
            return NOTHING
        persist = None
        if ready.persist is not None:
            self._ordered += 1
            self._newest = ready.persist
            persist = (self._ordered, ready.persist)
        for act in ready.act:
            self._queue(act)
        return Due(persist, self._beats(ready.send, now_ns), self._free_acts())

    def kept(self, number: int, vote_record: VoteRecord, now_ns: int) -> Due:
        """The vote record of that number, and so every earlier one, is durable."""
        self._kept, self.durable = max(self._kept, number), vote_record
        beat = self._withheld
        if self.waiting or beat is None:
            return Due(acts=self._free_acts())
        return Due(beats=self._beats((beat,), now_ns), acts=self._free_acts())

    def _queue(self, act: Act) -> None:
        """Put an act last. Of the leases of one component only the newest waits: a disk may be full for a night.

        The core still waits for the word that one of an earlier lease of the same epoch asked for.
        """
        if self.waiting and isinstance(act, SetLease):
            for one in list(self._acts):
                earlier = one[1]
                if isinstance(earlier, SetLease) and earlier.component == act.component:
                    self._acts.remove(one)
                    if earlier.is_asked and earlier.epoch == act.epoch:
                        act = msgspec.structs.replace(act, is_asked=True)
        self._acts.append((self._ordered, act))

    def _beats(self, beats: tuple[Beat, ...], now_ns: int) -> tuple[Beat, ...]:
        if not self.waiting:
            self._withheld = None
            if beats:
                self._settled, self._beaten_ns = beats[-1].settled, now_ns
            return beats
        if not beats:
            return ()
        if now_ns - self._beaten_ns < least_ns(self.beat_ns):
            self._withheld = beats[-1]
            return ()
        self._withheld, self._beaten_ns = None, now_ns
        return (self._stripped(beats[-1]),)

    def _stripped(self, beat: Beat) -> Beat:
        given_up = abandoned(self.durable, self._newest or self.durable)
        echoes = tuple(echo for echo in beat.echoes if echo.robot not in given_up)
        settled = min(self._settled, beat.counter)
        return msgspec.structs.replace(beat, entries=(), echoes=echoes, settled=settled, promises=())

    def _free_acts(self) -> tuple[Act, ...]:
        free = []
        while self._acts and self._acts[0][0] <= self._kept:
            free.append(self._acts.popleft()[1])
        return tuple(free)


def abandoned(durable: VoteRecord, newest: VoteRecord) -> frozenset[str]:
    """Robots whose primacy of some component one vote record accepts and the other does not, or not in the same epoch."""
    now = {record.name: record for record in newest.records}
    return frozenset(
        record.primary
        for record in durable.records
        if record.primary
        and (record.name not in now or (now[record.name].primary, now[record.name].epoch) != (record.primary, record.epoch))
    )
