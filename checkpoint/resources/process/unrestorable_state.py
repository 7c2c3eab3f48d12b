"""Refuse process settings that no restore brings back: the check asks the process once, when protection begins.

The kernel tells them only to the process itself, or to a tracer. A question in every freeze would slow all programs down for
settings that hardly any program has. So settings that a program makes later are not seen.

Source: modify_ldt(2), arch_prctl(2), ioperm(2), prctl(2).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Final

from checkpoint.arch import cpu
from checkpoint.arch.calls import Call, Unkept
from checkpoint.capability import Area, by_rule, refused
from checkpoint.errors import CaptureError
from checkpoint.linux.trace.syscall_batch import Answers, Batch
from checkpoint.linux.trace.tracee import Tracee

PR_GET_IO_FLUSHER: Final = 58

CAPABILITIES: Final = (
    by_rule(
        Area.PROCESS,
        "the right to every I/O port (iopl); a cookie for core scheduling (PR_SCHED_CORE)",
        "not carried: the kernel does not tell that the program has them",
    ),
    refused(
        Area.PROCESS,
        "segments of its own (modify_ldt); I/O ports (ioperm); a cpuid instruction that is switched off; the rights of a "
        "file system (IO_FLUSHER)",
        "run the program without them; failover looks for them when protection begins",
        "it has {}, which no restore gives it",
    ),
)


class Questions:
    """The calls of one batch that ask for all of it."""

    def __init__(self, batch: Batch) -> None:
        output = batch.output(cpu.UNKEPT_OUTPUT_SIZE)
        flusher = Unkept(Call("prctl", (PR_GET_IO_FLUSHER, 0, 0, 0, 0)), 0, "the rights of a file system (PR_SET_IO_FLUSHER)")
        self._asked = [(one, batch.add(one.call.name, *one.call.arguments)) for one in (*cpu.unkept(output), flusher)]

    def refuse(self, answers: Answers) -> Iterator[str]:
        """Why a process cannot be kept that answers so."""
        for one, place in self._asked:
            if answers.results[place] >= 0 and answers.results[place] != one.usual:
                yield refuse_what(one.what)


def refuse_ports(tracee: Tracee) -> Iterator[str]:
    """Why a process cannot be kept that may use I/O ports."""
    if cpu.PORT_RIGHTS is None:
        return
    with contextlib.suppress(CaptureError):  # nearly always: it has no such registers
        if tracee.register_set(cpu.PORT_RIGHTS):
            yield refuse_what("rights to I/O ports (ioperm)")


def refuse_what(what: str) -> str:
    """The sentence."""
    return f"it has {what}, which no restore gives it: run it without"
