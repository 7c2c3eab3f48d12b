"""When a chain is folded into a base of its own, how much of it at once, and how much output that base keeps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Final

from msgspec.structs import replace

from checkpoint.model import OutputPiece
from checkpoint.store.index import Entry

FOLD_DELTA_COUNT: Final = 64
"""A chain to the oldest wanted position with more deltas than this is folded: a restore reads them all, about 3 ms each."""

CHEAP_BASE_SIZE: Final = 16 << 20
CHEAP_DELTA_COUNT: Final = 12
"""…and where the base has no more bytes of pages than this, with more deltas than that: writing it again is cheaper than a slow
takeover. Compressed it may be small all the same: a fold reads, proves and writes every page, 2 ms of a processor for each MB."""

FOLD_DELTA_PART: Final = 0.5
"""…and one whose deltas together take more than this part of its base: otherwise the store would grow without end."""

FOLDED_AT_ONCE_SIZE: Final = 64 << 20
"""Bytes of the pages of deltas that a fold holds in memory; a chain with more is folded in several steps. Of a large base, which
takes long to write again, half as much as its own."""

FOLDED_OUTPUT_SIZE: Final = 1 << 20
"""Bytes of output of each stream that a folded base keeps; the whole is in the component's logs."""


def fold_is_due(entries: Sequence[Entry]) -> bool:
    """Whether a chain, a base first, has grown so long that its state is to be written as a base."""
    if not entries:
        return False
    base, deltas = entries[0], entries[1:]
    most = CHEAP_DELTA_COUNT if base.pages_size <= CHEAP_BASE_SIZE else FOLD_DELTA_COUNT
    return len(deltas) > most or sum(entry.size for entry in deltas) > FOLD_DELTA_PART * base.size


def held_at_once(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """The beginning of a chain, with one delta at least, whose deltas' pages may be held together; files hold them compressed."""
    return entries[: count_at_once([entry.pages_size for entry in entries])]


def count_at_once(pages_sizes: Sequence[int]) -> int:
    """How many of a chain's files `held_at_once` names; the first is the base."""
    limit = max(FOLDED_AT_ONCE_SIZE, int(FOLD_DELTA_PART * pages_sizes[0]))
    return 1 + max(sum(total <= limit for total in accumulate(pages_sizes[1:])), 1)


def newest_output(output: tuple[OutputPiece, ...]) -> tuple[OutputPiece, ...]:
    """The end of each stream, so that a base that was folded a thousand times does not carry all that was ever written."""
    ends = {piece.stream: piece.offset + len(piece.content) for piece in output}
    return tuple(
        cut(piece, ends[piece.stream] - FOLDED_OUTPUT_SIZE)
        for piece in output
        if piece.offset + len(piece.content) >= ends[piece.stream] - FOLDED_OUTPUT_SIZE
    )


def cut(piece: OutputPiece, first: int) -> OutputPiece:
    """The part of a piece from an offset of its stream on."""
    skipped = max(0, first - piece.offset)
    return replace(piece, offset=piece.offset + skipped, content=piece.content[skipped:])
