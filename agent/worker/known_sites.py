"""The sites of the members, as this robot last decided with them: by it the agent finds a team.toml that was edited by hand.

A change of the team that all members grant counts in ``change``. Sites that differ although ``change`` is the same were edited at
this robot, and perhaps at no other one: two robots would then count different majorities. The agent does not start with them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from agent.config import Settings
from agent.errors import ConfigError
from checkpoint.store.whole_file import write_whole
from failover.config.team import TEAM_FILE, sites_digest

FILE_NAME: Final = "sites"
"""Below the state directory."""


def check(settings: Settings) -> None:
    """Refuse sites that were edited by hand since this robot decided with others; keep those there are.

    Raises:
        ConfigError: they were, or cannot be kept.
    """
    path, team = Path(settings.config.state_directory) / FILE_NAME, settings.team
    change, digest = _known(path)
    if change == team.change and digest != sites_digest(team).hex():
        raise ConfigError(
            f"{Path(settings.config.team_directory) / TEAM_FILE}: the sites of the members are others than this robot last "
            f"decided with, and the team's change {change} is the same, so the file was edited by hand: robots that differ about "
            "sites could run a program twice. Write the former sites back, and let failover team remove and failover team invite "
            f"--site change them. Or stop every agent of the team, bring the same file to all members, and remove {path} at each"
        )
    note(settings)


def note(settings: Settings) -> None:
    """Keep the sites that this robot decides with from now on.

    Raises:
        ConfigError: the disk does not take them.
    """
    path, digest = Path(settings.config.state_directory) / FILE_NAME, sites_digest(settings.team).hex()
    if _known(path) == (settings.team.change, digest):
        return
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(path, json.dumps({"change": settings.team.change, "sites": digest}).encode(), lasts="content")
    except OSError as error:
        if digest:  # else what needs the disk next says it
            raise ConfigError(f"cannot write {path}: {error.strerror}; free some room there") from error


def _known(path: Path) -> tuple[int, str]:
    """The change of the team and the digest that stand there; (-1, "") where nothing that can be read does."""
    try:
        found = json.loads(path.read_text())
        return int(found["change"]), str(found["sites"])
    except (OSError, ValueError, KeyError, TypeError):
        return -1, ""
