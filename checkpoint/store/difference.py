"""What has changed between two whole states of one program, as a delta: for who holds the former one elsewhere.

Of the former state its page table is enough: 24 bytes for each page. The delta proves itself as every delta does: its position's
digest covers the state to which it leads (`checkpoint.store.chain`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.errors import ChainError
from checkpoint.model import OutputPiece, PageRun, Position, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import PageTable, Words
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot import format
from checkpoint.snapshot.byte_sources import Source
from checkpoint.snapshot.process_tree import every_mapping
from checkpoint.store.chain import check_sum
from checkpoint.store.fold_rules import cut


class Known(Struct, frozen=True, eq=False):
    """What is remembered of a whole state.

    Attributes:
        ends: of the output of each stream, in bytes since its start.
        is_tree: it is of several processes.
    """

    epoch: int
    position: Position
    table: PageTable
    ends: Mapping[int, int]
    is_tree: bool


def known_of(base: Source) -> Known:
    """What to remember of a whole state; reads all of the file once.

    Raises:
        FormatError: the file is damaged.
        ChainError: its pages are not those of its position.
    """
    with format.streamed(base) as whole:
        outline = whole.outline
        nothing = PageTable.empty(outline.machine.page_size)
        table = nothing.apply_each((), outline.runs, whole.pieces, every_mapping(outline), outline.copies)
    check_sum(outline, table.page_sum)
    ends = {piece.stream: piece.offset + len(piece.content) for piece in outline.output}
    return Known(outline.epoch, outline.position, table, ends, outline.is_tree)


def difference(base: Source, after: Known, before: Known, pages_max: int) -> Snapshot | None:
    """The delta that leads from a state to a later one; None where a base is better, or none can be told.

    Args:
        base: the later state, of which ``after`` is known.
        pages_max: bytes of changed pages at most.

    Raises:
        FormatError: the file is damaged.
    """
    page_size = after.table.page_size
    is_kin = (before.epoch, before.table.page_size) == (after.epoch, page_size) and not (before.is_tree or after.is_tree)
    is_cut = any(end > after.ends.get(stream, 0) for stream, end in before.ends.items())  # its output begins anew
    if not is_kin or is_cut or _number(before) >= _number(after):
        return None
    addresses, former = after.table.pages.addresses, before.table.pages
    found, places = page_set.found_among(former.addresses, addresses)
    same = found.copy()
    same[found] = (former.words[places] == after.table.pages.words[found]).all(axis=1)
    changed = addresses[~same]
    if len(changed) * page_size > pages_max:
        return None
    stays, _ = page_set.found_among(addresses, former.addresses)
    outline, told, rows = format.read_pages(base, changed)
    if not told.all():
        raise ChainError(f"a page of {outline.component} is in the table of its state, and not in the state")
    return replace(
        outline,
        parent=before.position,
        runs=_runs(changed, page_size),
        cleared=_runs(former.addresses[~stays], page_size),
        contents=np.ascontiguousarray(rows).reshape(-1).data,
        output=tuple(_output_since(outline, before.ends)),
    )


def _output_since(outline: Snapshot, ends: Mapping[int, int]) -> Iterator[OutputPiece]:
    for piece in outline.output:
        end = ends.get(piece.stream, 0)
        if max(end, piece.offset) < piece.offset + len(piece.content):
            yield cut(piece, end)


def _number(known: Known) -> tuple[int, int]:
    return known.position.generation, known.position.sequence


def _runs(addresses: Words, page_size: int) -> tuple[PageRun, ...]:
    return page_set.page_runs(page_set.extents_of_addresses(addresses, page_size))
