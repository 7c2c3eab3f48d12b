"""Look up single pages in a chain of snapshot files: reads only the frames that have them, not the whole state."""

from __future__ import annotations

from collections.abc import Sequence

from checkpoint.errors import ChainError
from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Flags, Words
from checkpoint.pages.xor_delta import Rows
from checkpoint.runtime.lazy_numpy import np
from checkpoint.snapshot import format
from checkpoint.snapshot.byte_sources import Source
from checkpoint.snapshot.process_tree import every_mapping


def pages_at(chain: Sequence[Source], wanted: Words, page_size: int) -> Rows:
    """The content of pages in the state that a chain leads to.

    Args:
        chain: files, a base first.
        wanted: addresses, in order.

    Raises:
        FormatError: one of the files is damaged.
        ChainError: the state holds no such page.
    """
    content = np.zeros((len(wanted), page_size), dtype=np.uint8)
    open_ones = np.arange(len(wanted))
    for source in reversed(chain):
        if not len(open_ones):
            break
        outline, found, rows = format.read_pages(source, wanted[open_ones])
        content[open_ones[found]] ^= rows
        is_whole = found & ~page_set.covered(page_set.extents(outline.differences), wanted[open_ones])
        _check_there(outline, wanted[open_ones[~is_whole]])
        open_ones = open_ones[~is_whole]
    if len(open_ones):
        raise ChainError(f"no snapshot of the chain holds the page at {int(wanted[open_ones[0]]):#x}; ask for a base")
    return content


def _check_there(outline: Snapshot, addresses: Words) -> None:
    """Refuse pages that the state before this snapshot may have held, but this one has taken away."""
    mapped: Flags = page_set.covered(page_set.extents(every_mapping(outline)), addresses)
    gone = ~mapped | page_set.covered(page_set.extents(outline.cleared), addresses)
    if gone.any():
        raise ChainError(
            f"the state of {outline.component} holds no page at {int(addresses[np.argmax(gone)]):#x}, which a later delta tells "
            "as a difference; ask for a base"
        )
