"""A power cut at any instant of a store's life: every acknowledged snapshot is there afterwards."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass, field
from pathlib import Path

from checkpoint.model import Position
from checkpoint.store import chain
from checkpoint.store.disk import Disk
from checkpoint.store.store import Store
from tests.checkpoint.snapshots import COMPONENT, history, page, pages_of, snapshot
from tests.checkpoint.store.test_store import opened, put


class PowerCutError(BaseException):
    """The lights went out; no code of the store may handle it."""


@dataclass
class Inode:
    content: bytearray = field(default_factory=bytearray)
    synced: bytes = b""


Names = dict[Path, "Inode | None"]
"""None: a folder."""


class CuttingDisk(Disk):
    """A real disk that remembers what a power cut could leave of it, and cuts before its n-th change.

    Content is safe after `sync_file`; a name (made, moved, removed) after `sync_folder` of its folder. Until then it may be
    all there, not at all, or the first part of it.
    """

    def __init__(self, cut_at: int) -> None:
        super().__init__()
        self.countdown = cut_at
        self.safe: Names = {}
        self.pending: dict[Path, list[tuple[Path, Inode | None, bool]]] = {}
        self.now: Names = {}
        self.open: dict[int, Inode] = {}

    def _step(self) -> None:
        if self.countdown == 0:
            raise PowerCutError
        self.countdown -= 1

    def _change(self, path: Path, inode: Inode | None, *, there: bool) -> None:
        self.pending.setdefault(path.parent, []).append((path, inode, there))
        if there:
            self.now[path] = inode
        else:
            self.now.pop(path, None)

    def make_folder(self, path: Path) -> None:
        self._step()
        super().make_folder(path)
        self._change(path, None, there=True)

    def create(self, path: Path) -> int:
        self._step()
        descriptor = super().create(path)
        self.open[descriptor] = Inode()
        self._change(path, self.open[descriptor], there=True)
        return descriptor

    def write(self, descriptor: int, content: bytes | memoryview) -> int:
        self._step()
        self.open[descriptor].content += content
        return super().write(descriptor, content)

    def sync_file(self, descriptor: int) -> None:
        if os.readlink(f"/proc/self/fd/{descriptor}").startswith("/memfd:"):
            return
        self._step()
        self.open[descriptor].synced = bytes(self.open[descriptor].content)

    def rename(self, old: Path, new: Path) -> None:
        self._step()
        super().rename(old, new)
        inode = self.now[old]
        self._change(new, inode, there=True)
        self._change(old, inode, there=False)

    def remove(self, path: Path) -> None:
        self._step()
        super().remove(path)
        if path in self.now:
            self._change(path, self.now[path], there=False)

    def sync_folder(self, path: Path) -> None:
        self._step()
        for name, inode, there in self.pending.pop(path, []):
            self._apply(self.safe, name, inode, there)

    @staticmethod
    def _apply(names: Names, name: Path, inode: Inode | None, there: bool) -> None:
        if there:
            names[name] = inode
        else:
            names.pop(name, None)

    def left(self, names_written: str, content_written: str) -> dict[Path, bytes | None]:
        """What is on the disk when the power returns.

        Args:
            names_written, content_written: "all", "half" or "none" of what was not safe.
        """
        names = dict(self.safe)
        for changes in self.pending.values():
            count = {"all": len(changes), "half": (len(changes) + 1) // 2, "none": 0}[names_written]
            for name, inode, there in changes[:count]:
                self._apply(names, name, inode, there)
        return {name: None if inode is None else self._content(inode, content_written) for name, inode in names.items()}

    @staticmethod
    def _content(inode: Inode, written: str) -> bytes:
        fresh = bytes(inode.content[len(inode.synced) :])
        return inode.synced + {"all": fresh, "half": fresh[: len(fresh) // 2], "none": b""}[written]


def laid_out(left: dict[Path, bytes | None], old: Path, new: Path) -> None:
    """Make what a power cut left, under another root; a name in a folder that is gone is gone too."""
    for path in sorted(left):
        place, content = new / path.relative_to(old), left[path]
        if not place.parent.is_dir():
            continue
        if content is None:
            place.mkdir(exist_ok=True)
        else:
            place.write_bytes(content)


def a_life(store: Store, acknowledged: list[Position]) -> None:
    """Everything that a standby does with its store; what it has acknowledged is noted at once."""
    made = history(3)
    for one in made:
        put(store, one)
        acknowledged.append(one.position)
    store.fold(COMPONENT, made[1].position)
    store.prune(COMPONENT, made[1].position)
    later = snapshot({1: page("later")}, generation=2)
    put(store, later)
    acknowledged.append(later.position)
    store.keep_newest(COMPONENT, 1)


def a_life_cut_short(root: Path, cut_at: int) -> tuple[CuttingDisk, list[Position]] | None:
    """None when it came to its end before the cut."""
    disk, acknowledged = CuttingDisk(cut_at), []
    disk.now[root.parent] = disk.safe[root.parent] = None
    try:
        with opened(root, disk) as store:
            a_life(store, acknowledged)
    except PowerCutError:
        return disk, acknowledged
    return None


def test_power_may_go_at_any_instant(tmp_path: Path) -> None:
    full = {one.position: pages_of(chain.fold(history(3)[: index + 1])) for index, one in enumerate(history(3))}
    later = snapshot({1: page("later")}, generation=2)
    full[later.position] = pages_of(later)
    for cut_at in itertools.count():
        old = tmp_path / f"old{cut_at}"
        old.mkdir()
        cut = a_life_cut_short(old / "store", cut_at)
        if cut is None:
            break
        disk, acknowledged = cut
        for names_written, content_written in itertools.product(("all", "half", "none"), repeat=2):
            new = tmp_path / f"new{cut_at}-{names_written}-{content_written}"
            new.mkdir()
            laid_out(disk.left(names_written, content_written), old, new)
            with opened(new / "store") as store:
                where = f"cut before change {cut_at}, names {names_written}, content {content_written}: {store.notices}"
                if acknowledged:
                    newest = store.newest(COMPONENT)
                    assert newest is not None, where
                    assert newest >= acknowledged[-1], where
                for position in store.positions(COMPONENT):
                    assert pages_of(store.load(COMPONENT, position)) == full[position], where
    assert cut_at > 30
