"""Track the seccomp filters of one process's threads over many freezes, and how these threads resume after a stop.

A program can only add filters, so one question is enough for a thread that was seen before. A program without filters pays
nothing for this in its freeze.

A thread that was stopped in a call with a timeout continues through restart_syscall(2). A filter that does not know that call
would kill it. Such a thread makes its own call again instead (`Interruption.begins_anew`), which the filter allowed before.
"""

from __future__ import annotations

from collections.abc import Collection

from checkpoint.arch import cpu as arch
from checkpoint.engines.ptrace.capture.syscall_restart import Interruptions
from checkpoint.errors import CheckpointError, UnsupportedError
from checkpoint.linux.spawn import bpf
from checkpoint.linux.trace import seccomp as trace_seccomp
from checkpoint.linux.trace.seccomp import FILTERED, FREE, STRICT, Confinement
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.resources.process import seccomp

Life = tuple[int, int]
"""A thread for all its life: its id as we see it, and when it began."""


class Confinements:
    """The confinements of one process's threads."""

    def __init__(self, interruptions: Interruptions) -> None:
        self._interruptions = interruptions
        self._known: dict[Life, Confinement] = {}

    def keep_only(self, lives: Collection[Life]) -> None:
        """Forget threads that have ended."""
        self._known = {life: known for life, known in self._known.items() if life in lives}

    def suspended(self, tracee: Tracee, mode: int, life: Life) -> Confinement:
        """Suspend the filters of a thread until it is let go; answers with what it is confined to.

        Args:
            mode: of seccomp(2), or `FILTERED` where that is not known.

        Raises:
            UnsupportedError: we may not, or it is confined to something that cannot be kept.
        """
        if not mode:
            return FREE
        if why := trace_seccomp.why_not():
            raise _unsupported(tracee.pid, seccomp.not_ours(why))
        tracee.suspend_filters()
        before = self._known.get(life)
        found = self._looked_at(tracee, mode, before or FREE)
        if found != before:
            self._known[life] = found
            self._interruptions.of(tracee).begins_anew = found.is_strict or not _goes_on(found)
        return found

    def _looked_at(self, tracee: Tracee, mode: int, before: Confinement) -> Confinement:
        if mode == STRICT:
            return Confinement(is_strict=True)
        try:
            fresh = trace_seccomp.newer(tracee, len(before.filters)) if mode == FILTERED else ()
        except CheckpointError as error:
            raise _unsupported(tracee.pid, seccomp.untold(str(error))) from error
        for one in fresh:
            if trace_seccomp.asks_another(one):
                raise _unsupported(tracee.pid, seccomp.ASKS_ANOTHER)
        return Confinement(filters=(*before.filters, *fresh))


def _goes_on(found: Confinement) -> bool:
    """Whether its filters let restart_syscall(2) through with any registers."""
    programs = [one.instructions for one in found.filters]
    return bpf.allows(programs, arch.SYSCALLS["restart_syscall"], arch.AUDIT_ARCHITECTURE, (0,) * 6)


def _unsupported(pid: int, reason: str) -> UnsupportedError:
    return UnsupportedError(f"cannot capture pid {pid}: {reason}", (reason,))
