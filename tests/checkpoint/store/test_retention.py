"""Snapshots that a store keeps for people: spread over a span, bounded by number, age, size, never at the cost of needed ones."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.store.retention import HISTORY_FOLDER, Retention
from checkpoint.store.store import Store, open_store
from tests.checkpoint.snapshots import COMPONENT, page, pages_of, snapshot
from tests.checkpoint.store.test_store import put

MANY = Retention(count=10, span_s=1_000_000)


@contextmanager
def opened(root: Path, retention: Retention) -> Iterator[Store]:
    store = open_store(root, None, retention)
    try:
        yield store
    finally:
        store.close()


def whole(number: int) -> Snapshot:
    """A checkpoint that needs no other."""
    return snapshot({1: page(f"state {number}")}, generation=number)


def keep(store: Store, root: Path, number: int, age_s: float = 0.0) -> None:
    """Store one that came so long ago, and forget what is before it."""
    made = whole(number)
    put(store, made)
    (path,) = (entry.path for entry in store.chain_of(COMPONENT, made.position))
    stamp = time.time() - age_s
    os.utime(path, (stamp, stamp))
    before, is_due = sorted(root.rglob("*")), store.is_prune_due(COMPONENT, made.position)
    store.prune(COMPONENT, made.position)
    assert is_due == (sorted(root.rglob("*")) != before), "whether there is anything to do is told beforehand"


def olds(root: Path) -> list[Path]:
    return sorted((root / HISTORY_FOLDER).glob("*/*"))


def ages(root: Path) -> list[int]:
    now = time.time()
    return sorted((round(now - path.stat().st_mtime) for path in olds(root)), reverse=True)


def test_without_retention_nothing_is_kept_besides_what_is_needed(tmp_path: Path) -> None:
    with opened(tmp_path / "store", Retention()) as store:
        for number in range(1, 5):
            keep(store, tmp_path / "store", number)
        assert store.positions(COMPONENT) == (whole(4).position,) and not olds(tmp_path / "store")


def test_what_is_kept_is_whole_and_can_be_read_on_its_own(tmp_path: Path) -> None:
    root = tmp_path / "store"
    with opened(root, MANY) as store:
        for number in range(1, 4):
            keep(store, root, number, age_s=(4 - number) * 200_000)
        assert store.positions(COMPONENT) == (whole(3).position,), "the rules see what they need, and nothing else"
        found = [format.decode(path) for path in olds(root)]
        assert [pages_of(one) for one in found] == [pages_of(whole(1)), pages_of(whole(2))]


def test_what_is_kept_is_spread_over_the_span_and_no_more_than_told(tmp_path: Path) -> None:
    root = tmp_path / "store"
    with opened(root, Retention(count=3, span_s=300)) as store:
        for number in range(1, 40):
            keep(store, root, number, age_s=400 - 10 * number)
        assert len(olds(root)) == 3
        assert all(early - late >= 99 for early, late in zip(ages(root), ages(root)[1:], strict=False))


def test_what_is_too_old_goes(tmp_path: Path) -> None:
    root = tmp_path / "store"
    with opened(root, Retention(count=3, span_s=300)) as store:
        keep(store, root, 1, age_s=290)
        keep(store, root, 2, age_s=10)
        assert len(olds(root)) == 1
        (old,) = olds(root)
        stamp = time.time() - 301
        os.utime(old, (stamp, stamp))
    with opened(root, Retention(count=3, span_s=300)) as store:
        keep(store, root, 3)
        assert [age for age in ages(root) if age > 300] == []
        assert store.newest(COMPONENT) == whole(3).position


def test_what_has_just_become_too_old_goes_although_no_snapshot_is_put_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "store"
    with opened(root, Retention(count=3, span_s=300)) as store:
        keep(store, root, 1, age_s=290)
        keep(store, root, 2)
        assert not store.is_prune_due(COMPONENT, whole(2).position)
        now_s = time.time()
        monkeypatch.setattr("checkpoint.store.store.time.time", lambda: now_s + 20)
        assert store.is_prune_due(COMPONENT, whole(2).position)
        store.prune(COMPONENT, whole(2).position)
        assert not olds(root)


def test_over_its_size_the_store_gives_up_the_oldest_and_never_what_is_needed(tmp_path: Path) -> None:
    root = tmp_path / "store"
    with opened(root, MANY) as store:
        for number in range(1, 6):
            keep(store, root, number, age_s=(10 - number) * 100_001)
        size = olds(root)[0].stat().st_size
    with opened(root, Retention(count=10, span_s=1_000_000, size_max=3 * size)) as store:
        keep(store, root, 6)
        assert len(olds(root)) == 2 and store.newest(COMPONENT) == whole(6).position
    with opened(root, Retention(count=10, span_s=1_000_000, size_max=1)) as store:
        keep(store, root, 7)
        assert not olds(root) and pages_of(store.load(COMPONENT)) == pages_of(whole(7))


def test_where_the_disk_has_no_room_the_old_ones_give_theirs(tmp_path: Path) -> None:
    root = tmp_path / "store"
    with opened(root, MANY) as store:
        for number in range(1, 4):
            keep(store, root, number, age_s=(4 - number) * 200_000)
        store.make_room(1)
        assert len(olds(root)) == 2
        store.make_room(1 << 62)
        assert not olds(root) and store.newest(COMPONENT) == whole(3).position


def test_what_is_dropped_is_forgotten_wholly(tmp_path: Path) -> None:
    root = tmp_path / "store"
    with opened(root, MANY) as store:
        for number in range(1, 4):
            keep(store, root, number, age_s=(4 - number) * 200_000)
        kept = store.kept(COMPONENT)
        assert kept is not None and (kept.positions, kept.olds) == (1, 2) and kept.newest_s > kept.oldest_s
        store.drop(COMPONENT)
        assert not olds(root) and store.kept(COMPONENT) is None
