"""team create, enrol, show: who belongs to the team."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_json, add_team_directory


def team(room: argparse.ArgumentParser) -> None:
    """Of ``failover team`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    add_team_directory(shared)
    add_json(shared)
    create = add_act(acts, "create", shared, "begin a team", CREATE_DESCRIPTION)
    create.add_argument("name", metavar="TEAM", help="the team's name")
    create.set_defaults(function="failover.cli.verbs.team:create")
    enrol = add_act(acts, "enrol", shared, "add a robot, a server or a witness and make its key", ENROL_DESCRIPTION)
    enrol.add_argument("name", metavar="ROBOT", help="the robot's name")
    enrol.add_argument(
        "address",
        metavar="HOST[:PORT]",
        nargs="+",
        help="where it receives heartbeats: one address for each of its links (port 7420)",
    )
    enrol.add_argument(
        "--bulk", metavar="HOST[:PORT]", help="where it receives snapshots, on the wired link (default: first HOST, port 7421)"
    )
    enrol.add_argument(
        "--role",
        choices=("robot", "server", "witness"),
        help="robot: runs components; server: keeps checkpoints of all and votes; witness: votes only (default: robot)",
    )
    enrol.add_argument("--public-key", metavar="KEY", help="the public half of a key made on the robot itself")
    enrol.add_argument("--replace", action="store_true", help="give a known robot new addresses and a new key")
    enrol.set_defaults(function="failover.cli.verbs.team:enrol")
    show = add_act(acts, "show", shared, "list the team", "Show every robot with its addresses and its public key.")
    show.set_defaults(function="failover.cli.verbs.team:show")


CREATE_DESCRIPTION: Final = """
    Make the team directory with an empty team file. Do this once, anywhere; failover team enrol adds the robots.

      failover team create lab
    """

ENROL_DESCRIPTION: Final = """
    Add a robot to the team file and make its key pair. The team file then goes to every robot. The secret key (keys/ROBOT.secret)
    belongs to that robot alone: enrolled on another machine, copy it to the robot and remove it here. Or make the pair on the
    robot (failover-agent keypair), so that the secret never travels, and enrol its public half. Agents read the team file when
    they start.

      failover team enrol robot1 192.168.7.11
      failover team enrol robot2 192.168.7.12 10.0.0.12 --bulk 192.168.7.12
      failover team enrol hall 192.168.7.2 --role server
      failover team enrol robot3 192.168.7.13 --public-key 'lU^njTi%j-s0Um6-=T!3XtpbYKc@&EDt>F+fX01f'
    """
