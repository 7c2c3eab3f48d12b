"""Builds a robot's heartbeat: chooses its entries so that they fit one part of a frame and each is sent in turn."""

from __future__ import annotations

from msgspec.structs import replace

from failover.core.component import Component
from failover.core.election.consent import STATES
from failover.core.frames.frame import beat_size_max
from failover.core.types import EPOCH_MAX, HOLDING, Rule, State
from failover.core.wire.codec import beat_size, entry_size
from failover.core.wire.messages import (
    BARE,
    BEGUN,
    FREE,
    FRESH,
    HOLDS,
    NEEDS_BASE,
    OPEN,
    ORDERED,
    RULES,
    SAFE,
    STARTS,
    STOOD,
    UNABLE,
    UNPROTECTED,
    WANTS,
    WARM,
    Beat,
    Echo,
    Entry,
    Promise,
)

LOAD_MAX = 255
"""A robot with more primaries than this is just very busy."""

BEAT_OVERHEAD = 16
"""Bytes by which a beat may grow beyond the sum of its parts: longer array heads, a longer counter."""


def entry_of(component: Component) -> Entry:
    """One component as this robot holds it."""
    epoch = min(component.epoch, EPOCH_MAX - 1)  # a record that is to be mended spoils no beat
    newest = component.newest if component.epoch == epoch else None
    handing = component.handing
    flags = NEEDS_BASE * component.needs_base | UNPROTECTED * component.unprotected
    flags |= HOLDS * component.waits | WARM * component.warm
    flags |= FREE * component.free | OPEN * component.open | ORDERED * component.ordered
    flags |= WANTS * (component.wanted is not None) | UNABLE * bool(component.unable)
    flags |= STOOD * (component.holding and component.stood)
    flags |= SAFE * (component.holding and newest is not None and component.safe == newest)
    flags |= BEGUN * component.has_begun | FRESH * component.fresh
    flags |= BARE * (component.elects and component.bare and newest is not None)
    flags |= STARTS * (component.autostart and not component.held and not component.entrusted)
    return Entry(
        component.name,
        STATES.index(component.state),
        epoch,
        component.primary,
        newest.generation if newest else 0,
        newest.sequence if newest else 0,
        newest.digest if newest else b"",
        component.named,
        handing.to if handing and handing.yielded else "",
        flags,
        component.status,
        epoch if component.state is State.CLAIMING else min(component.born, epoch),
    )


def urgent(entry: Entry, before: Entry | None) -> bool:
    """Whether others wait for this change: everything but a primary's own progress."""
    if entry == before:
        return False
    if before is None or STATES[entry.state] in (State.STANDBY, State.ABSENT, State.HANDING_OVER):
        return True
    return _essence(entry) != _essence(before) or entry.yields_to != before.yields_to


class Speaker:
    """Makes the beats of one life of one robot in a team of so many. ``counter`` is that of the last one made."""

    def __init__(self, me: str, boot: int, rule: Rule = Rule.PAIR, members: int = 2) -> None:
        self._me = me
        self._boot = boot
        self.speak_for(rule, members)
        self.counter = 0
        self._settled = 0
        self._said: dict[str, tuple[Entry, int]] = {}

    def speak_for(self, rule: Rule, members: int) -> None:
        """From now on in a team of so many, by this rule."""
        self._rule = RULES.index(rule)
        self._size_max = beat_size_max(members)

    def pressing(self, entries: dict[str, Entry]) -> bool:
        """Whether something has changed that should not wait for the next beat."""
        return any(urgent(entry, self._said[name][0] if name in self._said else None) for name, entry in entries.items())

    def beat(
        self,
        entries: dict[str, Entry],
        echoes: tuple[Echo, ...],
        grace_ms: int = 0,
        promises: tuple[Promise, ...] = (),
        *,
        drained: bool = False,
    ) -> Beat:
        """The next beat. Entries that changed go first, then those that were not said for the longest time."""
        self.counter += 1
        changed = {name for name, entry in entries.items() if self._unsettling(entry)}
        if changed or len(entries) != len(self._said):
            self._settled = self.counter
        empty = Beat(
            self._me,
            self._boot,
            self.counter,
            self._settled,
            total=len(entries),
            echoes=echoes,
            rule=self._rule,
            grace_ms=grace_ms,
            promises=promises,
            drained=drained,
        )
        if not entries:
            self._said.clear()
            return empty
        self._said = {name: said for name, said in self._said.items() if name in entries}
        order = sorted(entries, key=lambda name: (name not in changed, not self._news(entries[name]), self._last(name)))
        chosen = self._fitting([entries[name] for name in order], empty)
        for name in changed:
            self._said[name] = (entries[name], 0)
        for entry in chosen:
            self._said[entry.name] = (entry, self.counter)
        load = min(sum(STATES[entry.state] in HOLDING for entry in entries.values()), LOAD_MAX)
        return replace(empty, load=load, entries=chosen)

    def unsaid(self, beat: Beat) -> None:
        """That beat leaves over no link: what no later one has said is said first in the next one."""
        for entry in beat.entries:
            said = self._said.get(entry.name)
            if said is not None and said[1] == beat.counter:
                self._said[entry.name] = (said[0], 0)

    def _fitting(self, entries: list[Entry], empty: Beat) -> tuple[Entry, ...]:
        room = self._size_max - beat_size(empty) - BEAT_OVERHEAD
        chosen: list[Entry] = []
        for entry in entries:
            room -= entry_size(entry)
            if room < 0:
                break
            chosen.append(entry)
        return tuple(chosen)

    def _unsettling(self, entry: Entry) -> bool:
        said = self._said.get(entry.name)
        return said is None or _essence(said[0]) != _essence(entry)

    def _news(self, entry: Entry) -> bool:
        said = self._said.get(entry.name)
        return said is None or said[0] != entry

    def _last(self, name: str) -> int:
        return self._said[name][1] if name in self._said else 0


def _essence(entry: Entry) -> tuple[int, int, str, str]:
    """What unsettles an entry when it changes."""
    return entry.epoch, entry.state, entry.primary, entry.standby
