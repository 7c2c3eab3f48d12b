"""Shared memory that other processes have mapped, too: where the rules say so, a snapshot tells of it as of the program's own."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence

from checkpoint.engines.ptrace.capture.process import CapturedProcess, Look
from checkpoint.model import Resource
from checkpoint.resources.ipc import shared_memory
from checkpoint.resources.ipc.shared_memory import Mapped, Object


class DetachedMemory:
    """The memory of this kind that the processes of one component share with others, as it was found last."""

    def __init__(self) -> None:
        self._found: tuple[Mapped, ...] = ()
        self._names: dict[Object, str] = {}

    def find(self, processes: Sequence[CapturedProcess]) -> Mapping[Object, int]:
        """Find the objects, and have each process tell of them as of its own; answers with the bytes of each that are mapped."""
        for process in processes:
            process.memory.refresh()
        lines = {process.pid: process.memory.lines for process in processes}
        self._found = shared_memory.of_all(lines)
        mapped = {(line.device, line.inode) for of_one in lines.values() for line in of_one if line.shared}
        names = {one.key: one.name for one in self._found}
        self._names = {key: name for key, name in (self._names | names).items() if key in mapped}
        covered = shared_memory.covered(itertools.chain.from_iterable(lines.values()), self._names)
        for process in processes:
            process.detach(covered.keys())
        return covered

    def notes(self) -> Iterable[str]:
        """Sentences for the operator."""
        return shared_memory.detached(self._found)

    def resources(self) -> Iterator[Resource]:
        """The resources for a snapshot."""
        yield from shared_memory.describe(self._names.items())


def changed(known: Mapping[Object, int], looks: Iterable[tuple[CapturedProcess, Look]]) -> bool:
    """Whether an object was shared with others, or unmapped, since `DetachedMemory.find`."""
    lines = {process.pid: seen.taken.lines for process, seen in looks}
    found = shared_memory.of_all(lines)
    covered = shared_memory.covered(itertools.chain.from_iterable(lines.values()), known)
    return any(one.key not in known for one in found) or any(covered[key] < size for key, size in known.items())
