"""Capture, store and restore the state of one process tree on one machine; no peers, no roles, no network.

Each name is loaded when it is first used, so that `import checkpoint` costs nothing:

    from checkpoint import engine_named

    for reason in engine_named("ptrace").probe(pid).reasons:
        print(reason)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from checkpoint.engine import Report
    from checkpoint.engines.registry import engine_named
    from checkpoint.errors import CheckpointError
    from checkpoint.model import Position, Snapshot
    from checkpoint.snapshot.format import decode, encode
    from checkpoint.store.store import Store, open_store

__all__ = ["CheckpointError", "Position", "Report", "Snapshot", "Store", "decode", "encode", "engine_named", "open_store"]

_HOMES = {
    "CheckpointError": "checkpoint.errors",
    "Position": "checkpoint.model",
    "Report": "checkpoint.engine",
    "Snapshot": "checkpoint.model",
    "Store": "checkpoint.store.store",
    "decode": "checkpoint.snapshot.format",
    "encode": "checkpoint.snapshot.format",
    "engine_named": "checkpoint.engines.registry",
    "open_store": "checkpoint.store.store",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its home on first use (PEP 562)."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(home), name)
