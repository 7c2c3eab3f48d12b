"""Read the mappings of one process repeatedly: as text while it runs, and by a comparison while it is frozen.

During a freeze the reader only asks whether the mappings are still the same, which takes a third of the time.

Source: proc_pid_maps(5); PROCMAP_QUERY, linux/fs.h (Linux 6.11).
"""

from __future__ import annotations

import contextlib
import errno
import os
from typing import Final

import numpy as np

from checkpoint.errors import CaptureError, ProbeError
from checkpoint.linux.batch_syscalls import OwnCalls, row
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine, parse_maps_line

PROCMAP_QUERY: Final = 0xC0686611
COVERING_OR_NEXT: Final = 0x10
SIZE, FLAGS, ADDRESS, START, END, ACCESS, PAGE_SIZE, OFFSET, INODE, DEVICE = range(10)
"""Words of struct procmap_query that are used."""
WORDS: Final = 13
SHARED: Final = 8
NONE_THERE: Final = -errno.ENOENT
VSYSCALL: Final = "[vsyscall]"
"""Stands in every text of some processors, and is no mapping of the process."""


class MapsReader:
    """Reads one process's maps; lines that did not change are not parsed again.

    Attributes:
        lines: the mappings, by the last reading.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._text = b""
        self._lines: dict[bytes, MapsLine] = {}
        self._question: _Question | None = None
        self._file: int | None = None
        self._is_asked = True
        self.lines: tuple[MapsLine, ...] = ()

    def close(self) -> None:
        """Give the descriptor back."""
        self._question = None
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def refresh(self) -> bool:
        """Read the maps; answers whether anything changed. ``lines`` then holds the present mappings."""
        text = procfs.read_bytes(self._pid, "maps")
        if text == self._text:
            return False
        known = self._lines
        fresh = {}
        for line in filter(None, text.split(b"\n")):  # see `procfs.lines_of`
            fresh[line] = known.get(line) or parse_maps_line(os.fsdecode(line))
        self._text, self._lines, self.lines = text, fresh, tuple(fresh.values())
        self._question = None
        return True

    def prepare(self) -> None:
        """Have the question ready that `refresh_if_moved` asks."""
        if self._question is not None or not self._is_asked or not self._text:
            return
        with contextlib.suppress(CaptureError, ProbeError):  # the next reader reports the cause
            if self._file is None:
                self._file = procfs.opened(self._pid, "maps")
            self._question = _Question(self._file, self.lines)

    def rehearse(self) -> None:
        """Ask as `refresh_if_moved`, and forget the answer."""
        if self._question is not None:
            self._question.is_answered_as_expected()

    def refresh_if_moved(self) -> bool:
        """As `refresh`, unless every mapping is where and what it was; only what it is called may have changed since."""
        if self._question is None:
            return self.refresh()
        if self._question.is_answered_as_expected():
            return False
        has_changed = self.refresh()
        if not has_changed:  # this kernel has no such question, or tells otherwise than in its text
            self.close()
            self._is_asked = False
        return has_changed


class _Question:
    """Whether a process still has exactly these mappings, and nothing between them: one call for each, made in one go.

    Args:
        file: its maps, open.
        lines: as they were read.
    """

    def __init__(self, file: int, lines: tuple[MapsLine, ...]) -> None:
        own = [line for line in lines if line.name != VSYSCALL]
        self._answers = np.zeros((len(own) + 1, WORDS), dtype=np.uint64)
        self._results = np.zeros(len(own) + 1, dtype=np.int64)
        self._answers[:, SIZE] = WORDS * 8
        self._answers[:, FLAGS] = COVERING_OR_NEXT
        self._answers[1:, ADDRESS] = [line.end for line in own]
        place, results = int(self._answers.ctypes.data), int(self._results.ctypes.data)
        size = self._answers.itemsize * WORDS
        self._calls = OwnCalls(
            [row("ioctl", file, PROCMAP_QUERY, place + index * size, to=results + 8 * index) for index in range(len(own) + 1)]
        )
        told = [_words_of(line) for line in own]
        expected = self._answers.copy()
        expected[:-1, START : DEVICE + 1] = np.array(told, dtype=np.uint64).reshape(len(own), DEVICE + 1 - START)
        self._expected = expected.tobytes()
        self._expected_results = np.array([0] * len(own) + [NONE_THERE], dtype=np.int64).tobytes()

    def is_answered_as_expected(self) -> bool:
        """Ask it."""
        self._calls.run()
        self._answers[:, PAGE_SIZE] = 0  # the text does not tell
        return self._results.tobytes() == self._expected_results and self._answers.tobytes() == self._expected


def _words_of(line: MapsLine) -> tuple[int, ...]:
    """The kernel's answer about one mapping."""
    device = os.major(line.device) | os.minor(line.device) << 32
    access = line.protection | SHARED * line.shared
    return line.start, line.end, access, 0, line.offset, line.inode, device
