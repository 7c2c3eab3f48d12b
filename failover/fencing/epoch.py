"""The fencing token as a program reads it: a program that keeps its state, or one that was not prepared."""

from __future__ import annotations

import ctypes
import sys
from functools import lru_cache
from typing import Any, Final

from checkpoint.program import epoch_variable

TASK_MODULE: Final = "failover.kept_state.api"
"""Asked only where the program has loaded it: it brings numpy, whose threads an unprepared program must not have."""

_VARIABLE: Final = epoch_variable.VARIABLE.encode()


def epoch() -> int:
    """Number of the primacy under which this copy of the program runs now: the fencing token. It only grows; 0 without an agent.

    Give it along with every order to something outside (a motor controller, a gripper) that remembers the highest one it has
    seen and refuses lower ones (`failover.Gateway`): then a program that was replaced and does not know it yet moves nothing any
    more. Ask each time: a program that keeps no state itself finds another number after a takeover. It opens nothing.
    """
    task = sys.modules[TASK_MODULE].PROCESS.task if TASK_MODULE in sys.modules else None
    return max(task.epoch if task is not None else 0, _own_epoch())


def _own_epoch() -> int:
    """The epoch in the environment of the C library, where the agent renews it: `os.environ` is a copy from the beginning."""
    told = _getenv()(_VARIABLE)
    return int(told) if told is not None and told.isdigit() else 0


@lru_cache(maxsize=1)
def _getenv() -> Any:
    getenv = ctypes.CDLL(None).getenv
    getenv.restype = ctypes.c_char_p
    getenv.argtypes = (ctypes.c_char_p,)
    return getenv
