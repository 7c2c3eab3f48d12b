"""Copies that lost their primacy are kept for inspection, a few of each component."""

from __future__ import annotations

from pathlib import Path

from checkpoint.store import lost_copies


def test_the_newest_of_each_component_are_kept(tmp_path: Path) -> None:
    directory = tmp_path / "lost"
    other = lost_copies.keep(directory, "/lab/r1/mapper-epoch", 1, b"another component's")
    kept = [lost_copies.keep(directory, "/lab/r1/[m]apper", epoch, b"%d" % epoch) for epoch in (2, 9, 10, 11)]
    assert [path.exists() for path in kept] == [False, True, True, True]
    assert (kept[-1].read_bytes(), other.read_bytes()) == (b"11", b"another component's")
    assert kept[-1].stat().st_mode & 0o077 == 0 == directory.stat().st_mode & 0o077


def test_what_a_person_has_looked_at_is_marked_until_another_one_takes_its_place(tmp_path: Path) -> None:
    directory = tmp_path / "lost"
    assert lost_copies.found(directory) == []
    path = lost_copies.keep(directory, "/lab/r1/map per", 7, b"state")
    (one,) = lost_copies.found(directory)
    assert (one.component, one.epoch, one.size, one.seen, one.path) == ("/lab/r1/map per", 7, 5, False, path)
    lost_copies.look_at(path)
    assert [one.seen for one in lost_copies.found(directory)] == [True]
    lost_copies.keep(directory, "/lab/r1/map per", 7, b"another")
    assert [one.seen for one in lost_copies.found(directory)] == [False]
    lost_copies.look_at(path)
    lost_copies.remove(path)
    assert list(directory.iterdir()) == []
