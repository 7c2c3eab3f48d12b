"""Base and deltas: does a delta continue a chain, and what state do they add up to. No file, no clock.

A *chain* is a tuple of snapshots of one component: a base, then deltas, each the child of the one before it.

A delta changes the state of its parent in steps: pages outside its own mappings go, pages in ``cleared`` go, pages in
``runs`` are set, pages in ``copies`` as those that they name. A position's digest covers the result (``state_digest``), so a
fold proves itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from checkpoint import pages
from checkpoint.errors import ChainError
from checkpoint.gathering import gathered
from checkpoint.model import OutputPiece, PageCopy, Position, Snapshot
from checkpoint.pages import PageMap, PageTable
from checkpoint.state import state_digest
from checkpoint.tree import every_mapping
from checkpoint.validity import STREAMS, place

__all__ = ["append", "applied", "check_continues", "check_state", "fold", "position_of", "state_digest"]


def position_of(snapshot: Snapshot, generation: int, sequence: int) -> Position:
    """The position that a snapshot with this state and page sum has."""
    return Position(generation, sequence, state_digest(snapshot))


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
        raise ChainError(f"{named}, but with another state digest than ours: the histories diverged; ask for a base")
    raise ChainError(f"{named}, not {place(parent)}, which we hold; ask for a base")


def append(chain: Sequence[Snapshot], snapshot: Snapshot) -> tuple[Snapshot, ...]:
    """The chain that ends in ``snapshot``: a base begins a new one, a delta continues this one.

    A delta whose parent stands earlier in the chain replaces what came after it: its sender never heard that
    those were stored.

    Raises:
        ChainError: no snapshot of the chain is its parent, or it is of another component.
    """
    if snapshot.is_base:
        return (snapshot,)
    if not chain:
        raise ChainError(f"delta {place(snapshot.position)} of {snapshot.component} has no chain to continue; ask for a base")
    _check_kin(chain[-1], snapshot)
    places = [index for index, held in enumerate(chain) if held.position == snapshot.parent]
    if not places:
        check_continues(chain[-1].position, snapshot)
    return (*chain[: places[-1] + 1], snapshot)


def applied(table: PageTable, snapshot: Snapshot) -> PageTable:
    """The page table of a state after one more snapshot."""
    contents = memoryview(snapshot.contents)
    return table.apply(snapshot.cleared, snapshot.runs, contents, every_mapping(snapshot), snapshot.copies)


def check_state(snapshot: Snapshot, page_sum: bytes) -> None:
    """Refuse a snapshot that does not lead to the state that its position names.

    Args:
        page_sum: of the whole state with this snapshot applied, as ``PageTable.apply`` or ``fold`` counted it.

    Raises:
        ChainError: the state is not what the sender had; the cure is a new base.
    """
    named = f"position {place(snapshot.position)} of {snapshot.component}"
    if page_sum != snapshot.page_sum:
        raise ChainError(f"the pages do not add up to {named}: {_unequal(page_sum, snapshot.page_sum)}; ask for a base")
    digest = state_digest(snapshot)
    if digest != snapshot.position.digest:
        raise ChainError(f"the state is not that of {named}: {_unequal(digest, snapshot.position.digest)}; ask for a base")


def _unequal(found: bytes, expected: bytes) -> str:
    return f"{found.hex()} where {expected.hex()} belongs"


def fold(chain: Sequence[Snapshot]) -> Snapshot:
    """The base that holds the same state as a whole chain, with the newest position; proved by its digest.

    Output is joined from all snapshots, notes likewise. The work is linear in the memory's size and in the
    deltas' sizes: each page is copied once, from the newest snapshot that carries it.

    Args:
        chain: a base, then each delta, oldest first.

    Raises:
        ChainError: the snapshots do not follow one another, or do not add up to the newest position.
    """
    _check_chain(chain)
    newest = chain[-1]
    page_size = newest.machine.page_size
    sources = _newest_sources(chain, page_size)
    has_copies = newest.is_tree and any(snapshot.copies for snapshot in chain)  # one process alone has none
    carried, copies = _told_once(sources, page_size) if has_copies else (sources, ())
    contents = gathered([snapshot.contents for snapshot in chain], carried, page_size)
    runs = pages.page_runs(pages.extents_of_addresses(carried.addresses, page_size))
    check_state(newest, PageTable.empty(page_size).apply((), runs, contents, every_mapping(newest), copies).page_sum)
    return replace(
        newest,
        parent=None,
        cleared=(),
        runs=runs,
        contents=contents,
        copies=copies,
        output=_joined_output(chain),
        notes=tuple(dict.fromkeys(note for snapshot in chain for note in snapshot.notes)),
    )


def _told_once(sources: PageMap, page_size: int) -> tuple[PageMap, tuple[PageCopy, ...]]:
    """Pages that lie at different places, and copies of them: those that lie at the same one."""
    _, firsts, which = np.unique(sources.words, axis=0, return_index=True, return_inverse=True)
    source = sources.addresses[firsts[which.reshape(-1)]]
    is_copy = source != sources.addresses
    kept = PageMap(sources.addresses[~is_copy], sources.words[~is_copy])
    return kept, pages.copies_of(sources.addresses[is_copy], source[is_copy], page_size)


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


def _newest_sources(chain: Sequence[Snapshot], page_size: int) -> PageMap:
    """For every page of the folded state where its content lies: (index in the chain, index of the page there)."""
    state = PageMap.empty()
    for index, snapshot in enumerate(chain):
        addresses = pages.addresses_of(pages.extents(snapshot.runs), page_size)
        places = np.empty((len(addresses), 2), dtype=np.uint64)
        places[:, 0] = index
        places[:, 1] = np.arange(len(addresses))
        kept, _ = state.without(pages.extents(every_mapping(snapshot)), pages.extents(snapshot.cleared))
        state, _ = kept.overlaid(addresses, places)
        if snapshot.copies:
            copied, taken_from = pages.copied_pages(snapshot.copies, addresses, page_size)
            state, _ = state.overlaid(copied, places[taken_from])
    return state


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
