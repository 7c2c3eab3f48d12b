"""The ptrace engine: unmodified programs, through the kernel's own doors.

Imported by the keeper alone, and at once: a keeper that waits in advance must not import during a takeover.
"""

from __future__ import annotations

from collections.abc import Mapping

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import NOTHING_CARRIED, PTRACE, Carry, Report, Restored, RestoreOptions, Session, Streams
from checkpoint.engines.probe import probe
from checkpoint.engines.ptrace_capture import PtraceSession
from checkpoint.engines.ptrace_restore import restore
from checkpoint.model import Snapshot


class PtraceEngine:
    """Captures and restores Linux processes that nobody prepared, with all their threads."""

    name = PTRACE

    def probe(self, pid: int) -> Report:
        """See ``checkpoint.engine.Engine.probe``."""
        return probe(pid)

    def protect(
        self,
        pid: int,
        component: str,
        streams: Streams | None,
        carry: Carry = NOTHING_CARRIED,
        devices: tuple[DeviceRule, ...] = (),
        names: Mapping[str, str] | None = None,
    ) -> Session:
        """See ``checkpoint.engine.Engine.protect``."""
        return PtraceSession.open(pid, component, streams, carry, devices, names)

    def restore(self, vessel_pid: int, state: Snapshot, options: RestoreOptions) -> Restored:
        """See ``checkpoint.engine.Engine.restore``."""
        return restore(vessel_pid, state, options)
