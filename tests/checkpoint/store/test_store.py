"""A directory of snapshots: a stored one is there, and a damaged one is passed over.

Power cuts: `tests.checkpoint.store.test_store_power`.
"""

from __future__ import annotations

import errno
import os
import resource
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.errors import ChainError, FormatError, StoreError
from checkpoint.keeper.messages import close_all, memfd_holding
from checkpoint.model import PageRun, Position, Snapshot
from checkpoint.snapshot import canonical_state, format
from checkpoint.store import chain, chain_files
from checkpoint.store.atomic_files import WholeFiles
from checkpoint.store.disk import Disk, DiskFile
from checkpoint.store.fold_rules import fold_is_due
from checkpoint.store.index import Entry
from checkpoint.store.store import Store, open_store
from tests.checkpoint.snapshots import COMPONENT, history, page, pages_of, snapshot

PATIENCE_S = 60.0
"""How long anything awaited here may take; generous, because the machine may be busy with other tests."""


@contextmanager
def opened(root: Path, disk: Disk | None = None) -> Iterator[Store]:
    store = open_store(root, disk)
    try:
        yield store
    finally:
        store.close()


def put(store: Store, made: Snapshot, *, prove: bool = True) -> None:
    descriptor = memfd_holding(format.encode_bytes(made), "snapshot")
    try:
        store.put(descriptor, prove=prove)
    finally:
        os.close(descriptor)


def test_what_was_put_is_there_after_a_restart(tmp_path: Path) -> None:
    made = history(5)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
    with opened(tmp_path / "store") as store:
        assert store.components() == (COMPONENT,)
        assert store.positions(COMPONENT) == tuple(one.position for one in made)
        for length in range(1, 6):
            folded = store.load(COMPONENT, made[length - 1].position)
            assert pages_of(folded) == pages_of(chain.fold(made[:length]))
        descriptors = store.open_chain(COMPONENT)
        assert [format.read_header(one).position for one in descriptors] == [one.position for one in made]
        for one in descriptors:
            os.close(one)


def test_nobody_else_can_read_a_snapshot(tmp_path: Path) -> None:
    with opened(tmp_path / "store") as store:
        put(store, history(1)[0])
    for path in (tmp_path / "store").rglob("*"):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


@pytest.mark.parametrize("name", ["/a/b", "../../etc/passwd", "/Лаборатория/робот1", "x" * 60, "%2F", ".", " "])
def test_any_component_name_is_a_safe_file_name(name: str, tmp_path: Path) -> None:
    with opened(tmp_path / "store") as store:
        put(store, snapshot({1: page("x")}, component=name))
        assert store.components() == (name,)
    assert {path.parent for path in (tmp_path / "store").glob("*/*")} == set((tmp_path / "store").glob("@*"))
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
    with opened(tmp_path / "store") as store:
        assert store.load(name).component == name


def test_two_processes_do_not_share_a_store(tmp_path: Path) -> None:
    with opened(tmp_path / "store"), pytest.raises(StoreError, match="another process"):
        open_store(tmp_path / "store")


def test_a_delta_that_continues_nothing_here_asks_for_a_base(tmp_path: Path) -> None:
    base, second, third = history(3)
    with opened(tmp_path / "store") as store:
        with pytest.raises(ChainError, match="ask for a base"):
            put(store, second)
        put(store, base)
        with pytest.raises(ChainError, match="ask for a base"):
            put(store, third)
        assert store.newest(COMPONENT) == base.position


def test_a_snapshot_whose_position_names_another_state_asks_for_a_base(tmp_path: Path) -> None:
    base, second = history(2)
    with opened(tmp_path / "store") as store:
        put(store, base)
        with pytest.raises(ChainError, match="the state is not that of position"):
            put(store, replace(second, position=replace(second.position, digest=bytes(16))))
        put(store, second)
        assert store.newest(COMPONENT) == second.position


def test_only_the_files_after_a_position_that_the_caller_has_are_opened(tmp_path: Path) -> None:
    made = history(4)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)

        def positions(beyond: Position | None) -> list[Position]:
            descriptors = store.open_chain(COMPONENT, made[3].position, beyond=beyond)
            try:
                return [format.read_header(descriptor).position for descriptor in descriptors]
            finally:
                close_all(tuple(descriptors))

        assert positions(None) == [one.position for one in made]
        assert positions(made[1].position) == [made[2].position, made[3].position]
        assert positions(made[3].position) == []
        store.fold(COMPONENT, made[2].position)
        assert positions(made[1].position) == [], "the chain does not lead over it any more"
        assert positions(made[2].position) == [made[3].position]


def test_a_snapshot_that_is_damaged_on_arrival_leaves_no_trace(tmp_path: Path) -> None:
    content = bytearray(format.encode_bytes(history(1)[0]))
    content[-200] ^= 1
    descriptor = memfd_holding(content, "snapshot")
    with opened(tmp_path / "store") as store:
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(FormatError):
            store.put(descriptor)
        assert sorted(tmp_path.rglob("*")) == before
    os.close(descriptor)


def test_a_damaged_newest_file_leads_back_to_what_is_intact_and_says_so(tmp_path: Path) -> None:
    made = history(4)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        damaged = store.chain_of(COMPONENT)[2].path
        content = bytearray(damaged.read_bytes())
        content[len(content) // 2] ^= 8
        damaged.write_bytes(content)
        assert store.load(COMPONENT).position == made[1].position
        assert any(str(damaged) in notice or "going back" in notice for notice in store.notices)
    with opened(tmp_path / "store") as store:
        assert store.newest(COMPONENT) == made[1].position
        assert store.notices


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 8
    path.write_bytes(content)


def test_a_chain_that_is_checked_again_loses_what_is_damaged_and_what_continues_it(tmp_path: Path) -> None:
    made = history(4)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        store.check(COMPONENT)
        assert store.newest(COMPONENT) == made[3].position
        damaged = store.chain_of(COMPONENT)[2].path
        damage(damaged)
        store.check(COMPONENT, made[1].position)
        assert store.newest(COMPONENT) == made[3].position, "nothing of that chain is damaged"
        store.check(COMPONENT)
        assert store.newest(COMPONENT) == made[1].position
        assert any(str(damaged) in notice for notice in store.notices)
        with pytest.raises(StoreError, match="does not hold"):
            store.check(COMPONENT, made[3].position)


def test_a_check_that_can_open_nothing_says_nothing_of_the_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = history(4)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)

        def full(*_: object) -> int:
            raise OSError(errno.EMFILE, "Too many open files")

        with monkeypatch.context() as patch:
            patch.setattr("checkpoint.store.store.os.open", full)
            store.check(COMPONENT)
        assert store.newest(COMPONENT) == made[3].position and not store.notices


def test_a_snapshot_that_was_damaged_and_sent_again_survives_pruning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("checkpoint.store.fold_rules.FOLD_DELTA_PART", 1000)  # a chain that is folded would not need the file
    made = history(4)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        damage(store.chain_of(COMPONENT)[2].path)
        assert store.load(COMPONENT).position == made[1].position
        put(store, made[2])
        put(store, made[3])
        store.prune(COMPONENT, made[3].position)
        assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(made))
    with opened(tmp_path / "store") as store:
        assert store.newest(COMPONENT) == made[3].position
        assert not store.notices


@pytest.mark.parametrize("reopened", [False, True])
@pytest.mark.parametrize("wholly", [False, True])
def test_damaged_files_go_when_what_is_older_goes(tmp_path: Path, *, reopened: bool, wholly: bool) -> None:
    made, root = history(3), tmp_path / "store"
    later = snapshot({1: page("later")}, generation=2)
    with opened(root) as store:
        for one in made:
            put(store, one)
        damage(store.chain_of(COMPONENT)[1].path)
        if not reopened:
            assert store.load(COMPONENT).position == made[0].position
            put(store, later)
            store.drop(COMPONENT) if wholly else store.prune(COMPONENT, later.position)
    if reopened:
        with opened(root) as store:
            put(store, later)
            store.drop(COMPONENT) if wholly else store.prune(COMPONENT, later.position)
    assert len([*root.glob("@*/*")]) == (0 if wholly else 1)


def test_deltas_whose_parent_is_lost_go_although_they_are_newer(tmp_path: Path) -> None:
    made = history(4)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        damage(store.chain_of(COMPONENT)[2].path)
        assert store.load(COMPONENT).position == made[1].position
        orphan = next((tmp_path / "store").glob(f"@*/*{made[3].position.digest.hex()}.delta"))
        store.prune(COMPONENT, made[1].position)
        assert not orphan.exists()
        assert store.newest(COMPONENT) == made[1].position


def test_a_dropped_component_leaves_no_page_table(tmp_path: Path) -> None:
    base, delta = history(2)
    with opened(tmp_path / "store") as store:
        put(store, base)
        store.drop(COMPONENT)
        assert not store._proofs._proved
        with pytest.raises(ChainError, match="ask for a base"):
            put(store, delta)


def test_a_former_standby_remembers_no_pages_of_what_it_runs_now(tmp_path: Path) -> None:
    first, second, third, fourth = history(4)
    with opened(tmp_path / "store") as store:
        put(store, first)
        put(store, second)
        assert store._proofs._proved
        put(store, third, prove=False)
        assert not store._proofs._proved
        put(store, fourth)  # a standby again
        assert store.newest(COMPONENT) == fourth.position


def test_the_outline_of_what_was_made_here_last_is_not_read_again(tmp_path: Path) -> None:
    first, second, third = history(3)
    with opened(tmp_path / "store") as store:
        put(store, first, prove=False)
        put(store, second, prove=False)
        older, newer = store.chain_of(COMPONENT)
        assert outline_of(store, older) == replace(first, contents=b"")
        newer.path.write_bytes(b"altered")
        assert outline_of(store, newer).vmas == second.vmas
        put(store, third, prove=False)
        with pytest.raises(FormatError):
            outline_of(store, newer)


def outline_of(store: Store, entry: Entry) -> Snapshot:
    with entry.path.open("rb") as file:
        return store.outline(COMPONENT, entry, file.fileno())


def test_whether_anything_is_to_be_put_away_is_known_without_the_disk(tmp_path: Path) -> None:
    made = history(3)
    with opened(tmp_path / "store") as store:
        put(store, made[0])
        assert not store.is_prune_due(COMPONENT, made[0].position), "all of it is needed"
        put(store, made[1])
        put(store, made[2])
        assert fold_is_due(store.chain_of(COMPONENT))
        assert store.is_prune_due(COMPONENT, made[-1].position), "it has grown long"
        store.fold(COMPONENT, made[-1].position)
        assert store.is_prune_due(COMPONENT, made[-1].position), "what was folded is not needed"
        store.prune(COMPONENT, made[-1].position)
        assert not store.is_prune_due(COMPONENT, made[-1].position)
        put(store, made[0])
        store.prune(COMPONENT, made[0].position)
        damaged = store.chain_of(COMPONENT, made[0].position)[0].path
        damaged.write_bytes(b"altered")
        with pytest.raises(StoreError):
            store.load(COMPONENT, made[0].position)
        assert store.is_prune_due(COMPONENT, made[-1].position), "a damaged file may go"


def test_what_is_older_than_wanted_is_forgotten(tmp_path: Path) -> None:
    made = history(5)
    later = snapshot({1: page("later")}, generation=2)
    with opened(tmp_path / "store") as store:
        for one in (*made, later):
            put(store, one)
        store.keep_newest(COMPONENT, 1)
        assert store.positions(COMPONENT) == (later.position,)
        assert len([*(tmp_path / "store").glob("@*/*")]) == 1


def test_a_long_chain_is_folded_and_stays_the_same_state(tmp_path: Path) -> None:
    made = history(80)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        store.keep_newest(COMPONENT, 2)
        assert store.newest(COMPONENT) == made[-1].position
        assert len(store.chain_of(COMPONENT)) <= 2
        assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(made))


def test_a_fold_decodes_the_state_of_the_newest_delta_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, decoded = history(80), []
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        read = canonical_state.decode_state
        monkeypatch.setattr(canonical_state, "decode_state", lambda *state, **kind: decoded.append(1) or read(*state, **kind))
        store.keep_newest(COMPONENT, 1)
        assert len(decoded) == len(["base", "newest"])
        assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(made))
        assert not store._chains._known.keys() & {entry.path for entry in store.chain_of(COMPONENT)}


def test_what_is_known_of_deltas_for_a_fold_stays_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = history(6)
    with opened(tmp_path / "store") as store:
        for one in made:
            put(store, one)
        known = list(store._chains._known)
        assert len(known) == 5 and store._chains._states_size > 0
        monkeypatch.setattr(chain_files, "KNOWN_STATES", 0)
        store._chains.know(known[0], *store._chains._known[known[0]])
        assert not store._chains._known and store._chains._states_size == 0
    with opened(tmp_path / "other") as store, monkeypatch.context() as patched:
        patched.setattr(chain_files, "KNOWN_STATES", 8 << 20)
        patched.setattr(chain_files, "KNOWN_STATE", 100)
        for one in made:
            put(store, one)
        assert not store._chains._known, "each has a large state"
    many = replace(made[1], cleared=tuple(PageRun(number << 13, (number << 13) + 4096) for number in range(1, 2_000)))
    with opened(tmp_path / "third") as store:
        put(store, made[0])
        put(store, many, prove=False)
        assert not store._chains._known, "many runs were cleared"


class StuckDisk(Disk):
    """A disk whose syncs wait until somebody opens the gate."""

    def __init__(self) -> None:
        super().__init__()
        self.gate, self.waits = threading.Event(), threading.Event()
        self.gate.set()

    def sync_file(self, descriptor: int) -> None:
        """See `Disk.sync_file`."""
        self.waits.set()
        assert self.gate.wait(PATIENCE_S)
        super().sync_file(descriptor)


def test_what_arrived_in_an_unnamed_file_on_the_same_disk_is_not_written_again(tmp_path: Path) -> None:
    """It gets its name; one of another file system, or in memory, is copied. What is kept is the same."""
    (tmp_path / "store").mkdir()
    files = WholeFiles(Disk())
    unnamed = os.open(tmp_path / "store", os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o644)
    memory = os.memfd_create("arrived")
    copied = []
    try:
        for number, source in enumerate((unnamed, memory)):
            os.write(source, b"whole")

            def fill(file: DiskFile, source: int = source) -> None:
                copied.append(source)
                file.copy_from(source)

            final = tmp_path / "store" / str(number)
            assert files.write(final, fill, source) == 5
            assert final.read_bytes() == b"whole"
            assert final.stat().st_mode & 0o777 == 0o600
        assert copied == [memory]
        assert (tmp_path / "store" / "0").stat().st_ino == os.fstat(unnamed).st_ino
    finally:
        os.close(unnamed)
        os.close(memory)
    assert sorted(path.name for path in (tmp_path / "store").iterdir()) == ["0", "1"]


LONG_CHANGES: dict[str, Callable[[Store, tuple[Snapshot, ...]], object]] = {
    "put": lambda store, made: put(store, made[3]),
    "fold": lambda store, made: store.fold(COMPONENT, made[2].position),
    "set_aside": lambda store, made: store.set_aside(COMPONENT, [1]),
}


@pytest.mark.parametrize("change", LONG_CHANGES)
def test_whoever_reads_does_not_wait_for_a_long_change(change: str, tmp_path: Path) -> None:
    made, disk = history(4), StuckDisk()
    other = snapshot({1: page("x")}, component="/lab/robot2/arm")
    with opened(tmp_path / "store", disk) as store, ThreadPoolExecutor() as pool:
        for one in made[:3]:
            put(store, one)
        put(store, other)
        disk.gate.clear()
        disk.waits.clear()
        try:
            under_way = pool.submit(LONG_CHANGES[change], store, made)
            assert disk.waits.wait(PATIENCE_S)
            descriptors = pool.submit(store.open_chain, COMPONENT).result(PATIENCE_S)
            for one in descriptors:
                os.close(one)
            assert len(descriptors) == 3
            pool.submit(store.drop, other.component).result(PATIENCE_S)
            assert not under_way.done()
        finally:
            disk.gate.set()
        under_way.result(PATIENCE_S)


def test_a_fold_of_what_is_dropped_meanwhile_leaves_nothing(tmp_path: Path) -> None:
    made, disk = history(4), StuckDisk()
    with opened(tmp_path / "store", disk) as store, ThreadPoolExecutor() as pool:
        for one in made:
            put(store, one)
        disk.gate.clear()
        disk.waits.clear()
        try:
            folding = pool.submit(store.fold, COMPONENT, made[3].position)
            assert disk.waits.wait(PATIENCE_S)
            store.drop(COMPONENT)
        finally:
            disk.gate.set()
        folding.result(PATIENCE_S)
        assert store.components() == ()
    assert not list((tmp_path / "store").glob("@*/*"))


def test_a_history_that_lost_the_argument_is_kept_aside(tmp_path: Path) -> None:
    made = history(3)
    later = snapshot({1: page("winner")}, generation=2)
    with opened(tmp_path / "store") as store:
        for one in (*made, later):
            put(store, one)
        aside = store.set_aside(COMPONENT, [1])
        assert aside is not None
        assert pages_of(format.decode(aside)) == pages_of(chain.fold(made))
        assert store.positions(COMPONENT) == (later.position,)


def test_only_the_newest_of_what_lost_is_kept_aside(tmp_path: Path) -> None:
    alike = snapshot({1: page("other")}, component=f"{COMPONENT}-2")
    with opened(tmp_path / "store") as store:
        put(store, alike)
        store.set_aside(alike.component, [1])
        for generation in range(1, 8):
            put(store, snapshot({1: page(f"loser {generation}")}, generation=generation))
            kept = store.set_aside(COMPONENT, [generation])
        left = sorted((tmp_path / "store" / "aside").iterdir())
    assert len(left) == 4 + 1
    assert kept in left
    generations = [format.read_header(path).position.generation for path in left if f"{COMPONENT[-6:]}-0" in path.name]
    assert generations == [4, 5, 6, 7]


FULL_DISK = """
import os, sys
from checkpoint.errors import StoreError
from checkpoint.store.store import open_store
from pathlib import Path
store = open_store(Path(sys.argv[1]))
descriptor = os.open(sys.argv[2], os.O_RDONLY)
try:
    store.put(descriptor)
except StoreError as error:
    print(error)
    sys.exit(7)
"""


def test_a_full_disk_is_said_and_costs_nothing_that_was_held(tmp_path: Path) -> None:
    made = history(2)
    with opened(tmp_path / "store") as store:
        put(store, made[0])
    arriving = tmp_path / "arriving"
    arriving.write_bytes(format.encode_bytes(made[1]))
    limit = arriving.stat().st_size - 1

    def smaller() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-c", FULL_DISK, tmp_path / "store", arriving]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=smaller)
    assert done.returncode == 7, done.stderr
    assert "intact" in done.stdout
    with opened(tmp_path / "store") as store:
        assert store.newest(COMPONENT) == made[0].position
        assert not store.notices


@pytest.mark.root
@pytest.mark.parametrize("spoil", ["owner", "mode", "link"])
def test_a_file_that_another_user_may_have_written_is_not_used(spoil: str, tmp_path: Path) -> None:
    """Of a chain whose base and delta belong to different users nothing is restored."""
    with opened(tmp_path / "store") as store:
        for one in history(2):
            put(store, one)
        file = store.chain_of(COMPONENT)[1].path
        if spoil == "owner":
            os.chown(file, 1234, 1234)
        elif spoil == "mode":
            file.chmod(0o622)
        else:
            file.rename(tmp_path / "aside")
            file.symlink_to(tmp_path / "aside")
        with pytest.raises(StoreError, match=r"belongs to uid 1234|mode 622|cannot open the chain"):
            store.open_chain(COMPONENT)
    with opened(tmp_path / "store") as store:
        assert len(store.positions(COMPONENT)) == 1, "the base is ours"


@pytest.mark.root
@pytest.mark.parametrize(("owner", "mode"), [(1234, 0o700), (0, 0o777), (0, 0o770)])
def test_a_store_that_another_user_may_write_to_is_not_opened(owner: int, mode: int, tmp_path: Path) -> None:
    root = tmp_path / "store"
    root.mkdir()
    os.chown(root, owner, owner)
    root.chmod(mode)
    with pytest.raises(StoreError, match="give it to this user alone"):
        open_store(root)
