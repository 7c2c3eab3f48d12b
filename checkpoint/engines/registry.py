"""Look an engine up by its name."""

from __future__ import annotations

from checkpoint.engine import COOPERATIVE, PTRACE, Engine
from checkpoint.errors import ProbeError


def engine_named(name: str) -> Engine:
    """Look an engine up.

    Raises:
        ProbeError: there is none of that name.
    """
    if name == COOPERATIVE:
        from checkpoint.engines.cooperative.engine import CooperativeEngine

        return CooperativeEngine()
    if name != PTRACE:
        raise ProbeError(f"no engine is called {name!r}: choose {PTRACE} or {COOPERATIVE}")
    from checkpoint.engines.ptrace.engine import PtraceEngine

    return PtraceEngine()
