"""Check whether a delta continues a chain, and fold a base and its deltas into one state. Uses no file and no clock.

A *chain* is a tuple of snapshots of one component: a base, then deltas, each the child of the one before it.

A delta changes the state of its parent in steps: pages outside its own mappings go, pages in ``cleared`` go, pages in ``runs``
are set (those in ``differences`` to the present bytes XOR theirs), pages in ``copies`` as those that they name. A position's
digest covers the result (``state_digest``), so a fold proves itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

from msgspec.structs import replace

from checkpoint.errors import ChainError
from checkpoint.model import OutputPiece, PageCopy, Position, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Buffer, PageMap, PageTable
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot.canonical_state import digest_of_state, state_digest
from checkpoint.snapshot.process_tree import every_mapping
from checkpoint.snapshot.validity import STREAMS, place
from checkpoint.store.page_origins import Origins

__all__ = ["applied", "check_continues", "check_state", "fold", "position_of", "state_digest"]


def position_of(snapshot: Snapshot, generation: int, sequence: int, packed: bytes = b"") -> Position:
    """The position that a snapshot with this state and page sum has.

    Args:
        packed: its encoded state (`canonical_state.encode_state`), where that is at hand.
    """
    digest = digest_of_state(snapshot.page_sum, packed) if packed else state_digest(snapshot)
    return Position(generation, sequence, digest)


def check_continues(parent: Position, delta: Snapshot) -> None:
    """Refuse a delta that is not the child of ``parent``.

    Raises:
        ChainError: says both positions; the cure is always a new base.
    """
    if delta.parent is None:
        raise ChainError(f"snapshot {place(delta.position)} of {delta.component} is a base: it begins a chain and continues none")
    if delta.parent == parent:
        return
    named = f"delta {place(delta.position)} of {delta.component} continues {place(delta.parent)}"
    if (delta.parent.generation, delta.parent.sequence) == (parent.generation, parent.sequence):
        raise ChainError(f"{named}, but with another state digest than the one here: the histories diverged; ask for a base")
    raise ChainError(f"{named}, not {place(parent)}, which is held here; ask for a base")


def applied(table: PageTable, outline: Snapshot, pieces: Iterable[Buffer]) -> PageTable:
    """The page table of a state after one more snapshot.

    Args:
        outline: all but its pages; ``pieces``: those, told whole (`checkpoint.pages.xor_delta.resolved_each`).
    """
    return table.apply_each(outline.cleared, outline.runs, pieces, every_mapping(outline), outline.copies)


def check_state(snapshot: Snapshot, page_sum: bytes, digest: bytes = b"") -> None:
    """Refuse a snapshot that does not lead to the state that its position names.

    Args:
        page_sum: of the whole state with this snapshot applied, as ``PageTable.apply`` or ``fold`` counted it.
        digest: `state_digest` of it, where that is known.

    Raises:
        ChainError: the state is not what the sender had; the cure is a new base.
    """
    check_sum(snapshot, page_sum)
    _check_digest(snapshot, digest)


def check_sum(snapshot: Snapshot, page_sum: bytes) -> None:
    """Refuse pages that are not those of a snapshot. Raises and arguments as `check_state`."""
    if page_sum != snapshot.page_sum:
        wrong = _unequal(page_sum, snapshot.page_sum)
        raise ChainError(f"the pages do not add up to {_named(snapshot)}: {wrong}; ask for a base")


def _check_digest(snapshot: Snapshot, digest: bytes = b"") -> None:
    digest = digest or state_digest(snapshot)
    if digest != snapshot.position.digest:
        wrong = _unequal(digest, snapshot.position.digest)
        raise ChainError(f"the state is not that of {_named(snapshot)}: {wrong}; ask for a base")


def _named(snapshot: Snapshot) -> str:
    return f"position {place(snapshot.position)} of {snapshot.component}"


def _unequal(found: bytes, expected: bytes) -> str:
    return f"{found.hex()} where {expected.hex()} belongs"


def fold(chain: Sequence[Snapshot]) -> Snapshot:
    """The base that holds the same state as a whole chain, with the newest position; proved by its digest.

    Output is joined from all snapshots, notes likewise. The work is linear in the memory's size and in the
    deltas' sizes: each page is copied once, from the newest snapshot that carries it; a base alone is not copied.

    Args:
        chain: a base, then each delta, oldest first.

    Raises:
        ChainError: the snapshots do not follow one another, or do not add up to the newest position.
    """
    _check_chain(chain)
    newest = chain[-1]
    page_size = newest.machine.page_size
    if len(chain) == 1:  # all of it is where it belongs already
        nothing = PageTable.empty(page_size)
        check_sum(newest, nothing.apply((), newest.runs, newest.contents, every_mapping(newest), newest.copies).page_sum)
        return by_itself(newest)
    origins = Origins.of(chain)
    has_copies = newest.is_tree and any(snapshot.copies for snapshot in chain)  # one process alone has none
    carried, copies = _told_once(origins, page_size) if has_copies else (origins.sources, ())
    contents = origins.gathered(chain, carried).data.toreadonly()
    runs = page_set.page_runs(page_set.extents_of_addresses(carried.addresses, page_size))
    check_state(newest, PageTable.empty(page_size).apply((), runs, contents, every_mapping(newest), copies).page_sum)
    return replace(_joined(chain), runs=runs, contents=contents, copies=copies)


def _joined(chain: Sequence[Snapshot]) -> Snapshot:
    """A whole chain as one base, but for its pages."""
    return replace(
        chain[-1],
        parent=None,
        cleared=(),
        differences=(),
        output=_joined_output(chain),
        notes=tuple(dict.fromkeys(note for snapshot in chain for note in snapshot.notes)),
    )


def outlined(chain: Sequence[Snapshot]) -> tuple[Snapshot, Origins]:
    """As `fold`, but for the pages, which remain to be put together and to be proved (`check_sum`).

    Args:
        chain: of one process; the base needs no contents.

    Raises:
        ChainError: as `fold`.
    """
    _check_chain(chain)
    _check_digest(chain[-1])
    origins = Origins.of(chain)
    runs = page_set.page_runs(page_set.extents_of_addresses(origins.sources.addresses, chain[-1].machine.page_size))
    return replace(_joined(chain), runs=runs, contents=b""), origins


def by_itself(base: Snapshot) -> Snapshot:
    """As `fold`, of a base that nothing continues: the pages, which may be elsewhere, remain to be proved (`check_sum`).

    Raises:
        ChainError: it is no base, or not the state that its position names.
    """
    _check_chain((base,))
    _check_digest(base)
    return _joined((base,))


def _told_once(origins: Origins, page_size: int) -> tuple[PageMap, tuple[PageCopy, ...]]:
    """Pages that lie at different places, and copies of them: those that lie at the same one, and that no difference changes."""
    sources = origins.sources
    own = np.where(np.isin(sources.addresses, origins.changed, assume_unique=True), sources.addresses, np.uint64(0))
    words = np.column_stack((sources.words, own))
    _, firsts, which = np.unique(words, axis=0, return_index=True, return_inverse=True)
    source = sources.addresses[firsts[which.reshape(-1)]]
    is_copy = source != sources.addresses
    kept = PageMap(sources.addresses[~is_copy], sources.words[~is_copy])
    return kept, page_set.copies_of(sources.addresses[is_copy], source[is_copy], page_size)


def _check_chain(chain: Sequence[Snapshot]) -> None:
    """A base first, then children only, all of one component."""
    if not chain:
        raise ChainError("cannot fold: there is no snapshot")
    if not chain[0].is_base:
        raise ChainError(f"cannot fold {chain[0].component}: {place(chain[0].position)}, the oldest snapshot, is not a base")
    for parent, delta in pairwise(chain):
        _check_kin(parent, delta)
        check_continues(parent.position, delta)


def _check_kin(parent: Snapshot, delta: Snapshot) -> None:
    if parent.component != delta.component:
        raise ChainError(f"snapshot {place(delta.position)} is of {delta.component}, the chain is of {parent.component}")
    if parent.machine.page_size != delta.machine.page_size:
        raise ChainError(
            f"snapshot {place(delta.position)} of {delta.component} has pages of {delta.machine.page_size} bytes, "
            f"the chain of {parent.machine.page_size}; ask for a base"
        )


def _joined_output(chain: Sequence[Snapshot]) -> tuple[OutputPiece, ...]:
    """The output of the whole chain: pieces of one stream that follow one another become one."""
    joined: list[OutputPiece] = []
    for stream in STREAMS:
        pieces = [piece for snapshot in chain for piece in snapshot.output if piece.stream == stream]
        joined += _joined_pieces(pieces)
    return tuple(joined)


def _joined_pieces(pieces: list[OutputPiece]) -> list[OutputPiece]:
    """Pieces of one stream, in order.

    Raises:
        ChainError: one begins before the one before it ends.
    """
    stretches: list[tuple[OutputPiece, list[bytes]]] = []
    end = 0
    for piece in pieces:
        if piece.offset < end:
            raise ChainError(f"output of stream {piece.stream} overlaps at offset {piece.offset}; ask for a base")
        if not stretches or piece.offset != end:
            stretches.append((piece, []))
        stretches[-1][1].append(piece.content)
        end = piece.offset + len(piece.content)
    return [replace(first, content=b"".join(contents)) for first, contents in stretches]
