"""Handles an unexpected error: the process ends by it and says so, and the main loop starts another."""

from __future__ import annotations

import asyncio
import logging
import os
from typing import Any, Final

STATUS: Final = 70
"""Exit status of the worker after a mistake: EX_SOFTWARE of sysexits.h."""

log = logging.getLogger("failover.lanes")


def end_worker_on_mistake(task: asyncio.Task[Any]) -> None:
    """For a task that has ended: if it was by a mistake of ours, end the process. Components live on."""
    if task.cancelled() or task.exception() is None:
        return
    log.critical("a mistake in the agent: please report it", exc_info=task.exception())
    os._exit(STATUS)
