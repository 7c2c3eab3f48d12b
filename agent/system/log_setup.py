"""The agent's log: lines with times to standard error; under systemd entries with fields to its journal, which has the times."""

from __future__ import annotations

import logging
import sys
from typing import Final

from agent.system.journal import Journal, is_ours

DECISIONS: Final = "failover.decisions"
"""The logger of what a robot decided. Its lines come from a thread of low priority, which may not hold up the main loop's: it has
a handler, and so a lock, of its own."""

FORMAT: Final = "%(asctime)s %(levelname).1s %(name)s: %(message)s"


def set_up_log(level: str, robot: str) -> None:
    """Begin to write lines of that level and above."""
    logging.basicConfig(level=level.upper(), handlers=[_destination(robot)])
    decisions = logging.getLogger(DECISIONS)
    decisions.addHandler(_destination(robot))
    decisions.propagate = False


def _destination(robot: str) -> logging.Handler:
    if is_ours():
        return Journal(robot)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter(FORMAT, "%H:%M:%S"))
    return handler
