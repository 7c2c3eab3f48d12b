"""Files are read again for their digests only when they have changed, in any way."""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.store import content_store
from checkpoint.store.content_store import digest_of_file
from checkpoint.store.digest_cache import SETTLED_NS, DigestsOfFiles, KnownDigest


def known(path: Path) -> tuple[KnownDigest, ...]:
    """What is remembered of a file that has been as it is for a while."""
    digests = DigestsOfFiles()
    assert digests.of(str(path)) == digest_of_file(path)
    return tuple(digests.used.values())


@pytest.fixture
def settled(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_bytes(b"a" * 8192)
    while time.time_ns() - path.stat().st_ctime_ns < SETTLED_NS:
        time.sleep(0.05)
    return path


def by_writing(path: Path) -> None:
    with path.open("r+b") as opened:
        opened.write(b"b")


def by_writing_and_turning_its_time_back(path: Path) -> None:
    before = path.stat()
    by_writing(path)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def through_a_mapping(path: Path) -> None:
    with path.open("r+b") as opened, mmap.mmap(opened.fileno(), 0) as mapped:
        mapped[:1] = b"b"
        mapped.flush()


def by_another_file_in_its_place(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(b"b" * 8192)
    os.utime(other, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    other.rename(path)


def test_what_nobody_touched_is_not_read_again(settled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digests = DigestsOfFiles(known(settled))
    expected = digest_of_file(settled)
    monkeypatch.setattr(content_store, "digest_of_file", lambda path: pytest.fail(f"{path} is read again"))
    assert digests.of(str(settled)) == expected
    assert [one.path for one in digests.used.values()] == [str(settled)], "it is known the next time, too"


@pytest.mark.parametrize(
    "change", [by_writing, by_writing_and_turning_its_time_back, through_a_mapping, by_another_file_in_its_place]
)
def test_what_was_changed_is_read_again(settled: Path, change: Callable[[Path], None]) -> None:
    digests = DigestsOfFiles(known(settled))
    change(settled)
    assert digests.of(str(settled)) == digest_of_file(settled) != digest_of_file(os.devnull)


def test_what_was_written_a_moment_ago_is_not_relied_on(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"a")
    assert known(path) == ()


def test_what_is_gone_is_an_error_as_before(settled: Path) -> None:
    digests = DigestsOfFiles(known(settled))
    settled.unlink()
    with pytest.raises(FileNotFoundError):
        digests.of(str(settled))
