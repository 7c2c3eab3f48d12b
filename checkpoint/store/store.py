"""A directory of snapshots that survives power loss at any point.

``ROOT/lock``, and one folder for each component with a file for each snapshot. A file appears under its name only when it is
whole and on the disk: written aside, synced, renamed, folder synced. So an acknowledged snapshot is always there, and a snapshot
that did not arrive whole leaves only a temporary file that the next opening removes.

There are two kinds of lock, taken in this order. Each component has one for the thread that changes its files, for as long as
that takes (a base may be gigabytes). The store has one for its index of all components, held for moments only. Readers wait
for the second alone: a takeover never waits for a snapshot that is being written, proved or folded.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from msgspec.structs import replace

from checkpoint.errors import ChainError, FormatError, StoreError
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot import format
from checkpoint.snapshot.canonical_state import header_of
from checkpoint.snapshot.format import Outlined, Streamed
from checkpoint.snapshot.required_files import needs
from checkpoint.snapshot.validity import place
from checkpoint.store import inventory
from checkpoint.store.atomic_files import WholeFiles, disk_trouble
from checkpoint.store.chain_files import ChainFiles, entry_of
from checkpoint.store.content_store import Contents
from checkpoint.store.contract import Kept
from checkpoint.store.disk import FILE_MODE, Disk, lock_exclusively
from checkpoint.store.fold_rules import fold_is_due, held_at_once
from checkpoint.store.index import SUFFIXES, Entry, Shelf, file_name, folder_name, order_of_name
from checkpoint.store.inventory import why_not_ours
from checkpoint.store.retention import HISTORY_FOLDER, History, Retention
from checkpoint.store.verify import Proofs
from checkpoint.store.xor_cache import CACHE_SIZE
from checkpoint.store.xor_cache_budget import PageBudget

log = logging.getLogger("failover.store")

ASIDE_FOLDER = "aside"
"""Holds what is kept for inspection only."""

ASIDE_LIMIT = 4
"""Files of one component that are kept for inspection; the oldest goes when another comes, or a bad cable would fill the disk."""

LOCK_NAME = "lock"

NOTICES_KEPT = 100
"""Notices about files that were found damaged or left over."""

NOTHING_OLD = Retention()


class Store:
    """The snapshots on one machine, as `checkpoint.store.contract` says. Made by ``open_store``; one process at a time."""

    def __init__(self, root: Path, disk: Disk, lock: int, retention: Retention, budget: PageBudget) -> None:
        self._root = root
        self._files = WholeFiles(disk)
        self.contents = Contents(root, self._files)
        """Files that programs brought along."""
        self._named: dict[Path, frozenset[bytes]] = {}
        self._chains = ChainFiles(root, self._files, self._set_out_of_use)
        self._history = History(root, self._files, retention)
        self._lock_descriptor = lock
        self._lock = threading.RLock()
        self._changing: dict[str, threading.RLock] = {}
        self._shelves: dict[str, Shelf] = {}
        self._proofs = Proofs(budget, self._streamed)
        self._made_last: dict[str, tuple[Path, Snapshot]] = {}
        """Of each component the snapshot that was put last without a proof, without its pages and its output, and where."""
        self.notices: list[str] = []
        """Files that were found damaged or left over: one sentence each."""

    # Asking

    def components(self) -> tuple[str, ...]:
        """Everything of which there is a position to return to, by name."""
        with self._lock:
            return tuple(sorted(name for name, shelf in self._shelves.items() if shelf.newest()))

    def positions(self, component: str) -> tuple[Position, ...]:
        """The positions that can be restored, oldest first."""
        with self._lock:
            return self._shelf(component).positions()

    def newest(self, component: str) -> Position | None:
        """The newest position that can be restored, None if there is none."""
        with self._lock:
            return self._shelf(component).newest()

    def chain_of(self, component: str, position: Position | None = None) -> tuple[Entry, ...]:
        """The files that lead to a position (the newest, if none is named), a base first.

        Raises:
            StoreError: there is no such position.
        """
        with self._lock:
            shelf = self._shelf(component)
            wanted = position or shelf.newest()
            found = shelf.chain_to(wanted) if wanted else ()
        if not found:
            named = f"position {place(position)}" if position else "any snapshot"
            raise StoreError(f"the store {self._root} does not hold {named} of {component}")
        return found

    def open_chain(self, component: str, position: Position | None = None, *, beyond: Position | None = None) -> list[int]:
        """Descriptors of the files that lead to a position, a base first; the caller closes them.

        They stay readable, also if the store removes or moves the files meanwhile.

        Args:
            beyond: a position that the caller has: only the files after it; none where the chain does not lead over it.
        """
        opened: list[int] = []
        try:
            with self._lock, disk_trouble(f"open the chain of {component}"):
                for entry in _after(self.chain_of(component, position), beyond):
                    opened.append(os.open(entry.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW))
                    if why := why_not_ours(os.fstat(opened[-1])):
                        raise StoreError(
                            f"cannot use {entry.path}: {why}; remove it, and check the write rights of the store {self._root}"
                        )
        except StoreError:
            for descriptor in opened:
                os.close(descriptor)
            raise
        return opened

    def outline(self, component: str, entry: Entry, source: int) -> Snapshot:
        """A snapshot without its pages; where it was made here last it is known still, but neither runs nor output of it.

        Args:
            source: descriptor of its file, which may have been removed meanwhile.

        Raises:
            FormatError: not a whole, unaltered snapshot.
        """
        with self._lock:
            path, outline = self._made_last.get(component, (None, None))
        return outline if outline is not None and path == entry.path else format.read_outline(source)

    def is_made_last(self, component: str, entry: Entry) -> bool:
        """Whether `outline` of this file is known, and reads nothing."""
        with self._lock:
            path, _ = self._made_last.get(component, (None, None))
        return path == entry.path

    def load(self, component: str, position: Position | None = None) -> Snapshot:
        """The state at a position as one base, verified and proved.

        Without a position: the newest that is intact. A damaged file on the way is set out of use and noted, and the next older
        position is tried.

        Raises:
            StoreError: there is none, or the position that was asked for is damaged.
        """
        while True:
            folded = self._chains.load(component, self.chain_of(component, position))
            if folded is not None:
                return folded
            if position is not None:
                raise StoreError(f"position {place(position)} of {component} cannot be restored: {self.notices[-1]}")

    def kept(self, component: str) -> Kept | None:
        """The stored snapshots of a component; None if there are none."""
        with self._lock:
            shelf = self._shelf(component)
        olds = self._history.of(folder_name(component))
        times = [*(entry.stored_s for entry in shelf.entries), *(old.stored_s for old in olds)]
        if not times:
            return None
        size = sum(entry.size for entry in shelf.entries) + sum(old.size for old in olds)
        return Kept(len(shelf.positions()), len(olds), size, max(times), min(times))

    # Keeping

    def make_room(self, size: int) -> None:
        """Make room on the disk for a snapshot of so many bytes, as far as snapshots that are kept for people can give it."""
        self._history.make_room(size)

    def unnamed(self) -> int:
        """An empty file without a name, which `put` need not copy; the caller closes its descriptor.

        Raises:
            StoreError: the disk gives none.
        """
        with disk_trouble(f"make a file in {self._root}"):
            return os.open(self._root, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, FILE_MODE)

    def put(self, source: int, *, prove: bool = True) -> Snapshot:
        """Keep a snapshot; when this returns it survives a power cut.

        Args:
            source: descriptor of the whole file; it stays the caller's. An unnamed file (O_TMPFILE) on the same file system as
                ``root`` is taken as it is, any other is copied.
            prove: compare the state that it leads to with its digest. Not needed where the snapshot was made here.

        Returns:
            The snapshot without its pages: its position, its output.

        Raises:
            FormatError: not a whole, unaltered snapshot.
            ChainError: it continues no position that the store holds, or does not lead to the state it names; ask for a base.
            StoreError: the disk does not take it; nothing of it is left.
        """
        if not prove:
            return self._put(source, format.verified(source))
        with format.streamed(source) as told:
            return self._put(source, (told.preamble, told.outline), told)

    def _put(self, source: int, outlined: Outlined, told: Streamed | None = None) -> Snapshot:
        """Keep the file of a snapshot, which is given without its pages.

        Args:
            told: the same with its pages, to be proved; None: it was made here.
        """
        preamble, snapshot = outlined
        with self._change_of(snapshot.component):
            shelf = self._shelf(snapshot.component)
            self._check_parent(shelf, snapshot)
            proved = self._proofs.prove(shelf, told) if told is not None else None
            final = self._root / folder_name(snapshot.component) / file_name(header_of(snapshot))
            if all(entry.position != snapshot.position or entry.path != final for entry in shelf.entries):
                size = self._files.write(final, lambda file: file.copy_from(source), source)
                self._add(snapshot.component, entry_of(final, snapshot, size))
            if proved is not None:
                self._proofs.keep(snapshot.component, proved)
            else:  # a snapshot made here is not proved: pages remembered while it came from elsewhere are of no use
                self._proofs.forget(snapshot.component)
            self._chains.know(final, preamble, snapshot)
            outline = replace(snapshot, runs=(), cleared=(), copies=(), differences=(), contents=b"")
            with self._lock:
                self._made_last.pop(snapshot.component, None)
                if told is None:
                    self._made_last[snapshot.component] = (final, replace(outline, output=()))
        return outline

    @contextmanager
    def _change_of(self, component: str) -> Iterator[None]:
        """No other thread changes what is held of a component during the body; all may read it."""
        with self._lock:
            changing = self._changing.setdefault(component, threading.RLock())
        with changing:
            yield

    def _add(self, component: str, entry: Entry) -> None:
        with self._lock:
            self._shelves[component] = self._shelf(component).with_entry(entry)

    def _check_parent(self, shelf: Shelf, snapshot: Snapshot) -> None:
        if snapshot.parent is not None and not shelf.chain_to(snapshot.parent):
            held = shelf.newest()
            ours = f"the newest position here is {place(held)}" if held else "nothing of it is here"
            raise ChainError(
                f"delta {place(snapshot.position)} of {snapshot.component} continues {place(snapshot.parent)}, "
                f"which is not held with that digest: {ours}; ask for a base"
            )

    @contextmanager
    def _streamed(self, component: str, entry: Entry) -> Iterator[Streamed]:
        """One of its files, for one pass over it; its damage is found during that pass."""
        try:
            with format.streamed(entry.path) as told:
                yield told
        except FormatError as error:
            self._set_out_of_use(component, entry, str(error))
            raise ChainError(
                f"a snapshot of {component} that this delta needs is damaged here: {error}; ask for a base"
            ) from error

    def check(self, component: str, position: Position | None = None) -> None:
        """Read each file that leads to a position (the newest, if none is named); a damaged one is set out of use and noted.

        Raises:
            StoreError: there is no such position.
        """
        for entry in self.chain_of(component, position):
            try:
                descriptor = os.open(entry.path, os.O_RDONLY | os.O_CLOEXEC)
            except OSError:
                continue  # folded or forgotten meanwhile, or no descriptor is left: that says nothing of the file
            try:
                format.verify(descriptor)
            except FormatError as error:
                self._set_out_of_use(component, entry, f"snapshot {entry.path}: {error}")
            finally:
                os.close(descriptor)

    # Forgetting

    def is_prune_due(self, component: str, oldest: Position) -> bool:
        """Whether `prune` would do anything; the disk is not asked, so that any thread may."""
        with self._lock:
            shelf = self._shelf(component)
            if fold_is_due(shelf.chain_to(oldest)) or shelf.unneeded_for(oldest) or self._files.are_damaged:
                return True
            return self._history.is_too_much(folder_name(component), time.time(), self._needed_size())

    def _needed_size(self) -> int:
        """Bytes of all files that the rules may go back to."""
        with self._lock:
            return sum(entry.size for shelf in self._shelves.values() for entry in shelf.entries)

    def prune(self, component: str, oldest: Position) -> None:
        """Forget what is not needed to restore ``oldest`` or a later position; fold its chain where that has grown long.

        Whole checkpoints among it are kept for people as the retention says. An ``oldest`` that is not held forgets nothing.
        """
        with self._lock:
            entries = self._shelf(component).chain_to(oldest)
        if fold_is_due(entries):
            self.fold(component, oldest)
        with self._change_of(component):
            shelf = self._shelf(component)
            self._remove(component, shelf.unneeded_for(oldest), self._history.take)
            floor = shelf.order_of(oldest)
            if floor is not None:
                self._remove_damaged(component, lambda path: (order_of_name(path.name) or floor) < floor)
        self._history.thin(folder_name(component), time.time())
        self._history.shrink(self._needed_size())

    def discard(self, component: str, position: Position) -> None:
        """Forget one position that nothing else here continues; one that is not held, or is continued, stays as it is.

        Raises:
            StoreError: the disk cannot remove it.
        """
        with self._change_of(component):
            entries = self._shelf(component).entries
            if all(entry.parent != position for entry in entries):
                self._remove(component, tuple(entry for entry in entries if entry.position == position))
                self._proofs.forget(component)

    def keep_newest(self, component: str, positions: int) -> None:
        """Forget all but the newest positions; as ``prune``."""
        held = self.positions(component)[-positions:]
        if held:
            self.prune(component, held[0])

    def fold(self, component: str, position: Position) -> None:
        """Write the state at a position as a base of its own, so that older files can go.

        The long part holds no lock at all: snapshots are taken in meanwhile. Cut off anywhere, the old chain is whole.

        Raises:
            StoreError: the position cannot be loaded, or the disk does not take the base.
            FormatError: see `ChainFiles.write_base`.
        """
        is_there = False
        while not is_there:
            entries = held_at_once(self.chain_of(component, position))
            reached = entries[-1].position
            is_there = reached == position
            written = self._chains.write_base(component, entries)
            if written is None:
                raise StoreError(f"position {place(position)} of {component} cannot be restored: {self.notices[-1]}")
            with self._change_of(component):
                if self._shelf(component).order_of(reached) is None:  # dropped or set aside meanwhile
                    self._files.remove(written.path)
                    return
                self._add(component, written)

    def set_aside(self, component: str, generations: Iterable[int]) -> Path | None:
        """Take generations out of the chain; their newest state is kept as one file for inspection.

        Returns:
            That file; None when nothing of these generations could be restored.
        """
        with self._change_of(component):
            shelf = self._shelf(component)
            chosen = set(generations)
            gone = tuple(entry for entry in shelf.entries if entry.position.generation in chosen)
            restorable = [position for position in shelf.positions() if position.generation in chosen]
            kept = self._write_aside(component, restorable[-1]) if restorable else None
            self._remove(component, gone)
            return kept

    def _write_aside(self, component: str, position: Position) -> Path:
        folded = self.load(component, position)
        final = self._root / ASIDE_FOLDER / f"{folder_name(component)}-{file_name(header_of(folded))}"
        self._files.write(final, lambda file: format.encode(folded, file))
        begin = f"{folder_name(component)}-"
        with disk_trouble(f"remove the snapshots of {component} that were set aside"):
            names = (path.name for path in final.parent.iterdir())
            ours = sorted(name for name in names if name.startswith(begin) and len(name) == len(final.name))
            for name in ours[:-ASIDE_LIMIT]:
                self._files.remove(final.parent / name)
        return final

    def drop(self, component: str) -> None:
        """Forget everything of a component; files that were set aside stay."""
        with self._change_of(component), self._lock:
            self._remove(component, self._shelf(component).entries)
            self._remove_damaged(component, lambda _: True)
            self._history.forget(folder_name(component))
            self._shelves.pop(component, None)
            self._made_last.pop(component, None)
            self._proofs.forget(component)

    def collect_contents(self) -> int:
        """Remove the brought files that no snapshot here names any more; how many bytes that were.

        As long as one of the snapshots cannot be read nothing is removed: perhaps it names them.
        """
        with disk_trouble(f"look through {self._root}"):
            paths = [path for folder in self._snapshot_folders() for path in folder.iterdir() if path.suffix in SUFFIXES]
        named: dict[Path, frozenset[bytes]] = {}
        for path in paths:
            try:
                named[path] = self._named.get(path) or frozenset(need.digest for need in needs(format.read_outline(path)))
            except FormatError as error:
                if path.exists():
                    log.info("brought files are not tidied: %s", error)
                    return 0
        self._named = named
        return self.contents.collect(frozenset().union(*named.values()))

    def _snapshot_folders(self) -> list[Path]:
        """Wherever a whole snapshot may lie: of components, set aside, kept for people."""
        history = self._root / HISTORY_FOLDER
        parents = (self._root, history) if history.is_dir() else (self._root,)
        return [one for parent in parents for one in parent.iterdir() if one.is_dir() and one != self.contents.folder]

    def close(self) -> None:
        """Let another process have the store; nothing else may be called afterwards."""
        os.close(self._lock_descriptor)

    # The disk

    def _remove(self, component: str, entries: tuple[Entry, ...], taken: Callable[[Path], bool] = lambda _: False) -> None:
        """Remove files, the youngest first: at any instant whole chains are left.

        Args:
            taken: whether a whole checkpoint's file has been taken, to be kept elsewhere.
        """
        with disk_trouble(f"remove snapshots of {component}"):
            for entry in sorted(entries, key=lambda entry: entry.order, reverse=True):
                with self._lock:
                    self._shelves[component] = self._shelf(component).without((entry,))
                if entry.parent is None and taken(entry.path):
                    continue
                self._chains.forget(entry.path)
                self._files.remove(entry.path)  # a reader of a chain has opened it, or does not know this file any more

    def _remove_damaged(self, component: str, is_old: Callable[[Path], bool]) -> None:
        with disk_trouble(f"remove damaged snapshots of {component}"):
            self._files.remove_damaged(self._root / folder_name(component), is_old)

    def _set_out_of_use(self, component: str, entry: Entry, why: str) -> None:
        """Never offer this file again; it stays where it is for inspection, until it is pruned."""
        with self._lock:
            shelf = self._shelf(component)
            if entry in shelf.entries:
                self._files.set_out_of_use(entry.path)
            self._shelves[component] = shelf.without((entry,))
            self._proofs.forget(component)
            newest = self.newest(component)
            self._notice(f"{why}; going back to position {place(newest)}" if newest else f"{why}; nothing older is intact")

    def _notice(self, sentence: str) -> None:
        self.notices.append(sentence)
        del self.notices[:-NOTICES_KEPT]
        log.warning("%s", sentence)

    def _shelf(self, component: str) -> Shelf:
        return self._shelves.get(component) or Shelf(component)

    # Opening

    def read_folders(self) -> None:
        """Find out what is there: remove leftovers, verify every file, keep what is intact."""
        with disk_trouble(f"read the store {self._root}"):
            for component, entry in inventory.intact_files(self._root, self._files, self._notice):
                self._add(component, entry)
            self._history.read()
        self.contents.mend()


def _after(entries: tuple[Entry, ...], beyond: Position | None) -> tuple[Entry, ...]:
    """The files of a chain after a position, all where none is named."""
    if beyond is None:
        return entries
    return next((entries[index + 1 :] for index, entry in enumerate(entries) if entry.position == beyond), ())


def open_store(
    root: Path, disk: Disk | None = None, retention: Retention = NOTHING_OLD, budget: PageBudget | None = None
) -> Store:
    """Open a store, or make an empty one; removes leftovers and verifies what is there.

    Args:
        retention: snapshots kept for people besides the needed ones; nothing.
        budget: for pages that are remembered to prove deltas by; others are read from the files.

    Raises:
        StoreError: another process has it open, or the folder cannot be used.
    """
    disk = disk or Disk()
    try:
        if not root.is_dir():
            root.parent.mkdir(parents=True, exist_ok=True)
            disk.make_folder(root)
            disk.sync_folder(root.parent)
        if why := why_not_ours(root.stat()):
            raise StoreError(f"cannot open the store {root}: {why}; give it to this user alone (chown, chmod go-w)")
        lock = lock_exclusively(root / LOCK_NAME)
    except OSError as error:
        raise StoreError(
            f"cannot open the store {root}: {error.strerror}; it must be a folder that this user may write"
        ) from error
    if lock is None:
        raise StoreError(f"cannot open the store {root}: another process has it open; one agent uses one store")
    store = Store(root, disk, lock, retention, budget or PageBudget(CACHE_SIZE))
    try:
        store.read_folders()
    except StoreError:
        store.close()
        raise
    return store
