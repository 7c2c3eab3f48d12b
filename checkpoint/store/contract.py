"""The contract of a store of snapshots: what the worker and programs that keep their state ask of one, and may count on.

`checkpoint.store.store` meets it with a directory. ``tests/contracts/test_snapshot_stores.py`` holds every implementation to it:

1. When `SnapshotStore.put` returns, the snapshot survives a power cut. Before that, nothing of it is seen.
2. A position is put once: a second put of the same one changes nothing.
3. A delta is taken only after its parent, and only where it leads to the state that its position names.
4. Nothing that is removed is needed to restore a position that is kept.
5. What was altered behind the store's back is not answered. The next older position that is intact counts then.
6. Answers do not wait for a put, a proof or a fold. Descriptors stay readable whatever is removed meanwhile.

Methods may be called from any thread. Each raises StoreError where the disk fails; what the store held is intact then.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from msgspec import Struct

from checkpoint.model import Position, Snapshot
from checkpoint.store.index import Entry


class Kept(Struct, frozen=True):
    """The store's content for one component, for people.

    Attributes:
        positions: that the rules may go back to; ``olds``: whole checkpoints besides, kept for people.
        size: bytes of all files; ``newest_s``, ``oldest_s``: when the first and the last of them came, in seconds since 1970.
    """

    positions: int
    olds: int
    size: int
    newest_s: float
    oldest_s: float


class ContentStore(Protocol):
    """Files that programs brought along, by the blake3 digest of their content (`checkpoint.store.content_store`)."""

    def has(self, digest: bytes, size: int) -> bool:
        """Whether a content of this digest, and so long, is kept."""
        ...

    def hold(self, digest: bytes, size: int) -> bool:
        """The same; it stays for a while then, also without a snapshot that names it."""
        ...

    def put(self, source: int, digest: bytes, *, own: bool = False) -> None:
        """Keep the content of a file; ``own``: nobody else can write to that file."""
        ...

    def open(self, digest: bytes) -> int:
        """A descriptor of a content, the caller's to close; StoreError where it is not kept."""
        ...


class SnapshotStore(Protocol):
    """The snapshots that one agent, or one program, keeps."""

    notices: list[str]
    """Files that were found damaged or left over: one sentence each."""

    @property
    def contents(self) -> ContentStore:
        """Files that programs brought along."""
        ...

    # Asking

    def components(self) -> tuple[str, ...]:
        """Everything of which there is a position to return to, by name."""
        ...

    def positions(self, component: str) -> tuple[Position, ...]:
        """The positions that can be restored, oldest first; () of a component that is not known."""
        ...

    def newest(self, component: str) -> Position | None:
        """The last of them."""
        ...

    def chain_of(self, component: str, position: Position | None = None) -> tuple[Entry, ...]:
        """The files that lead to a position (the newest, if none is named), a base first; StoreError where it is not held."""
        ...

    def open_chain(self, component: str, position: Position | None = None, *, beyond: Position | None = None) -> list[int]:
        """Descriptors of these files, the caller's to close; only those after ``beyond``, none where no chain leads over it."""
        ...

    def outline(self, component: str, entry: Entry, source: int) -> Snapshot:
        """A snapshot without its pages, from the descriptor of its file."""
        ...

    def is_made_last(self, component: str, entry: Entry) -> bool:
        """Whether `outline` of this file reads nothing."""
        ...

    def load(self, component: str, position: Position | None = None) -> Snapshot:
        """The state at a position as one base, verified and proved; the newest that is intact, if none is named."""
        ...

    def kept(self, component: str) -> Kept | None:
        """How much is stored of a component; None if nothing is."""
        ...

    # Keeping

    def unnamed(self) -> int:
        """A descriptor of an empty file that `put` need not copy, the caller's to close."""
        ...

    def put(self, source: int, *, prove: bool = True) -> Snapshot:
        """Keep a snapshot; answers with it, without its pages.

        Args:
            source: descriptor of the whole file; it stays the caller's.
            prove: compare the state that it leads to with its digest. Not needed where the snapshot was made here.

        Raises:
            FormatError: not a whole, unaltered snapshot.
            ChainError: promise 3; ask for a base.
        """
        ...

    def make_room(self, size: int) -> None:
        """Make room for so many bytes, as far as checkpoints that are kept for people can give it."""
        ...

    def check(self, component: str, position: Position | None = None) -> None:
        """Read what leads to a position again: after a restore found damage. What was altered is offered no more."""
        ...

    # Forgetting

    def is_prune_due(self, component: str, oldest: Position) -> bool:
        """Whether `prune` would do anything; no disk is asked."""
        ...

    def prune(self, component: str, oldest: Position) -> None:
        """Forget what is not needed to restore ``oldest`` or a later position. One that is not held forgets nothing."""
        ...

    def keep_newest(self, component: str, positions: int) -> None:
        """Forget all but the newest positions; as `prune`."""
        ...

    def fold(self, component: str, position: Position) -> None:
        """Write the state at a position as a base of its own, so that what it followed can go."""
        ...

    def discard(self, component: str, position: Position) -> None:
        """Forget one position that nothing continues; any other stays."""
        ...

    def set_aside(self, component: str, generations: Iterable[int]) -> Path | None:
        """Take generations out; their newest state is kept as one file for inspection, which is answered."""
        ...

    def drop(self, component: str) -> None:
        """Forget everything of a component."""
        ...

    def collect_contents(self) -> int:
        """Remove the brought files that no snapshot names any more; how many bytes that were."""
        ...

    def close(self) -> None:
        """Let another process have the store; nothing else may be called afterwards."""
        ...
