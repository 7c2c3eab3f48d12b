"""Where the pages of a chain's newest state come from: stored whole in one snapshot, changed by differences since. Pure."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from checkpoint.errors import ChainError
from checkpoint.model import Snapshot
from checkpoint.pages import page_set, xor_delta
from checkpoint.pages.merge import gathered_bytes
from checkpoint.pages.page_set import PageMap, Words
from checkpoint.pages.xor_delta import Rows
from checkpoint.runtime.lazy_numpy import NDArray, np
from checkpoint.snapshot.process_tree import every_mapping
from checkpoint.snapshot.validity import place


class Origins(Struct, frozen=True, eq=False):
    """The origins of one state's pages.

    Attributes:
        sources: for each page where it was last told whole: (index in the chain, index of the page there).
        changed: addresses, in order, of those that differences have changed since; ``differences``: all of them together, one
            row a page.
    """

    sources: PageMap
    changed: Words
    differences: Rows

    @classmethod
    def of(cls, chain: Sequence[Snapshot]) -> Origins:
        """The origins for a chain; a base needs no contents.

        Raises:
            ChainError: a page is told as the difference from one that is not there.
        """
        page_size = chain[-1].machine.page_size
        sources, layers = _newest_sources(chain, page_size)
        lasting = [layer.lasting(sources) for layer in layers]
        changed = page_set.distinct(np.concatenate([np.empty(0, dtype=np.uint64), *(layer.addresses for layer in lasting)]))
        together = np.zeros((len(changed), page_size), dtype=np.uint8)
        for layer in lasting:
            together[np.searchsorted(changed, layer.addresses)] ^= layer.rows[layer.places]
        return cls(sources, changed, together)

    def gathered(self, chain: Sequence[Snapshot], wanted: PageMap) -> NDArray[np.uint8]:
        """The bytes of some of the pages."""
        gathered = self.whole(chain, wanted)
        self.lay_on(gathered.reshape(-1, chain[-1].machine.page_size), wanted.addresses)
        return gathered

    def whole(self, chain: Sequence[Snapshot], wanted: PageMap) -> NDArray[np.uint8]:
        """The same, as they were last told whole."""
        return gathered_bytes([snapshot.contents for snapshot in chain], wanted, chain[-1].machine.page_size)

    def lay_on(self, rows: Rows, addresses: Words) -> None:
        """Bring pages that were told whole up to what has been told of them since.

        Args:
            rows: their bytes so far, one row a page, by their addresses, which are in order.
        """
        found, places = page_set.found_among(addresses, self.changed)
        rows[places] ^= self.differences[found]


class _Layer(Struct, frozen=True, eq=False):
    """The pages that one snapshot tells as differences.

    Attributes:
        index: of the snapshot in its chain.
        places: of ``addresses``, which are in order, among ``rows``, which are all of the snapshot's and not copied.
    """

    index: int
    addresses: Words
    places: NDArray[np.intp]
    rows: Rows

    def lasting(self, sources: PageMap) -> _Layer:
        """The part of it that no later snapshot has set or taken away."""
        found, places = page_set.found_among(sources.addresses, self.addresses)
        found[found] = sources.words[places, 0] < np.uint64(self.index)
        return _Layer(self.index, self.addresses[found], self.places[found], self.rows)


def _newest_sources(chain: Sequence[Snapshot], page_size: int) -> tuple[PageMap, list[_Layer]]:
    """For every page of the folded state where it was last told whole: (index in the chain, index of the page there).

    Returns:
        That, and the pages told as differences, oldest first.

    Raises:
        ChainError: a page is told as the difference from one that is not there.
    """
    state, mapped_before = PageMap.empty(), np.empty((0, 2), dtype=np.uint64)
    layers: list[_Layer] = []
    for index, snapshot in enumerate(chain):
        addresses = xor_delta.addresses_of(snapshot.runs, page_size)
        places = np.empty((len(addresses), 2), dtype=np.uint64)
        places[:, 0] = index
        places[:, 1] = np.arange(len(addresses))
        mapped = page_set.extents(every_mapping(snapshot))
        if snapshot.cleared or not np.array_equal(mapped, mapped_before):
            state, _ = state.without(mapped, page_set.extents(snapshot.cleared))
        mapped_before = mapped
        whole = np.ones(len(addresses), dtype=np.bool_)
        if snapshot.differences:
            layers.append(_layer_of(snapshot, index, addresses, page_size))
            whole = ~page_set.covered(page_set.extents(snapshot.differences), addresses)
            _check_there(snapshot, layers[-1].addresses, state.addresses)
        if snapshot.copies:
            copied, taken_from = page_set.copied_pages(snapshot.copies, addresses, page_size)
            state, _ = state.overlaid(copied, places[taken_from])
        state, _ = state.overlaid(addresses[whole], places[whole])
    return state, layers


def _layer_of(snapshot: Snapshot, index: int, carried: Words, page_size: int) -> _Layer:
    addresses = xor_delta.addresses_of(snapshot.differences, page_size)
    rows = xor_delta.rows_of(snapshot.contents, page_size)
    return _Layer(index, addresses, np.searchsorted(carried, addresses), rows)


def _check_there(snapshot: Snapshot, wanted: Words, held: Words) -> None:
    """Refuse a delta that tells a page as the difference from one that its parent's state does not hold.

    Args:
        wanted, held: addresses, in order.

    Raises:
        ChainError: names the first one.
    """
    found, _ = page_set.found_among(held, wanted)
    lacking = wanted[~found]
    if len(lacking):
        raise ChainError(
            f"delta {place(snapshot.position)} of {snapshot.component} tells the page at {int(lacking[0]):#x} as a difference "
            "from one that its parent does not hold; ask for a base"
        )
