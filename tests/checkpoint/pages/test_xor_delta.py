"""Deltas with pages as differences from what was acknowledged: they add up to the same, and their references are bounded."""

from __future__ import annotations

import os
import random
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from checkpoint.errors import ChainError, FormatError
from checkpoint.keeper import messages
from checkpoint.model import PageRun, Snapshot
from checkpoint.pages import page_set, xor_delta
from checkpoint.pages.page_set import Buffer, PageMap, PageTable, Words
from checkpoint.pages.xor_delta import Rows
from checkpoint.snapshot import format, layout
from checkpoint.snapshot.byte_sources import Source
from checkpoint.store import chain, verify
from checkpoint.store.base_on_disk import stored_base
from checkpoint.store.chain import applied
from checkpoint.store.page_lookup import pages_at
from checkpoint.store.store import open_store
from checkpoint.store.xor_cache import WHOLE_MAX, HotPages, Sender, Step
from checkpoint.store.xor_cache_budget import PageBudget
from failover.cli.keeper_client import Keeper
from tests.checkpoint.round_trip import at_last
from tests.checkpoint.snapshots import COMPONENT, PAGE, START, family, page, pages_of, runs_of, snapshot, vma

STEPS = st.lists(
    st.tuples(st.dictionaries(st.integers(0, 30), st.integers(0, 9), max_size=6), st.frozensets(st.integers(0, 30), max_size=6)),
    min_size=1,
    max_size=6,
)
ROOM = 1 << 20
SMALL = 4 * PAGE
LARGE = 48 << 20


def whole_chain(steps: Sequence[tuple[dict[int, int], frozenset[int]]]) -> list[Snapshot]:
    """A base of five pages, and a delta for each step: pages written, and pages that went before."""
    state = {number: page(f"base {number}") for number in range(5)}
    made = [snapshot(state)]
    for sequence, (written, cleared) in enumerate(steps, 2):
        carried = {number: page(f"{sequence} {value}") for number, value in written.items()}
        state = {number: content for number, content in state.items() if number not in cleared} | carried
        made.append(snapshot(state, carried=carried, cleared=cleared, parent=made[-1].position, sequence=sequence))
    return made


def as_told(whole: Sequence[Snapshot], limit: int = ROOM) -> list[Snapshot]:
    """What a sender makes of them, when each is acknowledged before the next."""
    sender = Sender()
    made = []
    for one in whole:
        made.append(sender.told(one, limit)[0])
        sender.acknowledge(one.position)
    return made


def taken_straight(files: Sequence[bytes], threads: int) -> dict[int, bytes]:
    """The pages, by number, that are taken out of a chain's files one by one; single bytes are asked for besides."""
    found: dict[int, bytes] = {}
    with stored_base(*files) as base:

        def take(row: Words, content: Buffer) -> None:
            for index, address in enumerate(page_set.addresses_of(row, PAGE).tolist()):
                assert (address - START) // PAGE not in found, "each once"
                found[(address - START) // PAGE] = bytes(memoryview(content)[index * PAGE :][:PAGE])

        base.each(take, threads)
        assert base.outline.runs == runs_of(found)
        for run in base.outline.runs:
            number, size = (run.start - START) // PAGE, min(run.size, 3 * PAGE) - 2
            expected = b"".join(found[number + index] for index in range(-(-size // PAGE)))[1 : size + 1]
            assert base.content_at(run.start + 1, size) == expected
            assert base.content_at(run.end - 1, 2) is None
    return found


@settings(max_examples=60, deadline=None)
@given(STEPS)
def test_what_is_taken_straight_from_a_chains_files_is_what_they_fold_to(
    steps: list[tuple[dict[int, int], frozenset[int]]],
) -> None:
    told = as_told(whole_chain(steps))
    files = [format.encode_bytes(one) for one in told]
    folded = chain.fold(told)
    assert taken_straight(files, 1) == pages_of(folded)
    with stored_base(*files) as base:
        assert base.outline == replace(folded, contents=b"")
        assert base.whole(1) == replace(folded, contents=base.whole(1).contents)


@pytest.mark.parametrize("threads", [1, 3])
def test_large_chains_are_taken_straight_by_several_threads(threads: int) -> None:
    dice, count = random.Random(3), 4000
    state = {number: dice.randbytes(PAGE) for number in range(count)}
    room = (vma(0, count + 100),)
    made = [snapshot(state, vmas=room)]
    for sequence in range(2, 6):
        gone = frozenset(dice.sample(sorted(state), 40))
        changed = {number: bytes([sequence]) + state[number][1:] for number in dice.sample(sorted(state), 300)}
        carried = changed | {count + sequence: page(f"new {sequence}")}
        state = {number: content for number, content in state.items() if number not in gone} | carried
        made.append(snapshot(state, carried=carried, cleared=gone, parent=made[-1].position, sequence=sequence, vmas=room))
    told = as_told(made, count * PAGE * 2)
    assert any(one.differences for one in told)
    assert taken_straight([format.encode_bytes(one) for one in told], threads) == state


def test_a_chain_that_does_not_add_up_is_refused_when_its_last_page_was_taken() -> None:
    told = as_told(busy())
    last = told[-1]
    wrong = replace(last, contents=bytes(last.contents[:-1]) + bytes([last.contents[-1] ^ 1]))
    files = [format.encode_bytes(one) for one in (*told[:-1], wrong)]
    with pytest.raises(ChainError, match="the pages do not add up"):
        taken_straight(files, 1)
    with pytest.raises(ChainError, match="continues"), stored_base(files[0], *files[2:]):
        pass


def busy(length: int = 4) -> list[Snapshot]:
    """Three pages that are written again and again, with ``length`` snapshots."""
    return whole_chain([({0: sequence % 10, 1: sequence % 7, 20: 5}, frozenset()) for sequence in range(length - 1)])


def files_of(told: Sequence[Snapshot], folder: Path) -> list[Path]:
    paths = []
    for one in told:
        paths.append(folder / f"{one.position.sequence}")
        paths[-1].write_bytes(format.encode_bytes(one))
    return paths


@settings(max_examples=60, deadline=None)
@given(STEPS, st.sampled_from([SMALL, ROOM]))
def test_differences_add_up_to_what_whole_pages_do(steps: list[tuple[dict[int, int], frozenset[int]]], limit: int) -> None:
    whole = whole_chain(steps)
    told = [format.decode(format.encode_bytes(one)) for one in as_told(whole, limit)]
    folded = chain.fold(told)
    assert pages_of(folded) == pages_of(chain.fold(whole))
    assert folded.differences == ()
    assert format.decode(format.encode_bytes(folded)).position == whole[-1].position


def test_what_is_written_again_is_told_as_a_difference_and_takes_less() -> None:
    whole = busy()
    told = as_told(whole)
    assert [one.differences for one in told[:2]] == [(), runs_of({0, 1})]  # page 20 is new
    assert told[2].differences == runs_of({0, 1, 20})
    assert format.encode_bytes(told[2])[8] == layout.VERSION + layout.DIFFERENCES


def test_processes_with_memory_in_common_add_up_to_the_same() -> None:
    whole = family(4)
    told = as_told([replace(whole[0], parent=None), *whole[1:]])
    assert any(one.differences for one in told)
    assert all(format.decode(format.encode_bytes(one)) == one for one in told)
    assert chain.fold(told).page_sum == whole[-1].page_sum


def test_a_delta_is_told_from_what_was_acknowledged_and_not_from_what_was_lost() -> None:
    base, first, *_ = busy(3)
    second = whole_chain([({0: 3}, frozenset())])[1]
    sender = Sender()
    sender.told(base, ROOM)
    sender.acknowledge(base.position)
    sender.told(first, ROOM)  # never arrives
    told, known = sender.told(second, ROOM)
    assert known == PAGE
    assert pages_of(chain.fold([base, told])) == pages_of(chain.fold([base, second]))


def test_a_robot_that_refuses_differences_gets_checkpoints_all_the_same_and_is_asked_more_and_more_seldom() -> None:
    sender, held = Sender(), whole_chain([])[0]
    told: list[bool] = []
    sender.told(held, ROOM)
    sender.acknowledge(held.position)
    for sequence in range(2, 1200):
        whole = snapshot({0: page(f"{sequence}")}, parent=held.position, sequence=sequence)
        told.append(bool(sender.told(whole, ROOM)[0].differences))
        if not told[-1]:
            sender.acknowledge(whole.position)
            held = whole
    assert told[:8] == [True, True, False, True, False, False, True, False]
    assert told[-600:].count(True) == 600 // (WHOLE_MAX + 1)
    while told[-1] is False:
        whole = snapshot({0: page("now")}, parent=held.position, sequence=held.position.sequence + 1)
        told.append(bool(sender.told(whole, ROOM)[0].differences))
        sender.acknowledge(whole.position)
        held = whole
    again = snapshot({0: page("new")}, parent=held.position, sequence=held.position.sequence + 1)
    assert sender.told(again, ROOM)[0].differences, "the same robot, with the release of today"


def test_nothing_is_told_as_a_difference_from_a_position_that_is_not_remembered() -> None:
    base, first, second = busy(3)
    sender = Sender()
    sender.told(base, ROOM)
    sender.told(first, ROOM)
    sender.acknowledge(base.position)  # of an earlier one than was told last
    assert sender.told(replace(second, parent=base.position), ROOM) == (replace(second, parent=base.position), 0)


def test_a_page_that_has_become_another_one_is_told_whole() -> None:
    noise = np.random.default_rng(1).bytes(PAGE)
    base = snapshot({0: page("text"), 1: page("text")})
    delta = snapshot({0: noise, 1: page("test")}, parent=base.position, sequence=2)
    assert as_told([base, delta])[1].differences == runs_of({1})


def test_a_large_delta_is_not_copied_for_few_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of gigabytes takes as much memory again, and longer than to send a few pages whole."""
    base = snapshot({number: page("before") for number in range(100)})
    delta = snapshot({number: page("behind") for number in range(100)}, parent=base.position, sequence=2)
    enough, too_few = (100 // xor_delta.FEW_SHARE + 1) * PAGE, 100 // xor_delta.FEW_SHARE * PAGE
    assert as_told([base, delta], too_few)[1].differences, "it is small"
    monkeypatch.setattr(xor_delta, "SMALL_SIZE", 10 * PAGE)
    assert as_told([base, delta], too_few)[1] is delta
    assert as_told([base, delta], enough)[1].differences


@settings(max_examples=60, deadline=None)
@given(STEPS, st.integers(1, 4), st.integers(1, 4))
def test_pages_that_come_in_pieces_are_resolved_as_all_together(
    steps: list[tuple[dict[int, int], frozenset[int]]], piece_count: int, held_count: int
) -> None:
    whole = whole_chain(steps)
    states = [chain.fold(whole[:count]) for count in range(1, len(whole))]
    asked: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(xor_delta, "HELD_SIZE", held_count * PAGE)
        for before, after, told in zip(states, whole[1:], as_told(whole)[1:], strict=True):

            def reference(wanted: Words, before: Snapshot = before) -> Rows:
                asked.append(len(wanted))
                pages = pages_of(before)
                found = [np.frombuffer(pages[(address - START) // PAGE], np.uint8) for address in wanted.tolist()]
                return np.array(found).reshape(-1, PAGE)

            raw = bytes(told.contents)
            pieces = [memoryview(bytearray(raw[at : at + piece_count * PAGE])) for at in range(0, len(raw), piece_count * PAGE)]
            assert b"".join(xor_delta.resolved_each(told, pieces, reference)) == bytes(after.contents)
    assert all(count <= max(piece_count, held_count) for count in asked)


def test_without_a_cache_every_page_is_told_whole() -> None:
    assert as_told(busy(), 0) == busy()


def test_hot_pages_take_no_more_than_their_limit_and_the_oldest_go_first() -> None:
    hot = HotPages(PAGE, SMALL)
    whole = whole_chain([({0: 1, 1: 1}, frozenset()), ({0: 2}, frozenset()), ({9: 1, 10: 1}, frozenset())])
    for one in whole:
        hot.advance(Step.of(one, SMALL))
        assert hot.size <= SMALL
    wanted = np.array([START + number * PAGE for number in (0, 1, 2, 3, 9, 10)], dtype=np.uint64)
    found, rows = hot.lookup(wanted)
    assert found.tolist() == [True, True, False, False, True, True]
    assert bytes(rows[0]) == page("3 2")


@given(STEPS)
def test_hot_pages_are_those_of_the_state_whatever_a_delta_tells(steps: list[tuple[dict[int, int], frozenset[int]]]) -> None:
    hot = HotPages(PAGE, ROOM)
    every = np.array([START + number * PAGE for number in range(31)], dtype=np.uint64)
    for until, one in enumerate(whole := whole_chain(steps), 1):
        hot.advance(Step.of(one, ROOM))
        held = pages_of(chain.fold(whole[:until]))
        found, rows = hot.lookup(every)
        assert np.flatnonzero(found).tolist() == sorted(held)
        assert [bytes(row) for row in rows] == [held[number] for number in sorted(held)]
        assert hot.size == len(held) * PAGE


def test_a_delta_of_known_pages_looks_at_no_other_page(monkeypatch: pytest.MonkeyPatch) -> None:
    hot = HotPages(PAGE, ROOM)
    base, again, more = whole_chain([({0: 1, 3: 1}, frozenset()), ({0: 2, 9: 2}, frozenset())])
    hot.advance(Step.of(base, ROOM))
    with monkeypatch.context() as patch:
        patch.setattr(PageMap, "without", None)
        hot.advance(Step.of(again, ROOM))
        with pytest.raises(TypeError):
            hot.advance(Step.of(more, ROOM))


def test_after_a_delta_that_was_missed_only_what_the_next_one_tells_is_known() -> None:
    hot = HotPages(PAGE, ROOM)
    base, _, third = whole_chain([({1: 1}, frozenset()), ({0: 1}, frozenset())])
    hot.advance(Step.of(base, ROOM))
    hot.advance(Step.of(third, ROOM))
    found, _ = hot.lookup(np.array([START, START + PAGE], dtype=np.uint64))
    assert found.tolist() == [True, False]


def test_a_page_that_two_processes_had_in_common_changes_in_one_of_them_alone() -> None:
    base = family(1)[0]
    assert base.copies
    changed = snapshot({0: page("both?"), 1: page("parent 1")}, parent=base.position, sequence=2)
    delta = replace(changed, members=base.members, zombies=base.zombies, runs=runs_of({0}), contents=page("both?"))
    table = applied(applied(PageTable.empty(PAGE), base, (base.contents,)), delta, (delta.contents,))
    delta = replace(delta, page_sum=table.page_sum)
    delta = replace(delta, position=chain.position_of(delta, 1, 2))
    told = as_told([base, delta])
    assert told[1].differences == runs_of({0})
    assert chain.fold(told).page_sum == delta.page_sum


def test_a_limit_beyond_all_memory_is_no_reason_to_ask_for_it() -> None:
    hot = HotPages(PAGE, 1 << 60)
    for one in whole_chain([(dict.fromkeys(range(30), 1), frozenset())]):
        hot.advance(Step.of(one, 1 << 60))
    assert hot.size == 30 * PAGE


def test_a_chain_of_files_answers_for_single_pages(tmp_path: Path) -> None:
    whole = busy(6)
    files = files_of(as_told(whole), tmp_path)
    held = pages_of(chain.fold(whole))
    wanted = np.array([START + number * PAGE for number in sorted(held)], dtype=np.uint64)
    assert [bytes(row) for row in pages_at(files, wanted, PAGE)] == [held[number] for number in sorted(held)]
    with pytest.raises(ChainError, match="holds the page"):
        pages_at(files, np.array([START + 40 * PAGE], dtype=np.uint64), PAGE)


def test_a_page_that_was_taken_away_is_no_answer(tmp_path: Path) -> None:
    files = files_of(whole_chain([({0: 1}, frozenset({1}))]), tmp_path)
    with pytest.raises(ChainError, match="holds no page"):
        pages_at(files, np.array([START + PAGE], dtype=np.uint64), PAGE)


@pytest.mark.parametrize("cache_size", [0, SMALL, ROOM])
def test_a_store_proves_differences_whatever_it_remembers_and_after_a_restart(tmp_path: Path, cache_size: int) -> None:
    whole = busy(8)
    files = files_of(as_told(whole), tmp_path)
    for some in (files[:3], files[3:5], files[5:]):
        store = open_store(tmp_path / "store", budget=PageBudget(cache_size))
        for path in some:
            with path.open("rb") as file:
                store.put(file.fileno())
        store.close()
    store = open_store(tmp_path / "store", budget=PageBudget(cache_size))
    assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(whole))
    store.fold(COMPONENT, whole[4].position)
    store.prune(COMPONENT, whole[4].position)
    assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(whole))
    store.close()


def large() -> list[Snapshot]:
    """A base and a delta, half of whose pages are told as differences."""
    noise, count = np.random.default_rng(1).bytes(LARGE), LARGE // PAGE
    state = {number: noise[number * PAGE : (number + 1) * PAGE] for number in range(count)}
    base = snapshot(state, vmas=(vma(0, count),))
    after = {number: content[:-1] + bytes([content[-1] ^ 1]) for number, content in state.items()}
    delta = snapshot(after, vmas=(vma(0, count),), parent=base.position, sequence=2)
    told = as_told([base, delta], LARGE // 2)
    assert page_set.total_size(page_set.extents(told[1].differences)) == LARGE // 2
    return told


def test_a_store_proves_a_large_snapshot_in_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A standby may have little memory to spare, and the pages of a snapshot may be gigabytes."""
    monkeypatch.setattr(xor_delta, "HELD_SIZE", 4 << 20)  # else the delta is to be far larger
    files, store = files_of(large(), tmp_path), open_store(tmp_path / "store", budget=PageBudget(0))
    tracemalloc.start()
    try:
        for path in files:
            with path.open("rb") as file:
                store.put(file.fileno())
        assert tracemalloc.get_traced_memory()[1] < LARGE // 2
    finally:
        tracemalloc.stop()
        store.close()


def test_a_store_reads_earlier_content_seldom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each time it reads what all files of the chain say of their pages: that takes longer than the pages themselves."""
    files, store = files_of(large(), tmp_path), open_store(tmp_path / "store", budget=PageBudget(0))
    asked: list[int] = []

    def noted(chain: Sequence[Source], wanted: Words, page_size: int) -> Rows:
        asked.append(len(wanted))
        return pages_at(chain, wanted, page_size)

    monkeypatch.setattr(verify, "pages_at", noted)
    for path in files:
        with path.open("rb") as file:
            store.put(file.fileno())
    assert asked == [LARGE // 2 // PAGE]
    store.close()


def test_a_store_takes_no_difference_that_leads_elsewhere(tmp_path: Path) -> None:
    told = as_told(busy(3))
    forged = bytearray(told[2].contents)
    forged[0] ^= 1
    files = files_of([*told[:2], replace(told[2], contents=bytes(forged))], tmp_path)
    store = open_store(tmp_path / "store")
    for path in files[:2]:
        with path.open("rb") as file:
            store.put(file.fileno())
    with files[2].open("rb") as file, pytest.raises(ChainError, match="do not add up"):
        store.put(file.fileno())
    files[2].write_bytes(format.encode_bytes(told[2]))
    with files[2].open("rb") as file:
        store.put(file.fileno())  # what was refused has spoilt nothing
    store.close()


def test_a_store_takes_no_difference_of_pages_of_another_size(tmp_path: Path) -> None:
    base = snapshot({number: page("base") for number in range(4)})
    delta = snapshot({number: page("next") for number in range(4)}, parent=base.position, sequence=2)
    stranger = replace(delta, machine=replace(delta.machine, page_size=4 * PAGE), differences=delta.runs)
    files = files_of([base, replace(stranger, position=chain.position_of(stranger, 1, 2))], tmp_path)
    store = open_store(tmp_path / "store")
    with files[0].open("rb") as file:
        store.put(file.fileno())
    with files[1].open("rb") as file, pytest.raises(ChainError, match="pages of 16384 bytes"):
        store.put(file.fileno())
    store.close()


def test_a_difference_from_a_page_that_is_not_there_is_refused() -> None:
    base, delta = whole_chain([({9: 1}, frozenset())])
    with pytest.raises(ChainError, match="difference"):
        chain.fold([base, replace(delta, differences=delta.runs)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parent": None}, "a base has nothing"),
        ({"differences": runs_of({30})}, "is not carried"),
        ({"cleared": runs_of({0})}, "is cleared, too"),
        ({"differences": (PageRun(START, START + 1),)}, "whole pages"),
        ({"differences": (*runs_of({1}), *runs_of({0}))}, "overlaps or comes before"),
    ],
)
def test_differences_that_cannot_be_are_refused(change: dict[str, object], words: str) -> None:
    told = as_told(busy(2))[1]
    with pytest.raises(FormatError, match=words):
        format.encode_bytes(replace(told, **change))  # type: ignore[arg-type]


def with_runs(told: Snapshot, table: bytes, version: int) -> bytes:
    """The file of a snapshot with another run table, sealed anew as a stranger would."""
    raw = format.encode_bytes(told)
    preamble = layout.Preamble.parse(raw[: layout.PREAMBLE_SIZE])
    bodies = [raw[one.offset : one.offset + one.stored_size] for one in preamble.sections]
    bodies[2] = table
    sections, offset = [], layout.PREAMBLE_SIZE
    for one, body in zip(preamble.sections, bodies, strict=True):
        own = one.kind is layout.SectionKind.RUNS
        codec, size = (layout.Codec.RAW, len(body)) if own else (one.codec, one.raw_size)
        sections.append(layout.Section(one.kind, codec, offset, len(body), size, layout.digest_of(body)))
        offset += len(body)
    return layout.Preamble(preamble.contents_size, tuple(sections), version).pack() + b"".join(bodies)


@pytest.mark.parametrize("count", [0, 2, 1 << 40])
def test_a_list_of_differences_that_is_cut_off_too_long_or_empty_is_refused(count: int) -> None:
    told = as_told(busy(2))[1]
    runs = b"".join(struct.pack("<QQ", run.start, run.end) for run in told.runs)
    table = struct.pack("<QQ", 0, len(told.runs)) + runs + struct.pack("<Q", count) + (runs[:16] if count else b"")
    with pytest.raises(FormatError, match=r"section runs|format version 3"):
        format.read_outline(with_runs(told, table, 3))


def test_a_version_that_is_not_known_is_refused_by_number() -> None:
    raw = bytearray(format.encode_bytes(as_told(busy(2))[1]))
    raw[8] = layout.VERSIONS[-1] + 1
    with pytest.raises(FormatError, match="format version 5: this program reads versions 1 to 4"):
        format.decode(bytes(raw))


def test_the_content_of_a_base_beyond_the_limit_is_not_held_on_to() -> None:
    base = whole_chain([])[0]
    step = Step.of(base, 2 * PAGE)
    assert len(step.rows) == 2
    assert not np.shares_memory(step.rows, np.frombuffer(base.contents, np.uint8))
    assert page_set.total_size(step.gone) == 5 * PAGE


REWRITING = """
import sys
table = {number: [number, str(number) * 8] for number in range(20000)}
print("ready", flush=True)
turn = 0
for line in sys.stdin:
    turn += 1
    for number in range(0, 20000, 100):
        table[number][0] = turn
    print("done", flush=True)
"""


def captured(keeper: Keeper, sequence: int, cache: int) -> tuple[messages.Captured, Snapshot]:
    """One snapshot of what a keeper follows, acknowledged."""
    order = messages.Capture(sequence == 1, 1, sequence, xor_cache=cache)
    answer, (content,) = at_last(lambda: keeper.ask(order, messages.Captured))
    keeper._link.send(messages.Acknowledge(answer.position))
    try:
        return answer, format.decode(content)
    finally:
        os.close(content)


@pytest.mark.parametrize("cache", [0, 64 << 20])
def test_a_keeper_tells_what_a_python_program_has_written_again_in_a_tenth_of_its_bytes(cache: int) -> None:
    command = [sys.executable, "-S", "-c", REWRITING]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdin
        assert program.stdout
        try:
            assert program.stdout.readline() == "ready\n"
            with Keeper.spawn() as keeper:
                keeper.ask(messages.Protect(program.pid, COMPONENT), messages.Protected)
                answer, base = captured(keeper, 1, cache)
                told = [base]
                for sequence in (2, 3):
                    program.stdin.write("again\n")
                    program.stdin.flush()
                    assert program.stdout.readline() == "done\n"
                    answer, delta = captured(keeper, sequence, cache)
                    told.append(delta)
                keeper.ask(messages.Release(), messages.Released)
        finally:
            program.kill()
    folded = chain.fold(told)  # proves itself by its page sum
    assert folded.position == told[-1].position
    assert bool(told[-1].differences) == bool(answer.known_bytes) == bool(cache)
    assert (answer.size < answer.dirty_bytes / 10) == bool(cache)
