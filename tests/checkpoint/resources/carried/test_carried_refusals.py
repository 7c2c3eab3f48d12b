"""What is not carried: sockets, too much, paths that mean another thing, names that lead out of a folder."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, Terms
from checkpoint.errors import RestoreError, UnsupportedError
from checkpoint.resources.carried import capture, restore
from checkpoint.snapshot import carried_files
from tests.checkpoint import snapshots
from tests.checkpoint.resources.carried.carrying import asleep, carrying, once_more
from tests.checkpoint.round_trip import ENGINE


def a_socket(folder: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(folder / "s"))


@pytest.mark.parametrize(
    ("furnished", "said"),
    [
        (a_socket, "/s is a socket, which is not carried"),
        (lambda folder: (folder / "large").write_bytes(bytes(3 << 20)), "hold 3 MiB, the limit is 2 MiB"),
        (lambda folder: [(folder / str(index)).touch() for index in range(capture.ENTRIES_MAX)], "more than 8192 names"),
    ],
    ids=["socket", "size", "names"],
)
def test_what_cannot_be_carried_is_refused_by_name_and_later_too(
    tmp_path: Path, furnished: Callable[[Path], object], said: str
) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    with asleep(tmp_path) as program, carrying(program, folder, size_max=2 << 20) as session:
        once_more(session, 1)
        furnished(folder)
        for _ in range(2):
            with pytest.raises(UnsupportedError, match=said):
                session.capture(CaptureOrder())
        with pytest.raises(UnsupportedError, match=said), carrying(program, folder, size_max=2 << 20):
            pass
        for path in folder.iterdir():
            path.unlink()
        once_more(session, 2)


@pytest.mark.parametrize(
    ("path", "said"), [("link/inside", "is a link, or behind one"), ("../x", "no absolute path"), ("", "no absolute path")]
)
def test_a_path_that_means_another_thing_elsewhere_is_refused(tmp_path: Path, path: str, said: str) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    named = f"{tmp_path}/{path}" if path else "relative"
    with asleep(tmp_path) as program, pytest.raises(UnsupportedError, match=said):
        ENGINE.protect(program.pid, ProtectOrder("/test/carried", terms=Terms(Carry((named,))))).close()


def test_a_folder_above_that_becomes_a_link_is_refused_by_name_until_it_is_a_folder_again(tmp_path: Path) -> None:
    """What it leads to would be carried under the old name."""
    above, moved = tmp_path / "above", tmp_path / "moved"
    (above / "kept").mkdir(parents=True)
    with asleep(tmp_path) as program, carrying(program, above / "kept") as session:
        once_more(session, 1)
        above.rename(moved)
        above.symlink_to(moved)
        for _ in range(2):
            with pytest.raises(UnsupportedError, match=f"{above}/kept is to be carried, .*: name it as {moved}/kept"):
                session.capture(CaptureOrder())
        above.unlink()
        moved.rename(above)
        once_more(session, 2)


@pytest.mark.parametrize("name", [b"../out", b"/etc/passwd", b"a/../../out", b"a/b", b".", b"a//b"])
def test_a_snapshot_cannot_name_a_file_outside_of_its_folder(tmp_path: Path, name: bytes) -> None:
    with asleep(tmp_path) as program, carrying(program, tmp_path / "kept") as session:
        (tmp_path / "kept").mkdir()
        (tmp_path / "kept" / "a").touch()
        state = once_more(session, 1)
    (tree,) = carried_files.trees_of(state)
    entries = (tree.entries[0], replace(tree.entries[1], name=name))
    forged = replace(
        state, resources=(*carried_files.without(state).resources, carried_files.Tree(tree.path, entries).resource())
    )
    with pytest.raises(RestoreError, match="its snapshot"):
        restore.lay_down(forged, None, frozenset())


@pytest.mark.parametrize("path", ["/tmp/a/../../etc/x", "/tmp/./a", "/tmp//a", "//tmp/a", "/tmp/a/", "/", "tmp/a", "/tmp/a\0b"])
def test_a_snapshot_cannot_name_a_path_by_another_name(path: str) -> None:
    forged = replace(snapshots.history(1)[0], resources=(carried_files.Tree(path, ()).resource(),))
    with pytest.raises(RestoreError, match="does not name the path in full"):
        carried_files.trees_of(forged)
