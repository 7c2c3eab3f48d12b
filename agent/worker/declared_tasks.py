"""Writes the tasks that agent.toml declares into the schedule of this robot, before their programs begin."""

from __future__ import annotations

import contextlib
from pathlib import Path

from agent.config import Settings
from agent.task_config import declaration
from agent.worker.board_directory import PROGRAMS_MODE, place_of
from failover.boards import SCHEDULE_NAME, SCHEDULE_PLACE, directory
from failover.boards.unmapped_schedule import UnmappedSchedule
from failover.core.schedule import orders


def declare(settings: Settings) -> tuple[str, ...]:
    """Declare them; one that is declared already gets the terms of agent.toml.

    Returns:
        What was understood otherwise than it was written, and what is missing.

    Raises:
        ScheduleError, OSError: it cannot be; nothing changed.
    """
    config = settings.config
    found = [one for one in (declaration(name, task) for name, task in config.tasks.items()) if one is not None]
    place = place_of(settings) if settings.team.board.items else Path(config.runtime_directory) / SCHEDULE_PLACE
    with contextlib.suppress(FileExistsError):
        directory.make_schedule(place, config.robot, mode=PROGRAMS_MODE)
    file = UnmappedSchedule.at(place / SCHEDULE_NAME)
    try:
        return file.give(lambda rows, held: orders.added(rows, found, held)).notes
    finally:
        file.close()
