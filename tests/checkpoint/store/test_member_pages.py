"""The pages of each of several processes, from a snapshot that holds each content once: the same as put together for each."""

from __future__ import annotations

import random
import threading

import numpy as np
import pytest
from msgspec.structs import replace

from checkpoint.model import PageRun, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, Words
from checkpoint.snapshot import process_tree
from checkpoint.store import chain, member_pages
from checkpoint.store.member_pages import MemberPages
from tests.checkpoint.snapshots import PAGE, START, family, page, pages_of, runs_of, snapshot, vma


def common(count: int, seed: int) -> Snapshot:
    """A base of a parent and a child that have some pages in common, some of them again and again, with gaps between them."""
    chance = random.Random(seed)
    contents = [page(f"content {number}") for number in range(max(count // 3, 1))]
    whole = process_tree.expanded(family(1)[0])
    states = [{number: chance.choice(contents) for number in range(2 * count) if chance.random() < 0.6} for _ in range(2)]
    runs = (*runs_of(states[0]), *process_tree.shifted_runs(runs_of(states[1]), 1))
    bytes_of_all = b"".join(state[number] for state in states for number in sorted(state))
    vmas = (vma(0, 2 * count),)
    told, held, copies = process_tree.told_once(runs, memoryview(bytes_of_all), PAGE)
    whole = replace(whole, runs=told, contents=bytes(held), copies=copies, vmas=vmas)
    return replace(whole, members=(replace(whole.members[0], vmas=vmas),))


def taken(one: MemberPages, threads: int) -> dict[int, bytes]:
    """All pages, by address."""
    found: dict[int, bytes] = {}
    lock = threading.Lock()

    def take(extents: Words, content: Buffer) -> None:
        rows = np.frombuffer(content, np.uint8).reshape(-1, PAGE)
        with lock:
            for address, row in zip(page_set.addresses_of(extents, PAGE).tolist(), rows, strict=True):
                assert address not in found, "taken twice"
                found[address] = row.tobytes()

    one.each(take, threads)
    return found


def wanted(view: Snapshot) -> dict[int, bytes]:
    return {START + number * PAGE: content for number, content in pages_of(view).items()}


@pytest.fixture(params=[1, 3], ids=["one thread", "three threads"])
def threads(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(member_pages, "PIECE_SIZE", 7 * PAGE)


@pytest.mark.usefixtures("small_pieces")
@pytest.mark.parametrize("seed", range(5))
def test_each_process_is_given_its_own_pages(seed: int, threads: int) -> None:
    whole = common(100, seed)
    assert whole.copies
    views, sources = member_pages.apart(whole)
    for view, source, told in zip(views, sources, process_tree.views(whole), strict=True):
        assert source is not None
        assert (view.runs, bytes(view.contents)) == (told.runs, b"")
        assert view.vmas == told.vmas
        assert taken(source, threads) == wanted(told)


@pytest.mark.usefixtures("small_pieces")
@pytest.mark.parametrize("seed", range(3))
def test_what_is_not_wanted_is_not_put_together(seed: int, threads: int) -> None:
    whole, chance = common(100, seed), random.Random(seed)
    runs = [PageRun(START + number * PAGE, START + (number + 1) * PAGE) for number in range(200) if chance.random() < 0.5]
    some = page_set.extents(runs)
    for source, told in zip(member_pages.apart(whole)[1], process_tree.views(whole), strict=True):
        assert source is not None
        kept = {at: content for at, content in wanted(told).items() if any(run.start <= at < run.end for run in runs)}
        assert taken(source.within(some), threads) == kept
        assert taken(source.within(some[:0]), threads) == {}
        assert taken(source.within(page_set.extents([PageRun(0, START * 2)])), threads) == wanted(told)


def test_bytes_and_rows_of_a_process_are_its_own() -> None:
    whole = common(40, 1)
    for view, source, told in zip(*member_pages.apart(whole), process_tree.views(whole), strict=True):
        assert source is not None
        content, position = bytes(told.contents), 0
        for run in view.runs:
            for address, size in ((run.start, 8), (run.end - 8, 8), (run.start, run.size), (run.start + 3, run.size - 5)):
                begin = position + address - run.start
                assert source.content_at(address, size) == content[begin : begin + size]
            assert source.content_at(run.end - 4, 8) is None
            position += run.size
        some = np.array([3, 0, 3], dtype=np.intp)
        assert source.rows_at(some).tobytes() == b"".join(content[at * PAGE : (at + 1) * PAGE] for at in some.tolist())


def test_what_has_nothing_in_common_keeps_its_bytes() -> None:
    alone = snapshot({0: page("alone"), 5: page("other")})
    (view,), sources = member_pages.apart(alone)
    assert sources == (None,)
    assert pages_of(view) == pages_of(alone)


def test_an_outline_has_no_pages_to_be_given() -> None:
    folded = replace(chain.fold(family(1)), contents=b"")
    views, sources = member_pages.apart(folded)
    assert sources == (None, None)
    assert not any(len(view.contents) for view in views)
