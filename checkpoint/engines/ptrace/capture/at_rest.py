"""Whether a process still is as its last look found it, told while it runs: then a capture would say nothing new.

It is, if each of its threads waits in the system call in which it stood, with the same stack, and if no page differs. To look at
it again would cost as much as a capture and disturb it. A thread that ran in between has written its stack, because it called a
function. Only a program of hand-written instructions that writes no memory at all is missed; so the session believes this for
`REST_MAX_S` at most, and then captures.

Our own freeze makes the kernel write to each thread's area of restartable sequences, which says on which processor the thread
runs. Those bytes do not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.engines.ptrace.capture.frozen_process import Standing
from checkpoint.engines.ptrace.capture.frozen_threads import Read
from checkpoint.engines.ptrace.capture.memory_result import Taken
from checkpoint.errors import CheckpointError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words

REST_MAX_S: Final = 2.0
"""How old a look may become. What is told from outside (a stop, a pending signal, a renamed file) is seen then, too."""
REST_PAGES: Final = 64
"""Pages that are compared; a process of which more were written since does not rest."""

Area = tuple[int, int]
"""First and last address of bytes that do not count."""


class LastLook(Struct, frozen=True):
    """A look at one process, to be compared with.

    Attributes:
        places: the stack and instruction pointers of its threads, by thread.
        pages: the content of the pages that the look copied, by address.
        areas: of restartable sequences.
    """

    places: dict[int, tuple[int, int]]
    pages: dict[int, memoryview]
    areas: tuple[Area, ...]

    @staticmethod
    def may_be_of(taken: Taken) -> bool:
        """Whether a look copied little enough to be compared."""
        return not taken.is_base and sum(page_set.total_size(copy.pages) for copy in taken.copies) <= REST_PAGES * abi.PAGE_SIZE

    @classmethod
    def of(cls, pid: int, standing: Standing, taken: Taken) -> LastLook:
        """Of one that `may_be_of`. Valid until the next freeze, which uses the same memory."""
        threads: list[tuple[int, Read, bytes]] = [(pid, standing.place, standing.place.registers)]
        threads += [(other.place.tracee.pid, other.place, other.place.registers) for other in standing.others]
        areas = (read.rseq for _, read, _ in threads)
        return cls(
            {tid: _stand_of(registers) for tid, _, registers in threads},
            dict(_pages_of(taken)),
            tuple((area.address, area.address + area.size) for area in areas if area is not None),
        )

    def waits_there(self, pid: int) -> bool:
        """Whether each thread waits where it stood; none has come or gone."""
        try:
            if procfs.stat(pid).state != "S" or set(thread_ids(pid)) != self.places.keys():
                return False
            return all(_waits_at(procfs.read_bytes(pid, f"task/{tid}/syscall"), place) for tid, place in self.places.items())
        except (CheckpointError, OSError):  # it has ended, or this kernel does not tell: a capture finds out
            return False

    def are_equal(self, pages: Words, content: memoryview) -> bool:
        """Whether these pages are as they were."""
        for index, address in enumerate(page_set.addresses_of(pages, abi.PAGE_SIZE).tolist()):
            before = self.pages.get(address)
            if before is None:
                return False
            now = content[index * abi.PAGE_SIZE : (index + 1) * abi.PAGE_SIZE]
            if now != before and self._counted(address, now) != self._counted(address, before):
                return False
        return True

    def _counted(self, address: int, content: memoryview) -> bytes:
        """The bytes of a page, with zeros in place of those that do not count."""
        counted = np.frombuffer(content, dtype=np.uint8).copy()
        for first, last in self.areas:
            counted[max(first - address, 0) : max(last - address, 0)] = 0
        return counted.tobytes()


def _pages_of(taken: Taken) -> Iterator[tuple[int, memoryview]]:
    """The content of each page that was copied; of a page that was copied again, the newest comes last."""
    for copy in taken.copies:
        content = memoryview(copy.content)
        for index, address in enumerate(page_set.addresses_of(copy.pages, abi.PAGE_SIZE).tolist()):
            yield address, content[index * abi.PAGE_SIZE : (index + 1) * abi.PAGE_SIZE]


def _stand_of(registers: bytes) -> tuple[int, int]:
    decoded = arch.decode_registers(registers)
    return decoded[arch.STACK_POINTER], decoded[arch.INSTRUCTION_POINTER]


def _waits_at(told: bytes, place: tuple[int, int]) -> bool:
    """Whether /proc/PID/task/TID/syscall tells of this place; a call that is made again begins one instruction before its end."""
    words = told.split()
    if len(words) < 3:  # "running"
        return False
    stack, pointer = int(words[-2], 16), int(words[-1], 16)
    return stack == place[0] and pointer - place[1] in (0, len(arch.SYSCALL))
