"""Group the descriptors of a process that lead to the same open file, by one call for each pair of similar descriptors.

The kernel has an order of open files. The first capture finds the order of similar descriptors, with a few questions about each.
Later captures ask whether each descriptor is still followed by the same other one, which proves that their relations are
unchanged.

Source: kcmp(2), KCMP_FILE.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import OwnCalls, row
from checkpoint.linux.procfs.descriptor import Descriptor

Group = tuple[Descriptor, ...]
"""Descriptors of one open file, lowest number first."""
_Identity = tuple[int | bytes, ...]
_SAME, _BEFORE = 0, 1
"""The answers of kcmp(2) about two."""


class _Alike(Struct, frozen=True):
    """Descriptors that may lead to the same open file.

    Attributes:
        numbers: of all, as they were found.
        ordered: those of each open file, in the kernel's order.
    """

    numbers: tuple[int, ...]
    ordered: tuple[tuple[int, ...], ...]

    def pairs(self) -> list[tuple[int, int, int]]:
        """Neighbours, and how they stand to one another."""
        found = [(one, other, _BEFORE) for (one, *_), (other, *_) in zip(self.ordered, self.ordered[1:], strict=False)]
        return found + [(first, other, _SAME) for first, *others in self.ordered for other in others]


class Grouping:
    """Sorts the descriptors of one process, again and again."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._found: tuple[Descriptor, ...] = ()
        self._groups: tuple[Group, ...] = ()
        self._known: dict[_Identity, _Alike] = {}
        self._table = OwnCalls(0)
        self._results = np.zeros(0, dtype=np.int64)
        self._pairs: list[tuple[int, int, int]] = []

    def of(self, found: tuple[Descriptor, ...]) -> tuple[Group, ...]:
        """One group for each open file, by lowest number: the very same tuple where nothing has changed."""
        holds = self._holds()
        if holds and len(found) == len(self._found) and all(map(_is, found, self._found)):
            return self._groups
        buckets: dict[_Identity, list[Descriptor]] = {}
        for one in found:
            buckets.setdefault(_identity(one), []).append(one)
        known = self._known if holds else {}
        self._known = {
            identity: self._sorted(known.get(identity), alike) for identity, alike in buckets.items() if len(alike) > 1
        }
        self._found, self._groups = found, self._grouped(found)
        self._have_asked([pair for alike in self._known.values() for pair in alike.pairs()])
        return self._groups

    def _holds(self) -> bool:
        """Whether all that were alike are still to one another what they were."""
        self._table.run()
        return self._results.tolist() == [expected for _, _, expected in self._pairs]

    def _have_asked(self, pairs: list[tuple[int, int, int]]) -> None:
        """Ask about these pairs at the next look."""
        if pairs == self._pairs:
            return
        self._pairs, self._results = pairs, np.full(len(pairs), -1, dtype=np.int64)
        place, pid = int(self._results.ctypes.data), self._pid
        self._table = OwnCalls(
            [row("kcmp", pid, pid, abi.KCMP_FILE, *pair[:2], to=place + 8 * index) for index, pair in enumerate(pairs)]
        )

    def _sorted(self, known: _Alike | None, alike: Sequence[Descriptor]) -> _Alike:
        numbers = tuple(one.number for one in alike)
        if known is not None and known.numbers == numbers:
            return known
        ordered: list[list[int]] = []
        for number in numbers:
            place, is_known = _place_among(self._pid, ordered, number)
            if is_known:
                ordered[place].append(number)
            else:
                ordered.insert(place, [number])
        return _Alike(numbers, tuple(map(tuple, ordered)))

    def _grouped(self, found: Sequence[Descriptor]) -> tuple[Group, ...]:
        shared = {number: same for alike in self._known.values() for same in alike.ordered if len(same) > 1 for number in same}
        by_number = {one.number: one for one in found}
        groups: list[Group] = []
        for one in found:
            same = shared.get(one.number)
            if same is None:
                groups.append((one,))
            elif same[0] == one.number:
                groups.append(tuple(by_number[number] for number in same))
        return tuple(groups)


def _is(one: object, other: object) -> bool:
    return one is other


def _identity(one: Descriptor) -> _Identity:
    """The facts that all descriptors of one open file have in common."""
    return one.device, one.inode, one.offset, one.flags & ~os.O_CLOEXEC, _own_number(one)


def _own_number(one: Descriptor) -> bytes:
    """The number that tells an eventfd from all others; b"" for other kinds, and on kernels before 4.20. Source: fs/eventfd.c."""
    return one.told.partition(b"eventfd-id:")[2].partition(b"\n")[0]


def _place_among(pid: int, ordered: Sequence[Sequence[int]], number: int) -> tuple[int, bool]:
    """Where a descriptor belongs among open files in the kernel's own order, and whether it is one of them.

    The order makes it few questions: a program may have thousands of timerfds, which are all alike.
    """
    low, high = 0, len(ordered)
    while low < high:
        middle = (low + high) // 2
        order = abi.kcmp(pid, pid, abi.KCMP_FILE, number, ordered[middle][0])
        if order == _SAME:
            return middle, True
        low, high = (low, middle) if order == _BEFORE else (middle + 1, high)
    return low, False
