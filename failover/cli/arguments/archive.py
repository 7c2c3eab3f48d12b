"""archive key, list, fetch: sealed copies of checkpoints in an object store."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_json, add_team_directory


def archive(room: argparse.ArgumentParser) -> None:
    """Of ``failover archive`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    add_team_directory(shared)
    add_json(shared)
    key = add_act(acts, "key", shared, "make the team's archive key", KEY_DESCRIPTION)
    key.set_defaults(function="failover.cli.verbs.archive:key")
    listing = add_act(acts, "list", shared, "the copies that are there", LIST_DESCRIPTION)
    listing.add_argument("name", metavar="NAME", nargs="?", default="", help="of one component: its name, or an end of it")
    _add_place(listing)
    listing.set_defaults(function="failover.cli.verbs.archive:listed")
    fetch = add_act(acts, "fetch", shared, "bring the newest copy of a component here", FETCH_DESCRIPTION)
    fetch.add_argument("name", metavar="NAME", help="the component's name, or an end of it")
    fetch.add_argument("--object", metavar="OBJECT", default="", help="this copy, as the list names it (default: the newest)")
    fetch.add_argument("--output", metavar="FILE", required=True, help="the snapshot's file; a file that is there stays")
    _add_place(fetch)
    fetch.set_defaults(function="failover.cli.verbs.archive:fetch")


def _add_place(room: argparse.ArgumentParser) -> None:
    room.add_argument("--place", metavar="PLACE", help="s3://BUCKET/PREFIX, or a folder (default: of agent.toml)")
    room.add_argument("--endpoint", metavar="URL", help="the server, where it is not S3 itself (default: of agent.toml)")


KEY_DESCRIPTION: Final = """
    Make the archive key of the team: keys/archive.key in the team directory. Carry it to the same place at every robot and server
    that archives or fetches: each opens copies with it and its own key. Beside it, keys/archive.recovery opens copies when no
    robot of the team is left: move it, with a copy of archive.key, to where no robot is. The file keys/archive.public opens
    nothing: it is for a witness that is to keep sealed copies.

      failover archive key
    """

LIST_DESCRIPTION: Final = """
    List the checkpoints in the archive: which component, which epoch, when, how large. The newest of each component stands first.

      failover archive list
      failover archive list mapper
    """

FETCH_DESCRIPTION: Final = """
    Bring a checkpoint here, with its files that this machine lacks (in FILE.contents), and prove every byte of it. failover
    restore starts its program from that file, and failover protect protects that program again. This needs the team file, the
    archive key, a robot's own key or the recovery key, and the keys of the bucket; no agent.

      failover archive fetch mapper --output mapper.snapshot
      failover archive fetch /lab/r1/mapper --output mapper.snapshot --place s3://robots/lab
    """
