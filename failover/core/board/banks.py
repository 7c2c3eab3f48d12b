"""The order of the stores of a put and of the loads of a get: why no process waits, and none ever reads two puts mixed.

An item has two or more banks. Put n writes bank n mod banks: it sets the bank's number to 0 first and to n last, and then names
n as the newest. Get reads the newest number, copies that bank and looks at the number again: if it is still n, all that was
copied is put n's. A writer that is killed anywhere leaves the newest bank whole. BOARD.md has the argument;
tests/failover/core/board/test_banks.py tries all interleavings of these very functions.

`writer` and `reader` are for processors on which other processors see stores in their order (x86-64): bound closures with every
constant at hand, because a put or get of 379 bytes is to take less than a microsecond. `put_carefully` and `get_carefully` say
the same once more in the plain form: with fences and sums for processors that reorder, and with retries.

Nothing here knows where the words are: ``words[i]`` is the file's i-th word of eight bytes, ``area[a:b]`` its bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol

import xxhash
from msgspec import Struct

from failover.core.board.ages import NO_ERROR_BOUND, NS_PER_US
from failover.core.board.layout import (
    BANK_HEAD,
    FORMULA_FIELD,
    GENERATION_AT,
    NEWEST_FIELD,
    NUMBER_WORD,
    SIZE_WORD,
    STAMP_WORD,
    STRUCT,
    SUM_WORD,
    WAITERS_FIELD,
    Record,
)
from failover.errors import BoardError, NeverWrittenError, OvertakenError, ValueMisfitError

RETRIES: Final = 16
"""Of a get: one that is overtaken so often will be overtaken again."""

GENERATION: Final = GENERATION_AT // 8
LOW_HALF: Final = 0xFFFF_FFFF
EPOCH_SHIFT: Final = 40
"""Numbers of a copy that runs under epoch e begin above e × 2⁴⁰: a million puts a second reach the next in twelve days."""

NO_ERROR_NS: Final = NO_ERROR_BOUND * NS_PER_US
CLOCK_BOOTTIME: Final = 7
"""Source: clock_gettime(2), linux/time.h."""


class Words(Protocol):
    """The words of a file."""

    def __getitem__(self, index: int, /) -> int: ...
    def __setitem__(self, index: int, word: int, /) -> None: ...


class Area(Protocol):
    """The bytes of a file, by slices only."""

    def __getitem__(self, place: slice, /) -> bytes: ...
    def __setitem__(self, place: slice, content: Any, /) -> None: ...


Clock = Callable[[int], int]
"""Of a kernel's clock's number: nanoseconds."""
Fence = Callable[[], None]
"""Loads and stores before it happen, for other processors too, before those after it."""


class Place(Struct, frozen=True):
    """Where an item lies in a mapped file.

    Attributes:
        halves: the file's words of two bytes: one of them says whether a process waits.
        banks: offset of each.
        least, limit: bytes of a value; of a struct they are the same.
        newest, formula: indexes of words.
        wake: index of a word of two bytes.
    """

    words: Words
    area: Area
    halves: Words
    banks: tuple[int, ...]
    least: int
    limit: int
    newest: int
    formula: int
    wake: int


class Found(Struct, frozen=True, gc=False):
    """The whole content of a bank."""

    value: bytes
    stamp_ns: int
    error_us: int
    number: int


class Reading(Struct, frozen=True, gc=False):
    """The result of a get.

    Attributes:
        value: as the item's type says.
        age_ns: since the value was produced, at least.
        age_max_ns: at most; `UNBOUNDED_NS` where that is not known.
        robot: the robot that wrote it.
        number: of the put; to be given to `wait`.
        stale: it may be older than the item's bound.
    """

    value: Any
    age_ns: int
    age_max_ns: int
    robot: str
    number: int
    stale: bool


def first_of_epoch(newest: int, epoch: int, banks: int) -> int:
    """The number of the first put under an epoch: above all of earlier ones, and not in the bank of the newest put.

    That bank is read while the first put is under way, and holds the value if its writer is killed.
    """
    number = max(newest, epoch << EPOCH_SHIFT) + 1
    return number + (newest != 0 and number % banks == newest % banks)


def place_of(record: Record, words: Words, area: Area, halves: Words) -> Place:
    """An item's place in a mapped file."""
    banks = tuple(record.offset + index * record.stride for index in range(record.banks))
    at = record.at
    return Place(
        *(words, area, halves, banks, record.size if record.kind == STRUCT else 0, record.size),
        *((at + NEWEST_FIELD) // 8, (at + FORMULA_FIELD) // 8, (at + WAITERS_FIELD) // 2),
    )


def sum_of(value: bytes, stamp_ns: int, number: int) -> int:
    """The sum that a bank must have, if it is not 0."""
    return xxhash.xxh3_64_intdigest(value) ^ stamp_ns ^ number


# --- The plain form --------------------------------------------------------------------------------------------------


def put_carefully(place: Place, number: int, value: bytes, stamp_ns: int, error_us: int = 0, fence: Fence | None = None) -> None:
    """Put ``number``, which is above the newest, by the only writer of this item.

    Args:
        fence: on a processor that reorders. With one, the sum is written too.
    """
    words, bank = place.words, place.banks[number % len(place.banks)]
    word = bank // 8
    words[word + NUMBER_WORD] = 0
    if fence is not None:
        fence()
    words[word + STAMP_WORD] = stamp_ns
    words[word + SUM_WORD] = 0 if fence is None else sum_of(value, stamp_ns, number)
    words[word + SIZE_WORD] = error_us << 32 | len(value)
    place.area[bank + BANK_HEAD : bank + BANK_HEAD + len(value)] = value
    if fence is not None:
        fence()
    words[word + NUMBER_WORD] = number
    if fence is not None:
        fence()
    words[place.newest] = number


def get_carefully(place: Place, fence: Fence | None = None, retries: int = RETRIES) -> Found:
    """The newest put, whole.

    Raises:
        NeverWrittenError: there was none.
        OvertakenError: it was written ``retries`` times while it was read.
        BoardError: the bank says a size above the declared one.
    """
    words = place.words
    for _ in range(retries):
        number = words[place.newest]
        if number == 0:
            raise NeverWrittenError("it was never written: start its writer, or try again later")
        if fence is not None:
            fence()
        bank = place.banks[number % len(place.banks)]
        word = bank // 8
        said = words[word + SIZE_WORD]
        size = said & LOW_HALF
        stamp_ns, total = words[word + STAMP_WORD], words[word + SUM_WORD]
        value = place.area[bank + BANK_HEAD : bank + BANK_HEAD + min(size, place.limit)]
        if fence is not None:
            fence()
        if words[word + NUMBER_WORD] != number:
            continue
        if not place.least <= size <= place.limit:
            raise BoardError(
                f"damaged: a value of {size} bytes where {place.least} to {place.limit} are possible; its writer must put it anew"
            )
        if total == 0 or total == sum_of(value, stamp_ns, number):
            return Found(value, stamp_ns, said >> 32, number)
    raise OvertakenError(
        f"it was written {retries} times while it was read, or by two at once: {place.limit} bytes; give it more banks than "
        f"{len(place.banks)}, or put less often"
    )


# --- The fast form ---------------------------------------------------------------------------------------------------


def bank_words(place: Place) -> tuple[tuple[int, int, int, int], ...]:
    """Of each bank the indexes of the words of its number, its stamp and its size, and the offset of its value."""
    return tuple((at // 8, at // 8 + STAMP_WORD, at // 8 + SIZE_WORD, at + BANK_HEAD) for at in place.banks)


Put = Callable[..., None]
"""``(value, at=None)``"""
Get = Callable[..., Reading]
"""``(robot=None)``"""
Remember = Callable[[int], None]
"""Tells a closure which generation its file has now; `UNKNOWN`: each call goes the slow way."""
UNKNOWN: Final = -1

UNFIT: Final = (TypeError, ValueError, IndexError)
"""The exceptions for a value that is no bytes, or not as many bytes as it has elements."""


class Writer(Struct, frozen=True):
    """The put of bytes by the only writer of an item.

    Attributes:
        put: ``(value, at=None)``, fast; goes the slow way when the generation differs, the value is too large, is not of bytes,
            or told with its instant, and while another thread puts this item.
        store: ``(value, stamp_ns, error_us)``, without a look at the generation; False while another put of it is under way.
    """

    put: Put
    store: Callable[[bytes, int, int], bool]
    remember: Remember


def writer(
    place: Place,
    number: int,
    clock: Clock,
    skew_ns: int,
    slow: Put,
    woken: Callable[[int], None],
    always_wake: bool = False,
    fence: Fence | None = None,
) -> Writer:
    """Both forms of put; they share the count of puts, and see each other's turns.

    ``busy`` is examined and set without a call in between: there CPython neither changes threads nor runs a signal's function.
    (A lock would do the same for a quarter of a microsecond more.)

    Args:
        number: of the newest put, or the one that the first one is to come after.
        skew_ns: by how much this process's CLOCK_BOOTTIME is ahead of the machine's.
        slow: is called in place of ``put``.
        woken: wakes those that wait; is given the stamp.
        always_wake: readers cannot say that they wait.
    """
    words, area, halves, banks = place.words, place.area, place.halves, bank_words(place)
    limit, newest, wake, count = place.limit, place.newest, place.wake, len(place.banks)
    generation = UNKNOWN
    busy = False
    for head, *_ in banks if fence is None else ():
        words[head + SUM_WORD] = 0  # none is needed: once and for all

    def put(value: Any, at: int | None = None) -> None:
        """Put a value; ``at``: nanoseconds of CLOCK_BOOTTIME at which it was produced, unless that is now."""
        nonlocal number, busy
        try:
            size = len(value)
            if words[2] != generation or size > limit or at is not None or busy:
                return slow(value, at)
            busy = True
            try:
                following = number + 1
                head, stamped, sized, begin = banks[following % count]
                words[head] = 0
                words[stamped] = stamp = clock(7) - skew_ns
                words[sized] = size
                area[begin : begin + size] = value
                words[head] = following
                words[newest] = number = following
                if halves[wake] or always_wake:
                    woken(stamp)
            finally:
                busy = False
        except UNFIT:
            return slow(value, at)

    def store(value: bytes, stamp_ns: int, error_us: int) -> bool:
        nonlocal number, busy
        if busy:
            return False
        busy = True
        try:
            put_carefully(place, number + 1, value, stamp_ns, error_us, fence)
            number += 1
            if halves[wake] or always_wake:
                woken(stamp_ns)
        finally:
            busy = False
        return True

    def remember(new: int) -> None:
        nonlocal generation
        generation = new

    return Writer(put, store, remember)


def reader(
    place: Place,
    clock: Clock,
    skew_ns: int,
    robot: str,
    unpack: Callable[[bytes], Any] | None,
    bound_ns: int,
    is_received: bool,
    slow: Get,
) -> tuple[Get, Remember]:
    """The get of one robot's item on a processor that keeps the order of loads.

    Args:
        robot: whose item it is.
        unpack: bytes to a value; None: the bytes themselves.
        bound_ns: as declared; 0: none is, and if the item ``is_received`` from another robot its word says it.
        slow: is called instead, with the robot that the caller named: when the generation differs, a robot is named, the
            item was never written or is overtaken, its value does not unpack, or no bound of its error is known.
    """
    words, area, banks = place.words, place.area, bank_words(place)
    least, limit, newest, count = place.least, place.limit, place.newest, len(place.banks)
    learned = 0 if bound_ns or not is_received else place.formula
    bounded = bool(bound_ns or learned)
    generation = UNKNOWN

    def get(of: str | None = None) -> Reading:
        """The newest value of this robot, or of the robot that is named."""
        if of is not None or words[2] != generation:
            return slow(of)
        number = words[newest]
        head, stamped, sized, begin = banks[number % count]
        size, error_ns = words[sized], 0
        if size > limit:
            size, error_ns = size & LOW_HALF, (size >> 32) * NS_PER_US
            if size > limit or error_ns >= NO_ERROR_NS:
                return slow(of)
        stamp = words[stamped]
        value: Any = area[begin : begin + size]
        if words[head] != number or not number or size < least:
            return slow(of)
        if unpack is not None:
            try:
                value = unpack(value)
            except ValueMisfitError:
                return slow(of)
        age = clock(7) - skew_ns - stamp
        if not error_ns and not bounded:
            return Reading(value, age, age, robot, number, False)
        age_max = age + error_ns
        bound = words[learned] if learned else bound_ns
        return Reading(value, age, age_max, robot, number, 0 < bound < age_max)

    def remember(new: int) -> None:
        nonlocal generation
        generation = new

    return get, remember
