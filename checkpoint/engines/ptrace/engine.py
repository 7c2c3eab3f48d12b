"""The ptrace engine: captures and restores unmodified programs through kernel interfaces alone.

Only the keeper imports it, and imports it at its start: a keeper that waits in advance must not import during a takeover.
"""

from __future__ import annotations

from collections.abc import Mapping

from checkpoint.engine import PTRACE, Copy, ProtectOrder, Report, Restored, RestoreOptions, Session
from checkpoint.engines.ptrace.capture.session import PtraceSession
from checkpoint.engines.ptrace.facts.probe import probe
from checkpoint.engines.ptrace.restore import checks
from checkpoint.engines.ptrace.restore.restore import restore
from checkpoint.engines.ptrace.standby_copy import lay
from checkpoint.linux.spawn.cpuid import require_supported
from checkpoint.model import Snapshot
from checkpoint.store.base_on_disk import StoredBase
from checkpoint.store.content_store import digest_of_file
from checkpoint.store.digest_cache import DigestOf


class PtraceEngine:
    """Captures and restores unmodified Linux processes, with all their threads."""

    name = PTRACE

    def probe(self, pid: int) -> Report:
        """See ``checkpoint.engine.Engine.probe``."""
        require_supported(f"look into pid {pid}")
        return probe(pid)

    def protect(self, pid: int, order: ProtectOrder) -> Session:
        """See ``checkpoint.engine.Engine.protect``."""
        require_supported(f"capture pid {pid}")
        return PtraceSession.open(pid, order)

    def lacks(self, outline: Snapshot, options: RestoreOptions, digest_of: DigestOf = digest_of_file) -> tuple[str, ...]:
        """See ``checkpoint.engine.Engine.lacks``."""
        return checks.lacks(outline, options, digest_of)

    def contested(self, outline: Snapshot, options: RestoreOptions, pid: int, components: Mapping[str, int]) -> tuple[str, ...]:
        """See ``checkpoint.engine.Engine.contested``."""
        return checks.contested(outline, options, pid, components)

    def restore(self, vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Restored:
        """See ``checkpoint.engine.Engine.restore``."""
        return restore(vessel_pid, base, options)

    def lay(self, vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Copy:
        """See ``checkpoint.engine.Engine.lay``."""
        return lay.lay(vessel_pid, base, options)
