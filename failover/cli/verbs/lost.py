"""lost list, inspect, restore, remove: the states of copies that lost, where two copies of a component had run."""

from __future__ import annotations

import argparse
import contextlib
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from checkpoint.errors import UNDECODABLE
from checkpoint.store import lost_copies
from checkpoint.store.lost_copies import LostCopy
from failover.cli.output import render, team_tree
from failover.cli.verbs import inspect_file, one_shot
from failover.errors import FailoverError

CONFIG: Final = Path("/etc/failover/agent.toml")
STATE: Final = "/var/lib/failover"


def listed(arguments: argparse.Namespace) -> int:
    """List them, the newest first."""
    directory = _directory(arguments)
    copies = _found(directory)
    if arguments.json:
        told = [
            {"component": one.component, "epoch": one.epoch, "size": one.size, "at": one.at_s, "seen": one.seen}
            | {"file": str(one.path)}
            for one in copies
        ]
        render.as_json({"directory": str(directory), "copies": told})
        return 0
    if not copies:
        print(f"no copy has lost at this robot: nothing is in {directory}")
        return 0
    lines = [
        (one.component, str(one.epoch), _when(one), team_tree.size(one.size), "" if one.seen else "not looked at")
        for one in copies
    ]
    render.table(("component", "epoch", "kept", "size", ""), lines)
    return 0


def inspect(arguments: argparse.Namespace) -> int:
    """Show the content of one; from then on a person has looked at it."""
    copy = _meant(arguments)
    arguments.file, arguments.vmas = str(copy.path), False
    status = inspect_file.inspect(arguments)
    lost_copies.look_at(copy.path)
    return status


def restore(arguments: argparse.Namespace) -> int:
    """Start its program beside the team, which does not protect it."""
    copy = _meant(arguments)
    arguments.file = str(copy.path)
    status = one_shot.restore(arguments)
    lost_copies.look_at(copy.path)
    return status


def remove(arguments: argparse.Namespace) -> int:
    """Remove one for good."""
    copy = _meant(arguments)
    lost_copies.remove(copy.path)
    if arguments.json:
        render.as_json({"removed": str(copy.path), "component": copy.component, "epoch": copy.epoch})
    else:
        print(f"{copy.component}, epoch {copy.epoch}: removed")
    return 0


def _directory(arguments: argparse.Namespace) -> Path:
    """Where they lie: as said, else as agent.toml says."""
    state = arguments.state or STATE
    if not arguments.state:
        with contextlib.suppress(OSError, *UNDECODABLE):
            state = str(tomllib.loads(CONFIG.read_text()).get("state_directory", STATE))
    return Path(state) / lost_copies.FOLDER


def _found(directory: Path) -> list[LostCopy]:
    try:
        return lost_copies.found(directory)
    except OSError as error:
        raise FailoverError(f"cannot read {directory}: {error.strerror}; give the command as root") from error


def _meant(arguments: argparse.Namespace) -> LostCopy:
    """The newest of the component that is named, or that of the epoch.

    Raises:
        FailoverError: there is none, or the name fits several components.
    """
    directory = _directory(arguments)
    wanted = arguments.name
    fitting = [one for one in _found(directory) if one.component == wanted or one.component.endswith("/" + wanted.lstrip("/"))]
    if len({one.component for one in fitting}) > 1:
        raise FailoverError(f"{wanted!r} could be {', '.join(sorted({one.component for one in fitting}))}; give the whole name")
    if arguments.epoch is not None:
        fitting = [one for one in fitting if one.epoch == arguments.epoch]
    if not fitting:
        of_epoch = f" of epoch {arguments.epoch}" if arguments.epoch is not None else ""
        raise FailoverError(
            f"{directory} has no copy of {wanted!r}{of_epoch} that lost; failover lost list shows those there are"
        )
    return fitting[0]


def _when(copy: LostCopy) -> str:
    return f"{datetime.fromtimestamp(copy.at_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
