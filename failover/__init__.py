"""Rules and faces: who runs what, and how people and programs ask.

Applications import from here; each name is loaded when it is first used, so that `import failover` costs nothing:

    from failover import Control

    with Control.open() as agent:
        print(agent.ask("status")["promise"])

and a program that says what must survive:

    import failover

    state = failover.resume("counter", default={"n": 0})
    for _ in failover.every(0.1):
        state["n"] += 1
        print(state["n"], flush=True)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from failover.client.control import Control
    from failover.client.epoch import epoch
    from failover.client.gateway import Gateway
    from failover.client.scratch import scratch
    from failover.client.task import Resumed, activations, commit, resume, resumed, transaction, wait_committed
    from failover.client.task_component import component, kept, run
    from failover.client.task_loop import every
    from failover.client.task_resumable import resumable
    from failover.client.task_rhythm import FINISHED
    from failover.errors import (
        AgentRefusedError,
        FailoverError,
        GatewayError,
        LostAgentError,
        NoAgentError,
        NotCommittedError,
        StaleEpochError,
        StateTakenError,
        TaskError,
    )

__version__ = "0.1.0"

_HOMES = {
    "Control": "failover.client.control",
    "Resumed": "failover.client.task",
    "activations": "failover.client.task",
    "commit": "failover.client.task",
    "epoch": "failover.client.epoch",
    "Gateway": "failover.client.gateway",
    "resume": "failover.client.task",
    "resumed": "failover.client.task",
    "transaction": "failover.client.task",
    "wait_committed": "failover.client.task",
    "component": "failover.client.task_component",
    "kept": "failover.client.task_component",
    "run": "failover.client.task_component",
    "FINISHED": "failover.client.task_rhythm",
    "every": "failover.client.task_loop",
    "resumable": "failover.client.task_resumable",
    "scratch": "failover.client.scratch",
    "AgentRefusedError": "failover.errors",
    "FailoverError": "failover.errors",
    "GatewayError": "failover.errors",
    "StaleEpochError": "failover.errors",
    "LostAgentError": "failover.errors",
    "NoAgentError": "failover.errors",
    "NotCommittedError": "failover.errors",
    "StateTakenError": "failover.errors",
    "TaskError": "failover.errors",
}

__all__ = [
    "FINISHED",
    "AgentRefusedError",
    "Control",
    "FailoverError",
    "Gateway",
    "GatewayError",
    "LostAgentError",
    "NoAgentError",
    "NotCommittedError",
    "Resumed",
    "StaleEpochError",
    "StateTakenError",
    "TaskError",
    "__version__",
    "activations",
    "commit",
    "component",
    "epoch",
    "every",
    "kept",
    "resumable",
    "resume",
    "resumed",
    "run",
    "scratch",
    "transaction",
    "wait_committed",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home on first use (PEP 562); from then on it stands here."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'failover' has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(home), name)
    return found
