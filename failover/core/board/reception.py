"""Puts what frames of another robot bring into its file, by the only writer of that file, and keeps the account of each record.

Puts have numbers of the file's own, one after the other, beginning with the writer's epoch: the writer's numbers skip puts that
no frame carried. The order of stores is that of `failover.core.board.banks`. Where a frame has the same items as the one before,
each with a newer value, each of its steps is made for all of them before the next step. Then no line of Python runs for each
item, which would be most of what a frame costs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import compress, repeat
from operator import add, gt, le, setitem
from typing import Any, Final, Protocol

from msgspec import Struct
from msgspec.structs import astuple

from failover.core.board.ages import AGE_MAX_US, NO_ERROR_BOUND, NS_PER_US
from failover.core.board.banks import EPOCH_SHIFT, LOW_HALF, Fence, Place, bank_words, first_of_epoch, put_carefully
from failover.core.board.layout import FRAMES_FIELD, LOST_FIELD, REFUSED_FIELD, SUM_WORD, TRANSIT_FIELD

TOGETHER_MIN: Final = 3
"""Items of a frame from which on it is worth while to take them together."""

TOLD_NS: Final = 1_000_000_000
"""Frames of items that are taken together are counted in their records so often."""

PLANS_MAX: Final = 64
"""Different frames of one robot that are remembered: each combination of periods is one."""

PLACES_MAX: Final = 1 << 14
"""Of values, in all that is remembered of one robot: some 2 MB, however its frames vary. Beyond it all is found out anew."""


class Brought(Protocol):
    """An item's whole value, as a frame brings it (`failover.core.frames.frame.Portion`)."""

    @property
    def number(self) -> int: ...
    @property
    def age_us(self) -> int: ...
    @property
    def put(self) -> int: ...
    @property
    def value(self) -> bytes: ...


class Slot:
    """One item of the file, and what came for it.

    Args:
        record: index of the record's first word.
        period: of the item, in rounds.

    Attributes:
        following: number of its next put here; ``after``: the first number of the writer's next epoch.
        last_number, last_round: of the newest put of the writer, and of the newest frame with it.
    """

    __slots__ = ("after", "count", "fence", "following", "heads", "last_number", "last_round", "period", "place", "record")

    def __init__(self, place: Place, record: int, period: int, fence: Fence | None = None) -> None:
        self.place, self.record, self.period, self.fence = place, record, period, fence
        self.heads = bank_words(place)
        for head, *_ in self.heads if fence is None else ():
            place.words[head + SUM_WORD] = 0  # none is needed: once and for all
        self.following = place.words[place.newest] + 1
        self.count = place.words[record + FRAMES_FIELD // 8]
        self.after = _end_of_epoch(self.following)
        self.last_number, self.last_round = 0, -1

    def take(self, item: Brought, came_ns: int, error_us: int, round_: int, missing: int) -> bool | None:
        """Put one value; whether it was put; None: it does not fit. For the arguments see `Reception.take`."""
        place, record = self.place, self.record
        words, size, age_us, number = place.words, len(item.value), item.age_us, item.put
        error_us = error_us if age_us < AGE_MAX_US else NO_ERROR_BOUND
        self.count += 1
        words[record + FRAMES_FIELD // 8] = self.count
        words[record + TRANSIT_FIELD // 8] = (round_ & LOW_HALF) << 32 | error_us
        if missing and 0 <= self.last_round < round_ - self.period:
            words[record + LOST_FIELD // 8] += min((round_ - self.last_round) // self.period - 1, missing)
        self.last_round = round_
        if not place.least <= size <= place.limit:
            words[record + REFUSED_FIELD // 8] += 1
            return None
        if number <= self.last_number:
            return False
        self.last_number = number
        if number >= self.after:
            self.following = first_of_epoch(self.following - 1, number >> EPOCH_SHIFT, len(place.banks))
            self.after = _end_of_epoch(self.following)
        following, stamp_ns = self.following, max(came_ns - age_us * NS_PER_US, 0)
        self.following = following + 1
        if self.fence is not None:
            put_carefully(place, following, item.value, stamp_ns, error_us, self.fence)
            return True
        self.store(following, item.value, stamp_ns, error_us)
        return True

    def store(self, number: int, value: bytes, stamp_ns: int, error_us: int) -> None:
        """Put a value that fits, in the order of `failover.core.board.banks`, where none needs fences."""
        place, size = self.place, len(value)
        words = place.words
        head, stamped, sized, begin = self.heads[number % len(self.heads)]
        words[head] = 0
        words[stamped] = stamp_ns
        words[sized] = error_us << 32 | size
        place.area[begin : begin + size] = value
        words[head] = number
        words[place.newest] = number


class _Shape(Struct, frozen=True):
    """Where the values of a frame go, if they have these sizes and each goes into this one of its banks."""

    heads: tuple[int, ...]
    stamped: tuple[int, ...]
    sized: tuple[int, ...]
    values: tuple[slice, ...]


class _Memory:
    """How many places of values all plans of one robot remember."""

    __slots__ = ("places",)

    def __init__(self) -> None:
        self.places = 0


class _Plan:
    """The items of frames that are alike. While it is the one in use, it has the state of its slots (`enter`, `leave`)."""

    def __init__(self, slots: Sequence[Slot], memory: _Memory) -> None:
        self.slots, self._memory = slots, memory
        self.newest = tuple([slot.place.newest for slot in slots])
        self._least = tuple([slot.place.least for slot in slots])
        self._limits = tuple([slot.place.limit for slot in slots])
        self._fitting: tuple[int, ...] = ()
        self.cycle = math.lcm(*[len(slot.heads) for slot in slots])
        self._known: dict[tuple[int, ...], dict[tuple[int, tuple[int, ...]], _Shape]] = {}

    def enter(self, now_ns: int) -> None:
        """Take the state of the slots."""
        self.since_ns, self.frames, self.transit, self.round = now_ns, 0, 0, -1
        self.following = tuple([slot.following for slot in self.slots])
        self.last_numbers = tuple([slot.last_number for slot in self.slots])
        self.after = min([slot.after for slot in self.slots])
        self._shapes: dict[tuple[int, tuple[int, ...]], _Shape] | None = None
        self._step = 0

    def leave(self) -> None:
        """Give it back, and count the frames in the records."""
        if not self.frames:
            return
        for slot, following, last_number in zip(self.slots, self.following, self.last_numbers, strict=True):
            slot.following, slot.last_number, slot.last_round = following, last_number, self.round
            slot.count += self.frames
            slot.place.words[slot.record + FRAMES_FIELD // 8] = slot.count
            slot.place.words[slot.record + TRANSIT_FIELD // 8] = self.transit
        self.frames = 0

    def fit(self, sizes: tuple[int, ...]) -> bool:
        """Whether values of these sizes do."""
        if sizes != self._fitting:
            if not (all(map(le, self._least, sizes)) and all(map(le, sizes, self._limits))):
                return False
            self._fitting = sizes
        return True

    def put(self, values: Sequence[bytes], sizes: tuple[int, ...], stamps_ns: Sequence[int], error_us: int) -> None:
        """Put all values, each step for all of them before the next."""
        shape, place, following = self._shape(sizes), self.slots[0].place, self.following
        words = place.words
        _store(words, shape.heads, repeat(0))
        _store(words, shape.stamped, stamps_ns)
        _store(words, shape.sized, map(add, sizes, repeat(error_us << 32)))
        _store(place.area, shape.values, values)
        _store(words, shape.heads, following)
        _store(words, self.newest, following)
        self.following = tuple(map(add, following, repeat(1)))
        self._step = (self._step + 1) % self.cycle

    def put_some(self, which: Sequence[bool], values: Sequence[bytes], stamps_ns: Sequence[int], error_us: int) -> None:
        """Put some of the values; the items' banks are other ones then than a step further."""
        slots, following = self.slots, self.following
        for index in compress(range(len(which)), which):
            slots[index].store(following[index], values[index], stamps_ns[index], error_us)
        self.following = tuple(map(add, following, which))
        self._shapes = None

    def _shape(self, sizes: tuple[int, ...]) -> _Shape:
        """Where all values go, of these sizes."""
        if self._shapes is None:
            banks = tuple([number % len(slot.heads) for slot, number in zip(self.slots, self.following, strict=True)])
            self._shapes, self._step = self._known.setdefault(banks, {}), 0
        key = (self._step, sizes)
        if key not in self._shapes:
            self._memory.places += len(sizes)
            self._shapes[key] = self._made(sizes)
        return self._shapes[key]

    def _made(self, sizes: tuple[int, ...]) -> _Shape:
        banks = [slot.heads[number % len(slot.heads)] for slot, number in zip(self.slots, self.following, strict=True)]
        heads, stamped, sized, begins = zip(*banks, strict=True)
        values = tuple([slice(begin, begin + size) for begin, size in zip(begins, sizes, strict=True)])
        return _Shape(heads, stamped, sized, values)


class Reception:
    """The items of one robot's file, by their numbers."""

    def __init__(self, slots: Mapping[int, Slot]) -> None:
        self._slots = dict(slots)
        self._plans: dict[tuple[int, ...], _Plan | None] = {}
        self._plan: _Plan | None = None
        self._memory = _Memory()

    def add(self, number: int, slot: Slot) -> None:
        """There is one more."""
        self.remove(number)
        self._slots[number] = slot

    def remove(self, number: int) -> None:
        """An item is no more."""
        self._forget()
        self._slots.pop(number, None)

    def settle(self) -> None:
        """Have all records up to date: frames that were taken together are counted now."""
        plan, self._plan = self._plan, None
        if plan is not None:
            plan.leave()

    def _forget(self) -> None:
        """Find out anew where values go."""
        self.settle()
        self._plans, self._memory = {}, _Memory()

    def take(self, items: Sequence[Brought], came_ns: int, error_us: int, round_: int, missing: int) -> tuple[int, int, int]:
        """Put what a frame brought.

        Args:
            error_us: how much older the values may be than their ages and the instant of arrival say.
            missing: frames of the sender that did not come since the last one, see `ReceivedItems.take`.

        Returns:
            How many were put, how many are not known here, and how many have another size than declared.
        """
        if len(items) >= TOGETHER_MIN and not missing:
            together = self._take_together(items, came_ns, error_us, round_)
            if together is not None:
                return together, 0, 0
        if self._plan is not None:
            self.settle()
        known = self._slots.get
        puts = unknown = misfits = 0
        for item in items:
            slot = known(item.number)
            if slot is None:
                unknown += 1
                continue
            is_put = slot.take(item, came_ns, error_us, round_, missing)
            if is_put:
                puts += 1
            elif is_put is None:
                misfits += 1
        return puts, unknown, misfits

    def _take_together(self, items: Sequence[Brought], came_ns: int, error_us: int, round_: int) -> int | None:
        """Put those values that are newer, if all fit: how many; None: nothing was done."""
        numbers, ages_us, puts, values, *_ = zip(*map(_fields, items), strict=True)
        if self._memory.places > PLACES_MAX:
            self._forget()
        plan = self._plan
        if plan is None or self._plans.get(numbers) is not plan or came_ns - plan.since_ns > TOLD_NS:
            self.settle()
            plan = self._plan = self._planned(numbers)
            if plan is None:
                return None
            plan.enter(came_ns)
        oldest_us, sizes = max(ages_us), tuple(map(len, values))
        if not (oldest_us < AGE_MAX_US and oldest_us * NS_PER_US < came_ns and max(puts) < plan.after and plan.fit(sizes)):
            return None
        stamps_ns = [came_ns - age_us * NS_PER_US for age_us in ages_us]
        newer: tuple[bool, ...] = tuple(map(gt, puts, plan.last_numbers))
        if all(newer):
            plan.put(values, sizes, stamps_ns, error_us)
            plan.last_numbers = puts
        elif any(newer):
            plan.put_some(newer, values, stamps_ns, error_us)
            plan.last_numbers = tuple(map(max, puts, plan.last_numbers))
        plan.frames, plan.round, plan.transit = plan.frames + 1, round_, (round_ & LOW_HALF) << 32 | error_us
        return sum(newer)

    def _planned(self, numbers: tuple[int, ...]) -> _Plan | None:
        """How frames with these items are taken; None: one by one."""
        if numbers not in self._plans:
            if len(self._plans) >= PLANS_MAX:
                self._forget()
            slots = [self._slots[number] for number in numbers if number in self._slots]
            is_apt = len(slots) == len(set(numbers)) == len(numbers) and all(
                slot.fence is None and slot.place.words is slots[0].place.words for slot in slots
            )
            self._plans[numbers] = _Plan(slots, self._memory) if is_apt else None
        return self._plans[numbers]


_fields: Final[Callable[[Any], tuple[Any, ...]]] = astuple


def _store(target: Any, places: Iterable[Any], values: Iterable[Any]) -> None:
    """One store into each of the places, in their order: a loop that is not of Python's lines."""
    any(map(setitem, repeat(target), places, values))


def _end_of_epoch(number: int) -> int:
    """The first number of the epoch after that of this one."""
    return ((number >> EPOCH_SHIFT) + 1) << EPOCH_SHIFT
