"""Read the flags of each mapping beyond /proc/PID/maps: the kernel's two-letter codes (VmFlags), and codes of our own.

Ours: ``k1`` to ``kf`` for the protection key that the program chose (pkeys(7)), ``gb`` for huge pages of 1 GiB. Reading smaps
walks over all pages of a process, so it must never happen during a freeze.

Source: proc_pid_smaps(5).
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from typing import Final

from msgspec import Struct, field

from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine

Flags = Mapping[int, tuple[str, ...]]
"""Start of a mapping → its codes."""
HUGE: Final = "ht"
GIGANTIC: Final = "gb"
SEALED: Final = "sl"
DROPPABLE: Final = "dp"
MAY_WRITE: Final = "mw"
"""Its protection may be changed to allow writing: its file was open for that. Kept of shared mappings of files only."""
LOCKED, LOCKED_ON_FAULT = "lo", "lf"
WATCHED: Final = frozenset(("um", "uw"))
"""A userfaultfd watches it, or write-protects it: ours, or one of the program's own."""
_KEYS: Final = "123456789abcdef"
KEYS: Final = frozenset(f"k{digit}" for digit in _KEYS)
_EXECUTE_ONLY: Final = "--x"
"""The kernel itself gives such a mapping a key, and does so again when it is made again."""
_GIGANTIC_KB: Final = "1048576"

_LINE: Final = re.compile(
    r"^(?:([0-9a-f]+)-[0-9a-f]+ ([r-][w-][x-])[ps] |KernelPageSize: +(\d+) kB|ProtectionKey: +(\d+)|VmFlags: (.*))", re.MULTILINE
)


def parse(smaps: str) -> dict[int, tuple[str, ...]]:
    """Read /proc/PID/smaps."""
    found: dict[int, tuple[str, ...]] = {}
    start, protection = 0, ""
    extra: list[str] = []
    for match in _LINE.finditer(smaps):
        if match[1]:
            start, protection, extra = int(match[1], 16), match[2], []
        elif match[3] == _GIGANTIC_KB:
            extra.append(GIGANTIC)
        elif match[4] and match[4] != "0" and protection != _EXECUTE_ONLY:
            extra.append(f"k{int(match[4]):x}")
        elif match[5] is not None:
            found[start] = (*match[5].split(), *extra)
    return found


def key_in(flags: tuple[str, ...]) -> int:
    """The protection key of a mapping; 0 where it has none of its own."""
    return next((int(code[1:], 16) for code in flags if code in KEYS), 0)


REST: Final = 200
"""How many times as long as a reading took nothing is read again while the mappings stay: a reading delays a thread that maps."""
REST_S_MIN: Final = 5.0


class FlagsReader(Struct):
    """Reads one process's flags again when its mappings have changed, and now and then, for advice to a whole mapping changes
    nothing else.

    Attributes:
        flags: as they were when they were last read.
    """

    pid: int
    flags: Flags = field(default_factory=dict)
    _lines: tuple[MapsLine, ...] = ()
    _due_s: float = 0.0

    def refresh(self, lines: tuple[MapsLine, ...], *, anew: bool = False) -> None:
        """Read them, if there is a reason to.

        Args:
            lines: the mappings as they were read last.
            anew: read them in any case.
        """
        began = time.perf_counter()
        if lines == self._lines and began < self._due_s and not anew:
            return
        self.flags = parse(procfs.read_text(self.pid, "smaps"))
        self._lines = lines
        ended = time.perf_counter()
        self._due_s = ended + max(REST_S_MIN, REST * (ended - began))
