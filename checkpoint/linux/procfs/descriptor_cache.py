"""Cache the descriptors of a process across captures: one batch asks the kernel the same questions about all of them.

An answer that is the same as at the last capture means the same as then, and is not decoded again.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, ROW, OwnCalls, row
from checkpoint.linux.procfs.descriptor import Descriptor, Standing, head_of, standing_of

TEXTS_KEPT: Final = 256
"""Files of fdinfo that stay open for one process: we may have 1,024 descriptors ourselves (RLIMIT_NOFILE)."""
TEXT_SIZE: Final = 1024
LINK_SIZE: Final = 512
STAT_SIZE: Final = 144
"""Bytes of an answer that is taken this way: longer ones are read one by one. Of struct stat as long as any processor's."""
_NAME_SIZE: Final = 16


class _Column:
    """One call about each of some descriptors. The table has no gaps, also after descriptors come and go."""

    def __init__(self, call: str, size: int) -> None:
        self._call = call
        self._size = size
        self._answers = np.zeros(TEXTS_KEPT * size, dtype=np.uint8)
        self._names = np.zeros(TEXTS_KEPT * _NAME_SIZE, dtype=np.uint8)
        self._results = np.zeros(TEXTS_KEPT, dtype=np.int64)
        self._table = OwnCalls(TEXTS_KEPT)
        self._places: dict[int, int] = {}
        self._told, self._result = self._answers.data, self._results.data

    def __contains__(self, number: int) -> bool:
        return number in self._places

    def put(self, number: int, descriptor: int) -> None:
        """Ask about one more.

        Args:
            descriptor: of ours: its file of fdinfo, or the directory in which it has its name.
        """
        place = self._places[number] = len(self._places)
        answer, to = int(self._answers.ctypes.data) + place * self._size, int(self._results.ctypes.data) + 8 * place
        if self._call == "pread64":
            self._table.entries[place] = row("pread64", descriptor, answer, self._size, 0, to=to)
            return
        name = int(self._names.ctypes.data) + place * _NAME_SIZE
        self._name(place, number)
        last = self._size if self._call == "readlinkat" else 0
        self._table.entries[place] = row(self._call, descriptor, name, answer, last, to=to)

    def _name(self, place: int, number: int) -> None:
        self._names[place * _NAME_SIZE : (place + 1) * _NAME_SIZE] = np.frombuffer(b"%-15d\0" % number, dtype=np.uint8)
        end = place * _NAME_SIZE + len(str(number))
        self._names[end] = 0

    def drop(self, number: int) -> None:
        """Ask about one no more: the last one takes its place."""
        place = self._places.pop(number, None)
        if place is None or place == len(self._places):
            return
        moved = next(number for number, last in reversed(self._places.items()) if last == len(self._places))
        self._places[moved] = place
        if self._call == "pread64":
            self._table.cells[place * ROW + FIRST_ARGUMENT] = self._table.cells[len(self._places) * ROW + FIRST_ARGUMENT]
        else:
            self._name(place, moved)

    def ask(self) -> None:
        """Ask about all."""
        self._table.run(0, len(self._places))

    def has_every_answer(self) -> bool:
        """Whether none of the calls was refused."""
        return not (self._results[: len(self._places)] < 0).any()

    def heard(self) -> bytes:
        """All answers as they are: the same bytes, of the same descriptors, mean the same."""
        count = len(self._places)
        return self._results[:count].tobytes() + self._answers[: count * self._size].tobytes()

    def told(self, number: int) -> bytes | None:
        """The answer about one; None for nothing, an error, and an answer that is too long."""
        place = self._places.get(number)
        if place is None:
            return None
        size = self._size if self._call == "newfstatat" and not self._result[place] else self._result[place]
        if size < 0 or (size == self._size and self._call != "newfstatat"):
            return None
        return bytes(self._told[place * self._size : place * self._size + size])


class _Known(Struct):
    """One descriptor as it was at the last look.

    Attributes:
        link, about: what readlinkat(2) and newfstatat(2) answered.
    """

    descriptor: Descriptor
    link: bytes | None
    about: bytes | None


class KeptTexts:
    """The fdinfo files of one process, kept open from look to look: reading one again takes a third of opening it anew.

    Such a file tells of the descriptor that has its number when it is read. Source: seq_show() in fs/proc/fd.c.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._files: dict[int, int] = {}
        self._known: dict[int, _Known] = {}
        self._texts = _Column("pread64", TEXT_SIZE)
        self._links = _Column("readlinkat", LINK_SIZE)
        self._abouts = _Column("newfstatat", STAT_SIZE)
        self._directory = -1
        """/proc/PID/fd."""
        self._is_known = False
        self._last: tuple[list[int], tuple[bytes, ...], tuple[Descriptor, ...]] | None = None

    def are_there(self) -> bool:
        """Ask about all that were there at the last look; whether exactly those are there still.

        To list them takes the kernel longer than to count them.
        """
        if self._last is None or not 0 < self._count() == len(self._last[0]):
            return False
        self._ask()
        return self._texts.has_every_answer()  # of one that is closed there is none

    def _count(self) -> int:
        """How many are open; 0 where the kernel does not count them: before Linux 6.2. Source: proc_pid_fd(5)."""
        try:
            return os.stat(f"/proc/{self.pid}/fd" if self._directory < 0 else self._directory).st_size
        except OSError:  # the listing reports the cause
            return 0

    def rehearse(self) -> None:
        """Ask as `are_there`, and forget the answers."""
        self._count()
        self._ask()
        self._heard()

    @property
    def numbers(self) -> list[int]:
        """The numbers of the last look; none where the known facts did not explain all of it."""
        return self._last[0] if self._last is not None else []

    def as_before(self) -> tuple[Descriptor, ...] | None:
        """All, after `are_there`: the very same tuple where the kernel has answered as at the last look, else None."""
        return self._last[2] if self._last is not None and self._last[1] == self._heard() else None

    def every(self, numbers: list[int], links: int, texts: int, *, is_asked: bool = False) -> tuple[Descriptor, ...]:
        """All that have these numbers: the very same tuple where the kernel answers about all of them as at the last look.

        Args:
            links, texts: see `read`.
            is_asked: `are_there` has just said that these are.
        """
        if not is_asked:
            self.ask(numbers)
        heard = self._heard()
        if self._last is not None and self._last[0] == numbers and self._last[1] == heard:
            return self._last[2]
        self._is_known = True
        found = tuple(found for number in numbers if (found := self.read(number, links, texts)) is not None)
        self._last = (numbers, heard, found) if self._is_known else None
        return found

    def ask(self, numbers: Collection[int]) -> None:
        """Ask the kernel about all of them, as far as they were there before; forget the others."""
        kept = frozenset(numbers)
        for number in [number for number in self._files if number not in kept]:
            self._forget(number)
        self._ask()

    def _ask(self) -> None:
        for column in (self._texts, self._links, self._abouts):
            column.ask()

    def _heard(self) -> tuple[bytes, ...]:
        return self._texts.heard(), self._links.heard(), self._abouts.heard()

    def read(self, number: int, links: int, texts: int) -> Descriptor | None:
        """One descriptor, after `ask`; None when it was closed meanwhile.

        Args:
            links, texts: the directories /proc/PID/fd and fdinfo.
        """
        known = self._known.get(number)
        text, link, about = self._texts.told(number), self._links.told(number), self._abouts.told(number)
        if known is not None and text is not None and link == known.link and about == known.about:
            if text == known.descriptor.told:
                return known.descriptor
            head, before = head_of(text), head_of(known.descriptor.told)
            if head is not None and before is not None and head[3] and head.group(3, 4) == before.group(3, 4):
                known.descriptor = replace(known.descriptor, told=text, offset=int(head[1]), flags=int(head[2], 8))
                return known.descriptor
        return self._anew(number, links, texts, link, about)

    def _anew(self, number: int, links: int, texts: int, link: bytes | None, about: bytes | None) -> Descriptor | None:
        """Understand it; it is known from then on if this look asked exactly the questions that it needs, and got answers."""
        self._known.pop(number, None)
        self._is_known = False
        standing = standing_of(number, links, texts)
        if standing is None:
            return None
        found, needs = standing
        if number in self._files or len(self._files) < TEXTS_KEPT:
            has_all = number in self._texts and (link is not None, about is not None) == (needs.link, needs.about)
            self._follow(number, needs, links, texts)
            if has_all:
                self._known[number] = _Known(found, link, about)
        return found

    def _follow(self, number: int, needs: Standing, links: int, texts: int) -> None:
        """Have what must be asked of it asked at the next look."""
        if number not in self._files:
            try:
                if self._directory < 0:
                    self._directory = os.dup(links)
                self._files[number] = os.open(str(number), os.O_RDONLY | os.O_CLOEXEC, dir_fd=texts)
            except OSError:  # it has just been closed, or we have no descriptor left
                return
            self._texts.put(number, self._files[number])
        for column, is_needed in ((self._links, needs.link), (self._abouts, needs.about)):
            if is_needed and number not in column:
                column.put(number, self._directory)
            elif not is_needed:
                column.drop(number)

    def forget(self) -> None:
        """Take nothing of the last look for granted: the process ran, and may have changed things in the middle of it."""
        self._known.clear()
        self._last = None

    def _forget(self, number: int) -> None:
        self._known.pop(number, None)
        for column in (self._texts, self._links, self._abouts):
            column.drop(number)
        os.close(self._files.pop(number))

    def close(self) -> None:
        """Close all; they are opened again when they are read."""
        for number in tuple(self._files):
            self._forget(number)
        if self._directory >= 0:
            os.close(self._directory)
            self._directory = -1
