"""lost list, inspect, restore, remove: states of copies that lost."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.one_shot import add_restore_options
from failover.cli.arguments.shared import add_act, add_json, whole


def lost(room: argparse.ArgumentParser) -> None:
    """Of ``failover lost`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--state", metavar="DIR", help="the agent's state directory (default: of agent.toml)")
    listing = add_act(acts, "list", shared, "the copies that lost at this robot", LIST_DESCRIPTION)
    add_json(listing)
    listing.set_defaults(function="failover.cli.verbs.lost:listed")
    inspect = add_act(acts, "inspect", shared, "show the content of one", INSPECT_DESCRIPTION)
    _add_copy(inspect)
    add_json(inspect)
    inspect.set_defaults(function="failover.cli.verbs.lost:inspect")
    restore = add_act(acts, "restore", shared, "start its program beside the team", RESTORE_DESCRIPTION)
    _add_copy(restore)
    add_restore_options(restore)
    restore.set_defaults(function="failover.cli.verbs.lost:restore")
    remove = add_act(acts, "remove", shared, "remove one for good", REMOVE_DESCRIPTION)
    _add_copy(remove)
    add_json(remove)
    remove.set_defaults(function="failover.cli.verbs.lost:remove")


def _add_copy(room: argparse.ArgumentParser) -> None:
    room.add_argument("name", metavar="NAME", help="the component's name, or an end of it")
    room.add_argument("--epoch", metavar="N", type=whole, help="of the primacy that lost (default: the newest)")


LIST_DESCRIPTION: Final = """
    List the states of copies that lost at this robot: which component, which epoch, when, and whether a person has looked at it.

      failover lost list
    """

INSPECT_DESCRIPTION: Final = """
    Show the content of one, as failover inspect does. From then on failover status tells of it no more.

      failover lost inspect mapper
      failover lost inspect /lab/r1/mapper --epoch 3
    """

RESTORE_DESCRIPTION: Final = """
    Start its program where it stood, as failover restore does: beside the copy that the team runs, and not protected.

      failover lost restore mapper
    """

REMOVE_DESCRIPTION: Final = """
    Remove one for good.

      failover lost remove mapper --epoch 3
    """
