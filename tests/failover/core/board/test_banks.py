"""No get ever mixes two puts: every interleaving of three puts and a get, word by word, of the very functions that programs run.

A put only stores and a get only loads, so an interleaving is, for each load of the get, how many stores of the puts came before
it. The stores are recorded once; then the get runs once for each way to place its loads among them. Only loads that can see
different words are told apart: a load sees one of the words that its address ever had, at the earliest instant at which it had
it. A later instant with the same word leaves fewer ways for the loads that follow, and none that are new.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from failover.core.board import banks
from failover.core.board.banks import Found, Place, Reading, get_carefully, put_carefully, reader, writer
from failover.core.board.reception import Reception, Slot
from failover.core.frames.frame import Portion
from failover.errors import BoardError, NeverWrittenError, OvertakenError

PUTS = 3
VALUE_WORDS = 3
VALUE_SIZE = 8 * VALUE_WORDS
NEWEST, WAKE, RECORD, APART = 3, 200, 1000, 10_000
BANK_WORDS = 4 + VALUE_WORDS + 1
FIRST_BANK = 8

Store = tuple[int, int]
"""Index of a word, and what it becomes."""


class Memory:
    """Words that say what is done to them, and to whose slices of bytes the same rules hold as to words."""

    def __init__(self) -> None:
        self.stores: list[Store] = []
        self.content = {2: 4}
        self.order = list(range(VALUE_WORDS))

    def store(self, index: int, word: int) -> None:
        self.stores.append((index, word))
        self.content[index] = word

    def load(self, index: int) -> int:
        return self.content.get(index, 0)

    def __getitem__(self, index: int) -> int:
        return self.load(index)

    def __setitem__(self, index: int, word: int) -> None:
        self.store(index, word)


class Bytes:
    """The same memory by slices; words of a slice are copied in the memory's order, which need not be theirs."""

    def __init__(self, memory: Memory) -> None:
        self.memory = memory

    def __getitem__(self, place: slice) -> bytes:
        first, count = place.start // 8, (place.stop - place.start) // 8
        words = {index: self.memory.load(first + index) for index in self.memory.order if index < count}
        return b"".join(words[index].to_bytes(8, "little") for index in range(count))

    def __setitem__(self, place: slice, content: bytes) -> None:
        first = place.start // 8
        for index in self.memory.order:
            self.memory.store(first + index, int.from_bytes(content[8 * index : 8 * index + 8], "little"))


class Seen(Memory):
    """The memory as one get sees it: each of its loads chooses how many stores came before."""

    def __init__(self, stores: list[Store], choices: list[int], order: list[int]) -> None:
        super().__init__()
        self.order = order
        self.versions: dict[int, list[tuple[int, int]]] = {}
        for time, (index, word) in enumerate(stores, 1):
            self.versions.setdefault(index, [(0, 0)]).append((time, word))
        self.versions[2] = [(0, 4)]
        self.choices = choices
        self.made = 0
        self.open: list[int] = []
        self.now = 0

    def load(self, index: int) -> int:
        versions = self.versions.get(index, [(0, 0)])
        current = max(place for place, (time, _) in enumerate(versions) if time <= self.now)
        later = versions[current:]
        choice = self.choices[self.made] if self.made < len(self.choices) else 0
        if self.made >= len(self.choices):
            self.choices.append(0)
        self.open.append(len(later))
        self.made += 1
        time, word = later[choice]
        self.now = max(self.now, time)
        return word


def place_in(memory: Memory, at: int = 0) -> Place:
    offsets = tuple(8 * (at + FIRST_BANK + bank * BANK_WORDS) for bank in range(2))
    return Place(memory, Bytes(memory), memory, offsets, 0, VALUE_SIZE, at + NEWEST, 0, at + WAKE)


def value_of(number: int) -> bytes:
    """Every word of a value says its put."""
    return b"".join((number * 1000 + index).to_bytes(8, "little") for index in range(VALUE_WORDS))


def plain_puts(memory: Memory) -> None:
    for number in range(1, PUTS + 1):
        put_carefully(place_in(memory), number, value_of(number), number * 100)


def fast_puts(memory: Memory) -> None:
    now = itertools.count(100, 100)
    made = writer(place_in(memory), 0, lambda _: next(now), 0, _never, _never)
    made.remember(4)
    for number in range(1, PUTS + 1):
        made.put(value_of(number))


def received_puts(memory: Memory) -> None:
    slot = Slot(place_in(memory), RECORD, 1)
    forget_sums(memory)
    for number in range(1, PUTS + 1):
        assert slot.take(Portion(0, 0, number, value_of(number)), number * 100, 0, number, 0)
    memory.stores = [store for store in memory.stores if store[0] < RECORD]


def received_puts_together(memory: Memory) -> None:
    """With those of other items, which lie elsewhere."""
    reception = Reception({number: Slot(place_in(memory, number * APART), RECORD + number * APART, 1) for number in range(3)})
    forget_sums(memory)
    for number in range(1, PUTS + 1):
        items = [Portion(one, 0, number, value_of(number)) for one in range(3)]
        assert reception.take(items, number * 100, 0, number, 0) == (3, 0, 0)
    assert reception._plan is not None and reception._plan.frames == PUTS
    memory.stores = [store for store in memory.stores if store[0] < APART]


def forget_sums(memory: Memory) -> None:
    """The stores that are made once and for all."""
    for bank in range(2):
        assert memory.stores[bank] == (FIRST_BANK + bank * BANK_WORDS + banks.SUM_WORD, 0)
    memory.stores.clear()


def plain_get(memory: Memory) -> tuple[bytes, int, int]:
    found: Found = get_carefully(place_in(memory), retries=2)
    return found.value, found.stamp_ns, found.number


def fast_get(memory: Memory) -> tuple[bytes, int, int]:
    get, remember = reader(place_in(memory), lambda _: 10_000, 0, "robot1", None, 0, False, _overtaken)
    remember(4)
    reading: Reading = get()
    return reading.value, 10_000 - reading.age_ns, reading.number


def _never(*_: Any) -> None:
    raise AssertionError("the slow way was taken")


def _overtaken(_: str | None) -> Reading:
    raise OvertakenError("")


def stores_of(puts: Callable[[Memory], None], order: list[int]) -> list[Store]:
    memory = Memory()
    memory.order = order
    puts(memory)
    return memory.stores


def outcomes(
    stores: list[Store], get: Callable[[Memory], tuple[bytes, int, int]], order: list[int]
) -> Iterator[tuple[bytes, int, int] | type[BoardError]]:
    """What the get returns or raises, for every way to place its loads among the stores."""
    choices: list[int] = []
    while True:
        memory = Seen(stores, choices, order)
        try:
            yield get(memory)
        except (NeverWrittenError, OvertakenError) as error:
            yield type(error)
        del choices[memory.made :]
        while choices and choices[-1] + 1 >= memory.open[len(choices) - 1]:
            choices.pop()
        if not choices:
            return
        choices[-1] += 1


def is_whole(outcome: tuple[bytes, int, int] | type[BoardError]) -> bool:
    if isinstance(outcome, type):
        return True
    value, stamp_ns, number = outcome
    return value == value_of(number) and stamp_ns == number * 100 and 1 <= number <= PUTS


PUT_FORMS = pytest.mark.parametrize("puts", [plain_puts, fast_puts, received_puts, received_puts_together])
GET_FORMS = pytest.mark.parametrize("get", [plain_get, fast_get])
ORDERS = [list(order) for order in itertools.permutations(range(VALUE_WORDS))]


@PUT_FORMS
@GET_FORMS
def test_no_interleaving_mixes_two_puts(puts: Callable[[Memory], None], get: Any) -> None:
    counted = 0
    seen = set()
    for outcome in outcomes(stores_of(puts, ORDERS[0]), get, ORDERS[0]):
        counted += 1
        seen.add(outcome)
        assert is_whole(outcome)
    assert counted > 50
    assert {outcome[2] for outcome in seen if not isinstance(outcome, type)} == {1, 2, 3}  # each put is seen in some interleaving
    assert seen & {NeverWrittenError, OvertakenError}  # before the first put; or, of the fast form, whenever it gives up


@PUT_FORMS
@GET_FORMS
def test_nor_with_the_words_of_the_copies_in_another_order(puts: Callable[[Memory], None], get: Any) -> None:
    for written, read in itertools.product(ORDERS, ORDERS):
        assert all(is_whole(outcome) for outcome in outcomes(stores_of(puts, written), get, read))


@PUT_FORMS
@GET_FORMS
def test_without_the_zeroing_two_puts_are_mixed(puts: Callable[[Memory], None], get: Any) -> None:
    """The check of this file's checks: the same search finds mixed values as soon as the protocol lacks its first step."""
    numbers = {FIRST_BANK, FIRST_BANK + BANK_WORDS}
    stores = [store for store in stores_of(puts, ORDERS[0]) if not (store[0] in numbers and store[1] == 0)]
    assert len(stores) == len(stores_of(puts, ORDERS[0])) - PUTS
    assert not all(is_whole(outcome) for outcome in outcomes(stores, get, ORDERS[0]))


@PUT_FORMS
@pytest.mark.parametrize("word", range(VALUE_WORDS))
def test_one_word_of_the_copy_stored_after_its_put_was_named_is_mixed(puts: Callable[[Memory], None], word: int) -> None:
    """So a processor that reorders needs the fences, and the search sees what they prevent."""
    stores = stores_of(puts, ORDERS[0])
    bank = FIRST_BANK + BANK_WORDS  # of puts 1 and 3
    late = next(place for place, (index, _) in enumerate(stores) if index == bank + 4 + word)
    named = stores.index((NEWEST, 1))
    stores.insert(named, stores.pop(late))  # behind it, now that the earlier one is out
    assert not all(is_whole(outcome) for outcome in outcomes(stores, plain_get, ORDERS[0]))


@pytest.mark.parametrize("word", range(VALUE_WORDS))
def test_and_the_sum_sees_that_where_it_is_written(word: int) -> None:
    def puts(memory: Memory) -> None:
        for number in range(1, PUTS + 1):
            put_carefully(place_in(memory), number, value_of(number), number * 100, fence=lambda: None)

    stores = stores_of(puts, ORDERS[0])
    for bank, number in ((FIRST_BANK + BANK_WORDS, 1), (FIRST_BANK, 2), (FIRST_BANK + BANK_WORDS, 3)):
        late = stores.index((bank + 4 + word, number * 1000 + word))
        stores.insert(stores.index((NEWEST, number)), stores.pop(late))
    assert all(is_whole(outcome) for outcome in outcomes(stores, plain_get, ORDERS[0]))


def test_a_writer_killed_after_any_store_leaves_the_newest_put_whole_and_another_goes_on() -> None:
    stores = stores_of(fast_puts, ORDERS[0])
    for killed in range(len(stores) + 1):
        memory = Memory()
        for index, word in stores[:killed]:
            memory.store(index, word)
        newest = memory.load(NEWEST)
        if newest:
            assert plain_get(memory) == (value_of(newest), newest * 100, newest)
        else:
            with pytest.raises(NeverWrittenError):
                plain_get(memory)
        put_carefully(place_in(memory), newest + 1, value_of(newest + 1), (newest + 1) * 100)
        assert plain_get(memory)[2] == newest + 1


def test_a_size_beyond_the_item_is_damage_and_nothing_is_copied_behind_it() -> None:
    memory = Memory()
    fast_puts(memory)
    memory.store(FIRST_BANK + BANK_WORDS + banks.SIZE_WORD, VALUE_SIZE + 8)
    with pytest.raises(BoardError, match="damaged"):
        plain_get(memory)
    with pytest.raises(OvertakenError):  # the fast form leaves it to the plain one
        fast_get(memory)


def test_the_first_put_of_an_epoch_is_above_all_and_leaves_the_bank_that_is_read() -> None:
    shift = banks.EPOCH_SHIFT
    for count, epoch, newest in itertools.product((2, 3, 8), (0, 1, 5), (0, 1, 2, 7, (5 << shift) + 9)):
        number = banks.first_of_epoch(newest, epoch, count)
        assert max(newest, epoch << shift) < number <= max(newest, epoch << shift) + 2
        assert newest == 0 or number % count != newest % count
