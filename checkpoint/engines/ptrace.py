"""The ptrace engine: unmodified programs, through the kernel's own doors."""

from __future__ import annotations

from checkpoint.engine import Report, Restored, RestoreOptions, Session, Streams
from checkpoint.model import Snapshot


class PtraceEngine:
    """Captures and restores single-threaded Linux processes that nobody prepared."""

    name = "ptrace"

    def probe(self, pid: int) -> Report:
        """See ``checkpoint.engine.Engine.probe``."""
        from checkpoint.engines.probe import probe

        return probe(pid)

    def protect(self, pid: int, component: str, streams: Streams | None) -> Session:
        """See ``checkpoint.engine.Engine.protect``."""
        from checkpoint.engines.ptrace_capture import PtraceSession

        return PtraceSession.open(pid, component, streams)

    def restore(self, vessel_pid: int, state: Snapshot, options: RestoreOptions) -> Restored:
        """See ``checkpoint.engine.Engine.restore``."""
        from checkpoint.engines.ptrace_restore import restore

        return restore(vessel_pid, state, options)
