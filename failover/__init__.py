"""Rules of the team and interfaces to it: which robot runs a component, and how users and programs ask.

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

and one that shares values with other programs and robots:

    board = failover.board()
    ball = board.add(failover.Item("ball", {"x": "f4", "y": "f4"}))
    ball.put({"x": 1.0, "y": 2.0})
    print(ball.get().age_ns)

and one that speaks for a device, and one that calls it (`failover.drivers.declare`):

    with failover.proxy("engine") as engine:
        engine.call("set", duty=0.4)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from failover.boards.board import board
    from failover.client.control import Control
    from failover.core.board.items import Item
    from failover.drivers.declare import command, driver, query, stream
    from failover.drivers.proxy import proxy
    from failover.errors import (
        AgentRefusedError,
        BoardError,
        CallRefusedError,
        DriverError,
        FailoverError,
        GatewayError,
        LostAgentError,
        MailboxFullError,
        NameUnknownError,
        NeverWrittenError,
        NoAgentError,
        NoAnswerError,
        NotCommittedError,
        OvertakenError,
        ScheduleError,
        StaleEpochError,
        StateTakenError,
        TaskError,
        ValueMisfitError,
        WriterTakenError,
    )
    from failover.fencing.epoch import epoch
    from failover.fencing.gateway import Gateway
    from failover.kept_state.api import Resumed, activations, commit, resume, resumed, transaction, wait_committed
    from failover.kept_state.component import component, kept, run
    from failover.kept_state.loop import every
    from failover.kept_state.period import FINISHED
    from failover.kept_state.resumable import resumable
    from failover.kept_state.scratch import scratch
    from failover.schedule.task import scheduled

__version__ = "0.1.0"

_HOMES = {
    "board": "failover.boards.board",
    "Item": "failover.core.board.items",
    "Control": "failover.client.control",
    "Resumed": "failover.kept_state.api",
    "activations": "failover.kept_state.api",
    "commit": "failover.kept_state.api",
    "epoch": "failover.fencing.epoch",
    "Gateway": "failover.fencing.gateway",
    "resume": "failover.kept_state.api",
    "resumed": "failover.kept_state.api",
    "transaction": "failover.kept_state.api",
    "wait_committed": "failover.kept_state.api",
    "component": "failover.kept_state.component",
    "kept": "failover.kept_state.component",
    "run": "failover.kept_state.component",
    "FINISHED": "failover.kept_state.period",
    "every": "failover.kept_state.loop",
    "resumable": "failover.kept_state.resumable",
    "scheduled": "failover.schedule.task",
    "scratch": "failover.kept_state.scratch",
    "AgentRefusedError": "failover.errors",
    "BoardError": "failover.errors",
    "NeverWrittenError": "failover.errors",
    "OvertakenError": "failover.errors",
    "ScheduleError": "failover.errors",
    "ValueMisfitError": "failover.errors",
    "WriterTakenError": "failover.errors",
    "FailoverError": "failover.errors",
    "GatewayError": "failover.errors",
    "command": "failover.drivers.declare",
    "driver": "failover.drivers.declare",
    "query": "failover.drivers.declare",
    "stream": "failover.drivers.declare",
    "proxy": "failover.drivers.proxy",
    "CallRefusedError": "failover.errors",
    "DriverError": "failover.errors",
    "NameUnknownError": "failover.errors",
    "NoAnswerError": "failover.errors",
    "StaleEpochError": "failover.errors",
    "LostAgentError": "failover.errors",
    "MailboxFullError": "failover.errors",
    "NoAgentError": "failover.errors",
    "NotCommittedError": "failover.errors",
    "StateTakenError": "failover.errors",
    "TaskError": "failover.errors",
}

__all__ = [
    "FINISHED",
    "AgentRefusedError",
    "BoardError",
    "CallRefusedError",
    "Control",
    "DriverError",
    "FailoverError",
    "Gateway",
    "GatewayError",
    "Item",
    "LostAgentError",
    "MailboxFullError",
    "NameUnknownError",
    "NeverWrittenError",
    "NoAgentError",
    "NoAnswerError",
    "NotCommittedError",
    "OvertakenError",
    "Resumed",
    "ScheduleError",
    "StaleEpochError",
    "StateTakenError",
    "TaskError",
    "ValueMisfitError",
    "WriterTakenError",
    "__version__",
    "activations",
    "board",
    "command",
    "commit",
    "component",
    "driver",
    "epoch",
    "every",
    "kept",
    "proxy",
    "query",
    "resumable",
    "resume",
    "resumed",
    "run",
    "scheduled",
    "scratch",
    "stream",
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
