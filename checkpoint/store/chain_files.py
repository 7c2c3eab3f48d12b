"""The files of a chain read together: as one state in memory (`chain`), or written as the file of one base (`folding`).

A file that turns out to be damaged is set out of use. The answer is None then; another chain may lead to an older position.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from msgspec.structs import replace

from checkpoint.errors import ChainError, FormatError
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.snapshot.byte_sources import Source
from checkpoint.snapshot.canonical_state import header_of
from checkpoint.snapshot.format import Outlined
from checkpoint.snapshot.frames import Sink
from checkpoint.snapshot.layout import Preamble, SectionKind
from checkpoint.store import chain
from checkpoint.store.atomic_files import WholeFiles
from checkpoint.store.base_on_disk import stored_base, stored_chain
from checkpoint.store.disk import DiskFile
from checkpoint.store.fold_rules import count_at_once, newest_output
from checkpoint.store.folding import Folding
from checkpoint.store.index import Entry, file_name, folder_name

A = TypeVar("A")

NOTHING: Final[Mapping[Path, Outlined | None]] = {}

KNOWN_COUNT: Final = 256
"""Deltas of which the outline stays in memory until they are folded; of more components than four others are read again."""

KNOWN_RUNS: Final = 128
KNOWN_OUTPUT: Final = 4 << 10
KNOWN_STATE: Final = 64 << 10
"""Runs of all kinds, bytes of output, and bytes of the state section, of one of these at most."""

KNOWN_STATES: Final = 8 << 20
"""Bytes of all state sections of these: in memory twice as much, where no two have the same mappings."""


class ChainFiles:
    """Reads chains of the store at ``root``. Methods may be called from any thread.

    Args:
        set_out_of_use: called with (component, file, why) for a file that is damaged.
    """

    def __init__(self, root: Path, files: WholeFiles, set_out_of_use: Callable[[str, Entry, str], None]) -> None:
        self._root = root
        self._files = files
        self._set_out_of_use = set_out_of_use
        self._known: dict[Path, Outlined] = {}
        self._states_size = 0

    def know(self, path: Path, preamble: Preamble, outline: Snapshot) -> None:
        """Keep what a fold asks of a file that has just been verified, where that is little."""
        self.forget(path)
        output_size = sum(len(piece.content) for piece in outline.output)
        runs = len(outline.runs) + len(outline.cleared) + len(outline.copies) + len(outline.differences) + len(outline.notes)
        if outline.parent is None or outline.is_tree or runs > KNOWN_RUNS or output_size > KNOWN_OUTPUT:
            return
        if (size := _state_size(preamble)) > KNOWN_STATE:
            return
        self._known[path] = preamble, replace(outline, threads=(), resources=())
        self._states_size += size
        for oldest in list(self._known):
            if len(self._known) <= KNOWN_COUNT and self._states_size <= KNOWN_STATES:
                break
            self.forget(oldest)

    def forget(self, path: Path) -> None:
        """A file goes."""
        if (known := self._known.pop(path, None)) is not None:
            self._states_size -= _state_size(known[0])

    def load(self, component: str, entries: tuple[Entry, ...]) -> Snapshot | None:
        """The state that a chain leads to, or None when a file of it had to be set out of use."""
        snapshots = self._all_decoded(component, entries)
        if snapshots is None:
            return None
        try:
            return chain.fold(snapshots)
        except ChainError as error:
            self._set_out_of_use(component, entries[-1], str(error))
            return None

    def write_base(self, component: str, entries: tuple[Entry, ...]) -> Entry | None:
        """Write a chain as one base, or answer None when a file of it had to be set out of use.

        Raises:
            FormatError: what it amounts to cannot be written; its files are not to blame, and stay.
        """
        deltas = self._all_decoded(component, entries[1:], {entry.path: self._known.get(entry.path) for entry in entries[1:-1]})
        is_tree = self._read(component, entries, lambda: format.is_of_several_processes(entries[0].path))
        if deltas is None or is_tree is None:
            return None
        if deltas and not is_tree and not any(delta.is_tree for delta in deltas):
            return self._write_straight(component, entries, deltas)
        whole = self._read(component, entries, lambda: chain.fold([format.decode(entries[0].path), *deltas]))
        if whole is None:
            return None
        folded = replace(whole, output=newest_output(whole.output))
        return self._write(folded, lambda file: format.encode(folded, file))

    def _all_decoded(
        self, component: str, entries: tuple[Entry, ...], known: Mapping[Path, Outlined | None] = NOTHING
    ) -> list[Snapshot] | None:
        """All of these files, or None when one of them had to be set out of use."""
        snapshots = []
        for entry in entries:
            try:
                snapshots.append(format.decode(entry.path, known=known.get(entry.path)))
            except FormatError as error:
                self._set_out_of_use(component, entry, str(error))
                return None
        return snapshots

    def _write_straight(self, component: str, entries: tuple[Entry, ...], deltas: list[Snapshot]) -> Entry | None:
        """The same of one process, frame by frame."""
        with contextlib.ExitStack() as open_files:
            stored = self._read(component, entries, lambda: open_files.enter_context(stored_chain(entries[0].path, deltas)))
            if stored is None:
                return None
            folded = replace(stored.outline, output=newest_output(stored.outline.output))
            folding = Folding(stored, folded)
            return self._read(component, entries, lambda: self._write(folded, folding.write))

    def _read(self, component: str, entries: tuple[Entry, ...], act: Callable[[], A]) -> A | None:
        """The answer of an act that reads a chain's base, or None when a file had to be set out of use."""
        try:
            return act()
        except FormatError as error:
            self._set_out_of_use(component, entries[0], str(error))
        except ChainError as error:
            self._set_out_of_use(component, entries[-1], str(error))
        return None

    def _write(self, folded: Snapshot, write: Callable[[DiskFile], int]) -> Entry:
        final = self._root / folder_name(folded.component) / file_name(header_of(folded))
        return entry_of(final, folded, self._files.write(final, write))


def fold_to(file: Sink, *sources: Source) -> None:
    """Write the state that a chain leads to as one base, to an empty file; nothing is set out of use here.

    All deltas are in memory meanwhile: `fold_rules.count_at_once`.

    Raises:
        FormatError, ChainError: a file of it is damaged, or it is no chain.
        OSError: the file does not take it.
    """
    if len(sources) > 1 and not any(map(format.is_of_several_processes, sources)):
        with stored_base(*sources) as stored:
            Folding(stored, replace(stored.outline, output=newest_output(stored.outline.output))).write(file)
    else:
        whole = chain.fold([format.decode(source) for source in sources])
        format.encode(replace(whole, output=newest_output(whole.output)), file)


@contextlib.contextmanager
def folded_in_steps(chain: Sequence[int], aside: Path) -> Iterator[BinaryIO]:
    """A file of the state that a chain of open files leads to, as one base; no more deltas at once in memory than a store folds.

    Args:
        aside: a folder for files without a name.

    Raises:
        FormatError, ChainError, OSError: as `fold_to`.
    """
    deltas, sizes = list(chain[1:]), [_pages_size(one) for one in chain[1:]]
    with contextlib.ExitStack() as files:
        base: BinaryIO = files.enter_context(open(chain[0], "rb", buffering=0, closefd=False))
        while deltas:
            count = count_at_once([_pages_size(base.fileno()), *sizes]) - 1
            folded = files.enter_context(tempfile.TemporaryFile(dir=aside))
            fold_to(folded, base.fileno(), *deltas[:count])
            folded.flush()
            base.close()
            base = folded
            del deltas[:count], sizes[:count]
        yield base


def _pages_size(snapshot: int) -> int:
    return sum(run.size for run in format.read_outline(snapshot).runs)


def entry_of(path: Path, snapshot: Snapshot, size: int) -> Entry:
    """A file that has just been written."""
    pages_size = sum(run.size for run in snapshot.runs)
    return Entry(path, snapshot.position, snapshot.parent, snapshot.epoch, size, time.time(), pages_size)


def _state_size(preamble: Preamble) -> int:
    return next(section.raw_size for section in preamble.sections if section.kind is SectionKind.STATE)
