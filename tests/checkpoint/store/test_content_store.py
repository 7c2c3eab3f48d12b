"""Files that programs brought along: kept by content, whole or not at all, as long as a snapshot names them."""

from __future__ import annotations

import itertools
import os
import stat
import time
from pathlib import Path

import pytest
from blake3 import blake3
from msgspec.structs import replace

from checkpoint.errors import StoreError
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import FileIdentity, Snapshot, ThreadState
from checkpoint.store import content_store as keeping
from checkpoint.store.store import Store
from tests.checkpoint.snapshots import COMPONENT, page, snapshot
from tests.checkpoint.store.test_store import opened, put
from tests.checkpoint.store.test_store_power import CuttingDisk, PowerCutError, laid_out

CONTENT = bytes(range(256)) * 64


def keep(store: Store, content: bytes) -> bytes:
    digest = blake3(content).digest()
    descriptor = memfd_holding(content, "content")
    try:
        store.contents.put(descriptor, digest)
    finally:
        os.close(descriptor)
    return digest


def naming(digest: bytes, text: str = "x", component: str = COMPONENT) -> Snapshot:
    """A snapshot of a program whose executable has that content."""
    made = snapshot({1: page(text)}, component=component)
    executable = FileIdentity("/opt/program", mode=stat.S_IFREG, size=len(CONTENT), digest=digest)
    changed = replace(made, process=replace(made.process, executable=executable))
    return replace(changed, position=position(changed))


def position(made: Snapshot) -> object:
    from checkpoint.store.chain import position_of

    return position_of(made, made.position.generation, made.position.sequence)


def age(store: Store) -> None:
    """All contents came long ago."""
    long_ago = time.time() - 2 * keeping.GRACE_S
    for path in store.contents.folder.iterdir():
        os.utime(path, (long_ago, long_ago))


def test_a_content_is_there_after_a_restart_for_all_to_read_and_run_and_for_nobody_to_change(tmp_path: Path) -> None:
    with opened(tmp_path / "store") as store:
        digest = keep(store, CONTENT)
    with opened(tmp_path / "store") as store:
        assert store.contents.has(digest, len(CONTENT))
        assert not store.contents.has(digest, len(CONTENT) + 1)
        assert store.contents.path(digest).stat().st_mode & 0o7777 == 0o555
        descriptor = store.contents.open(digest)
        assert keeping.digest_of_descriptor(descriptor) == digest
        os.close(descriptor)
        assert store.components() == ()


def test_a_content_can_be_executed_also_if_the_power_went_before_its_mode_was_safe(tmp_path: Path) -> None:
    with opened(tmp_path / "store") as store:
        digest = keep(store, CONTENT)
        store.contents.path(digest).chmod(0o600)
    with opened(tmp_path / "store") as store:
        assert store.contents.path(digest).stat().st_mode & 0o7777 == 0o555


def test_a_program_that_goes_on_writing_to_a_file_of_its_own_does_not_write_to_what_is_kept_of_it(tmp_path: Path) -> None:
    digest = blake3(CONTENT).digest()
    with opened(tmp_path / "store") as store:
        descriptor = os.open(tmp_path, os.O_TMPFILE | os.O_RDWR)
        os.write(descriptor, CONTENT)
        store.contents.put(descriptor, digest)
        os.pwrite(descriptor, b"another", 0)
        os.close(descriptor)
        assert store.contents.path(digest).read_bytes() == CONTENT


def test_a_content_stays_as_long_as_a_snapshot_names_it(tmp_path: Path) -> None:
    with opened(tmp_path / "store") as store:
        named, other = keep(store, CONTENT), keep(store, b"of nobody")
        put(store, naming(named))
        store.collect_contents()
        assert store.contents.has(other, 9), "it may wait for its snapshot"
        age(store)
        assert store.collect_contents() == 9
        assert store.contents.has(named, len(CONTENT))
        assert not store.contents.has(other, 9)
        store.drop(COMPONENT)
        assert store.collect_contents() == len(CONTENT)


def test_nothing_is_removed_while_a_snapshot_cannot_be_read(tmp_path: Path) -> None:
    """Perhaps it is the one that names it; and whoever looks at the file may mend it."""
    with opened(tmp_path / "store") as store:
        named = keep(store, CONTENT)
        put(store, naming(named))
        age(store)
        (entry,) = store.chain_of(COMPONENT)
        entry.path.write_bytes(b"damaged" + entry.path.read_bytes()[7:])
        assert store.collect_contents() == 0
        assert store.contents.has(named, len(CONTENT))


@pytest.mark.parametrize("digest", [b"", b"../../../etc/cron.d/program12345", bytes(31), bytes(33)])
def test_a_digest_names_a_file_of_the_folder_and_no_other(digest: bytes, tmp_path: Path) -> None:
    with opened(tmp_path / "store") as store:
        if len(digest) == keeping.DIGEST_SIZE:
            assert store.contents.path(digest).parent == store.contents.folder
        else:
            with pytest.raises(StoreError, match="names no content"):
                store.contents.path(digest)


def test_a_content_that_was_cut_short_by_a_power_cut_is_not_there(tmp_path: Path) -> None:
    digest = blake3(CONTENT).digest()
    for cut_at in itertools.count():
        old = tmp_path / f"old{cut_at}"
        old.mkdir()
        disk = CuttingDisk(cut_at)
        disk.now[old] = disk.safe[old] = None
        done = False
        try:
            with opened(old / "store", disk) as store:
                keep(store, CONTENT)
                done = True
        except PowerCutError:
            pass
        for names_written, content_written in itertools.product(("all", "half", "none"), repeat=2):
            new = tmp_path / f"new{cut_at}-{names_written}-{content_written}"
            new.mkdir()
            laid_out(disk.left(names_written, content_written), old, new)
            with opened(new / "store") as store:
                where = f"cut before change {cut_at}, names {names_written}, content {content_written}"
                found = sorted(path.name for path in store.contents.folder.iterdir()) if store.contents.folder.is_dir() else []
                assert found in ([], [digest.hex()]), where
                assert not done or found, where
                assert not found or store.contents.path(digest).read_bytes() == CONTENT, where
        if done:
            break
    assert cut_at > 5


def test_threads_make_no_difference() -> None:
    """A snapshot without threads is of a program that is started again, and needs no executable of its own."""
    from checkpoint.snapshot.required_files import needs

    made = naming(bytes(32))
    assert [need.path for need in needs(made)] == ["/opt/program"]
    assert isinstance(made.threads[0], ThreadState)
    assert needs(replace(made, threads=())) == ()
