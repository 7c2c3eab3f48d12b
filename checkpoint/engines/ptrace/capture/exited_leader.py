"""Represent a first thread that has ended while others live: the snapshot shows it as a thread that is about to exit.

In the snapshot it is before exit(2) with the status that it ended with, and every signal is blocked. Nothing happens at its end:
no address is cleared and no lock released, because that has already happened. So a restore needs no special rule: the first
thread builds everything, as always, and its first act when it resumes is to end again. The other threads, the parent and wait(2)
see the same as before. Where threads end one by one, older kernels report the status of the first thread as that of the process.
"""

from __future__ import annotations

import contextlib
import mmap
from collections.abc import Sequence
from typing import Final

from checkpoint.arch import cpu, stubs
from checkpoint.errors import CaptureError, ProcessGoneError, UnsupportedError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.model import ThreadState

CODE: Final = mmap.PROT_READ | mmap.PROT_EXEC
PIECE_SIZE: Final = 1 << 20
STATUS_SHIFT: Final = 8
"""wait(2) tells the status of exit(2) above the signal."""


class EndedFirst:
    """Tells of the first thread of one process, again and again; the program may run.

    Args:
        pid: of the process, and so of the thread.
        spokesman: see `checkpoint.linux.procfs.live_thread`.
    """

    def __init__(self, pid: int, spokesman: int, memory: Memory) -> None:
        self._pid = pid
        self._spokesman = spokesman
        self._memory = memory
        self._instruction = 0

    def state(self, like: ThreadState, tid: int, lines: Sequence[MapsLine]) -> ThreadState:
        """The thread as a snapshot tells it.

        Args:
            like: a living thread. The state takes from it the registers that have no meaning any more.
            tid: its id as the program knows it.
            lines: the mappings that the snapshot has.

        Raises:
            UnsupportedError: there is no place from which it could end once more.
        """
        stat = procfs.thread_stat(self._spokesman, self._pid)
        status = stat.exit_code >> STATUS_SHIFT
        call = stubs.SYSTEM_CALLS["exit"], (status,)
        registers = stubs.at_call(like.registers["prstatus"], self._place(lines), *call)
        return ThreadState(
            tid=tid,
            name=stat.name,
            registers={**like.registers, "prstatus": registers},
            signal_mask=abi.ALL_SIGNALS,
            affinity=like.affinity,
        )

    def _place(self, lines: Sequence[MapsLine]) -> int:
        """An instruction of the program's files that makes a system call: the kernel's own may differ on another machine."""
        codes = [line for line in lines if line.has_file and line.protection & CODE == CODE]
        if not any(line.start <= self._instruction < line.end for line in codes) or not self._is_call(self._instruction):
            self._instruction = next((place for line in codes if (place := self._found_in(line))), 0)
        if not self._instruction:
            reason = "its first thread has ended, and no file that it runs has a system call by which that could end again"
            raise UnsupportedError(f"cannot capture pid {self._pid}: {reason}", (reason,))
        return self._instruction

    def _is_call(self, place: int) -> bool:
        with contextlib.suppress(CaptureError):
            return self._memory.read(place, len(cpu.SYSCALL)) == cpu.SYSCALL
        return False

    def _found_in(self, line: MapsLine) -> int:
        """Where in a mapping the first one is; 0: nowhere, or it is just going."""
        for start in range(line.start, line.end, PIECE_SIZE):
            try:
                piece = self._memory.read(start, min(PIECE_SIZE, line.end - start))
            except ProcessGoneError:
                raise
            except CaptureError:
                return 0
            if (offset := cpu.call_in(piece)) >= 0:
                return start + offset
        return 0
