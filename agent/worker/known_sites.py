"""The sites of the members, as this robot last decided with them: by it the agent finds a team.toml that was edited by hand.

A change of the team that all members grant counts in ``change``, and moves no member: it joins at a site, and leaves from there.
A member that is at another site although ``change`` is the same was moved by an editor at this robot, and perhaps at no other
one: two robots would then count different majorities. The agent does not start with that.

`load` is for each process of the agent: a worker process that starts anew reads the file again, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from agent import config as configuration
from agent.config import Settings
from agent.errors import ConfigError
from agent.main_loop import vote_record
from checkpoint.store.whole_file import write_whole
from failover.config.team import TEAM_FILE, sites_of

FILE_NAME: Final = "sites"
"""Below the state directory."""


def load(path: Path) -> Settings:
    """The settings, with sites that all members granted; those are kept.

    Raises:
        ConfigError: the settings have a mistake, or the sites were edited by hand.
    """
    settings = configuration.load(path)
    check(settings)
    note(settings)
    return settings


def check(settings: Settings) -> None:
    """Refuse sites that were edited by hand since this robot decided with others.

    Raises:
        ConfigError: they were, or nothing tells whether they were.
    """
    team, state = settings.team, Path(settings.config.state_directory)
    path, file = state / FILE_NAME, Path(settings.config.team_directory) / TEAM_FILE
    kept, ours = _kept(path), sites_of(team)
    if kept is None:
        if any(ours.values()) and (state / vote_record.FILE_NAME).exists():
            raise ConfigError(
                f"{file}: it names sites, and this robot has decided before, but {path} does not tell with which sites: start "
                "its agent once with the team.toml that it had before, without sites, and let failover team invite --site add "
                "robots. Or stop every agent of the team, bring the same file to all members, and write "
                f"{json.dumps(_told('', -1, {}))} into {path} at each"
            )
        return
    if kept["team"] != team.team or kept["change"] != team.change:
        return
    if moved := sorted(name for name, site in ours.items() if kept["sites"].get(name, site) != site):
        raise ConfigError(
            f"{file}: {', '.join(moved)} would be at another site than this robot last decided with, and the team's change "
            f"{team.change} is the same, so the file was edited by hand: robots that differ about sites could run a program "
            "twice. Write the former sites back, and let failover team remove and failover team invite --site change them. Or "
            f"stop every agent of the team, raise change to {team.change + 1} in the file, bring the same file to all members, "
            "and start the agents"
        )


def note(settings: Settings) -> None:
    """Keep the sites that this robot decides with from now on.

    Raises:
        ConfigError: the disk does not take them.
    """
    team, path = settings.team, Path(settings.config.state_directory) / FILE_NAME
    told = _told(team.team, team.change, sites_of(team))
    if _kept(path) == told:
        return
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(path, json.dumps(told).encode(), lasts="content")
    except OSError as error:
        if any(told["sites"].values()):  # else what needs the disk next says it
            raise ConfigError(f"cannot write {path}: {error.strerror}; free some room there") from error


def _told(team: str, change: int, sites: Mapping[str, str]) -> dict[str, Any]:
    return {"team": team, "change": change, "sites": dict(sites)}


def _kept(path: Path) -> dict[str, Any] | None:
    """What stands there; None where nothing that can be read does."""
    try:
        found = json.loads(path.read_text())
        return _told(str(found["team"]), int(found["change"]), {str(name): str(site) for name, site in found["sites"].items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
