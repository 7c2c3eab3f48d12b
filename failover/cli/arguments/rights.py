"""rights list, rights why: which user may do what."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_agent, add_team_directory


def rights(room: argparse.ArgumentParser) -> None:
    """Of ``failover rights`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    add_team_directory(shared)
    add_agent(shared)
    listed = add_act(
        acts, "list", shared, "the rules, each with its line", "Show every rule of rights.toml with the line where it stands."
    )
    listed.set_defaults(function="failover.cli.verbs.rights:show")
    why = add_act(acts, "why", shared, "may this user do this there, and by which rule", WHY_DESCRIPTION)
    why.add_argument("user", metavar="USER", help="who asks")
    why.add_argument("right", metavar="VERB", help="see, read, call, put, operate, start, program or grant")
    why.add_argument("path", metavar="PATH", help="a component, a driver, a robot")
    why.add_argument("--groups", metavar="GROUP,...", help="take these groups (default: by the source of groups in rights.toml)")
    why.set_defaults(function="failover.cli.verbs.rights:why")


WHY_DESCRIPTION: Final = """
    Ask the rules one question. The answer names the rule that decides, its line, the group and the pattern of paths. Exit status
    1: it is denied. Where groups come from a directory server, the agent asks it: about yourself, as root about every user.

      failover rights why user1 call University/Lab/Robotino/Engines/3/PWM
      failover rights why user1 operate /lab/robot1/mapper --groups operators,staff
    """
