"""Rules and faces: who runs what, and how people and programs ask.

Applications import from here; each name is loaded when it is first used, so that `import failover` costs nothing:

    from failover import Control

    with Control.open() as agent:
        print(agent.ask("status")["promise"])
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from failover.client.control import Control
    from failover.errors import AgentRefusedError, FailoverError, LostAgentError, NoAgentError

__version__ = "0.1.0"

__all__ = ["AgentRefusedError", "Control", "FailoverError", "LostAgentError", "NoAgentError", "__version__"]

_HOMES = {
    "Control": "failover.client.control",
    "AgentRefusedError": "failover.errors",
    "FailoverError": "failover.errors",
    "LostAgentError": "failover.errors",
    "NoAgentError": "failover.errors",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its home on first use (PEP 562)."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'failover' has no attribute {name!r}")
    return getattr(importlib.import_module(home), name)
