"""The contract of every tracker of written pages, and the mappings that it covers.

Trackers cover *private* mappings. Other processes can write to shared mappings without a trace in the page tables of this
process, and mappings of deleted files are carried whole: `checkpoint.linux.memory.digest_tracker.SharedPages` covers both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from msgspec import Struct

from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.pages.page_set import Words
from checkpoint.program import scratch_name

NONE: Final[Words] = np.empty((0, 2), dtype=np.uint64)
BOARD: Final = "[board]"
"""How a mapping of the team's board is told (`checkpoint.resources.ipc.boards`): pages of zeros where the program resumes."""
NOT_CARRIED: Final = frozenset(("[vdso]", "[vvar]", "[vvar_vclock]", "[vsyscall]", "[uprobes]", BOARD))
"""Mappings of the kernel's own, and of the board: made anew on restore."""


class Scan(Struct, frozen=True, eq=False):
    """The changes since the last scan.

    Attributes:
        written: pages to be read: written, or of unknown history.
        cleared: pages whose earlier content is forgotten; ``written`` comes on top.
    """

    written: Words
    cleared: Words


class Tracker(Protocol):
    """Finds written pages.

    Attributes:
        cost: what following with it costs a program, a clause.
        sees_every_write: a page that was changed and changed back counts as written. Otherwise a copy that was made between two
            scans cannot be used.
        scans_running: `backlog` and `catch_up` are there.
    """

    name: str
    cost: str
    sees_every_write: bool
    scans_running: bool

    @property
    def watched(self) -> Words:
        """Where the next scan names every page whose entry in the page tables has changed, guards included."""
        ...

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """Begin to follow: every page written from now on is in the next scan. The process may run."""
        ...

    def scan(self, lines: Sequence[MapsLine], *, changed: bool, everywhere: bool = False) -> Scan:
        """Find what was written since `arm` or the last scan, and begin anew. The process stands still.

        Args:
            lines: every private mapping that is followed, in address order.
            changed: whether the lines differ from those of the last call.
            everywhere: take the time to find all of it, so that `confirm` finds nothing.
        """
        ...

    def rehearse(self) -> None:
        """Ask, as far as that changes nothing, what `scan` is going to ask, and forget the answers."""
        ...

    def confirm(self) -> bool:
        """Whether the last `scan` has told everything; the process may run again. If not, the next one does."""
        ...

    def backlog(self, lines: Sequence[MapsLine], limit: int, *, changed: bool) -> int:
        """How many pages the next scan would find, about, and counted no further than ``limit``; the process may run."""
        ...

    def catch_up(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """As `scan`, while the process runs: pages written from now on, also during the call, are in the next scan.

        A page that is read after the call is as it will be found, unless the next scan names it as written or cleared.
        """
        ...

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """Pages that hold something of the process's own: neither holes nor a file's unchanged pages."""
        ...

    def close(self) -> None:
        """Stop following; the process is not changed."""
        ...


def is_private(line: MapsLine) -> bool:
    """Whether a mapping is one that trackers follow."""
    return not line.shared and line.name not in NOT_CARRIED and not is_orphan(line)


def is_orphan(line: MapsLine) -> bool:
    """Whether it is a private mapping of a file that has no name any more, as after a package was upgraded.

    The other robot has no file with its unchanged pages: all of them are carried, and compared as shared ones are.
    """
    return not line.shared and line.has_file and line.name.endswith(procfs.DELETED)


def is_shared(line: MapsLine) -> bool:
    """Whether its pages are shared memory that the snapshot carries: not those of a file that it may only read here.

    Such a mapping (glibc's gconv-modules.cache is one in many programs) has nothing that its file does not have, and the
    one that restores could not write to it.
    """
    from_its_file = line.has_file and not line.protection & abi.PROT_WRITE and not line.name.endswith(procfs.DELETED)
    return line.shared and line.name not in NOT_CARRIED and line.name != scratch_name.MAPPED and not from_its_file


MEMORY_PLACE: Final = "/dev/shm/"
"""Where files are memory (shm_overview(7)): on another machine they are missing."""


ANONYMOUS: Final = f"/dev/zero{procfs.DELETED}"
"""The kernel's name for shared memory without a file."""


def is_shared_anonymous(line: MapsLine) -> bool:
    """Whether it is shared memory without a file: a later child may have written pages that were never touched here."""
    return is_shared(line) and line.name == ANONYMOUS


def is_shared_object(line: MapsLine) -> bool:
    """Whether it is shared memory that may hold more than was touched through this mapping, and that no other machine has.

    A memory file (memfd), POSIX and System V shared memory, and any file that was deleted; anonymous memory is no file. The first
    System V segment after a boot has the inode number 0.
    """
    is_gone = line.name.endswith(procfs.DELETED) and line.name != ANONYMOUS
    return is_shared(line) and (is_gone or line.name.startswith(MEMORY_PLACE))


def extents_of(lines: Sequence[MapsLine]) -> Words:
    """The set of pages that mappings cover."""
    if not lines:
        return NONE
    array = np.array([(line.start, line.end) for line in lines], dtype=np.uint64)
    first = np.concatenate(([True], array[1:, 0] != array[:-1, 1]))
    last = np.concatenate((first[1:], [True]))
    return np.stack((array[first, 0], array[last, 1]), axis=1)
