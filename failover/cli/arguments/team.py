"""team create, invite, join, list, remove, rotate, enrol, show: who belongs to the team."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_json, add_team_directory

ROLES: Final = ("robot", "server", "witness")

INVITATION_PORT: Final = 7423
"""TCP; open only while an invitation is. 7420 and 7421 are the agent's, 7422 is the name service's."""


def port(text: str) -> int:
    """A TCP port, 0 for any free one."""
    number = int(text)
    if not 0 <= number < 1 << 16:
        raise ValueError(text)
    return number


def team(room: argparse.ArgumentParser) -> None:
    """Of ``failover team`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    add_team_directory(shared)
    add_json(shared)
    create = add_act(acts, "create", shared, "begin a team", CREATE_DESCRIPTION)
    create.add_argument("name", metavar="TEAM", help="the team's name")
    create.add_argument("--robot", metavar="ROBOT", help="this machine's name in it (default: of agent.toml, or the host's name)")
    _add_own_addresses(create)
    create.add_argument("--empty", action="store_true", help="with no member yet: failover team enrol adds them")
    create.set_defaults(function="failover.cli.verbs.team:create")
    invite = add_act(acts, "invite", shared, "print the line by which another robot joins", INVITE_DESCRIPTION)
    invite.add_argument("name", metavar="ROBOT", help="the name that it will have")
    invite.add_argument("--role", choices=ROLES, default="robot", help="what it does in the team (default: %(default)s)")
    invite.add_argument(
        "--for", dest="span", metavar="SPAN", default="10min", help="how long the line holds (default: %(default)s)"
    )
    invite.add_argument("--address", metavar="HOST", help="of this robot, where the other one reaches it (default: of snapshots)")
    invite.add_argument("--port", metavar="PORT", type=port, default=INVITATION_PORT, help="TCP (default: %(default)s)")
    invite.add_argument("--site", metavar="SITE", help="where it is, if not at this robot's site: see docs/far-sites.md")
    _add_socket(invite)
    invite.set_defaults(function="failover.cli.verbs.team_invitations:invite")
    join = add_act(acts, "join", shared, "make this machine a member, by a line of failover team invite", JOIN_DESCRIPTION)
    join.add_argument(
        "line", metavar="LINE", nargs="?", default="-", help="as failover team invite printed it (default: asked for)"
    )
    _add_own_addresses(join)
    join.set_defaults(function="failover.cli.verbs.team_invitations:join")
    listing = add_act(acts, "list", shared, "the members, and which of them live", LIST_DESCRIPTION)
    _add_socket(listing)
    listing.set_defaults(function="failover.cli.verbs.team:members_now")
    remove = add_act(acts, "remove", shared, "take a member out of the team", REMOVE_DESCRIPTION)
    remove.add_argument("name", metavar="ROBOT", help="the member")
    _add_socket(remove)
    remove.set_defaults(function="failover.cli.verbs.team:remove")
    rotate = add_act(acts, "rotate", shared, "replace a robot's keys", ROTATE_DESCRIPTION)
    rotate.add_argument("name", metavar="ROBOT", nargs="?", default="", help="whose keys (default: this robot's)")
    _add_socket(rotate)
    rotate.set_defaults(function="failover.cli.verbs.team:rotate")
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
        choices=ROLES,
        help="robot: runs components; server: keeps checkpoints of all and votes; witness: votes only (default: robot)",
    )
    enrol.add_argument(
        "--site", metavar="SITE", help="where it is (default: where it was; of a new one, the site without a name)"
    )
    enrol.add_argument("--public-key", metavar="KEY", help="the public half of a key made on the robot itself")
    enrol.add_argument("--replace", action="store_true", help="give a known robot new addresses and a new key")
    enrol.set_defaults(function="failover.cli.verbs.team:enrol")
    show = add_act(acts, "show", shared, "list the team", "Show every robot with its addresses and its public key.")
    show.set_defaults(function="failover.cli.verbs.team:show")


def _add_own_addresses(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--address",
        metavar="HOST[:PORT]",
        action="append",
        help="where this machine receives heartbeats; once for each of its links (default: found out; port 7420)",
    )
    room.add_argument("--bulk", metavar="HOST[:PORT]", help="where it receives snapshots (default: first address, port 7421)")
    room.add_argument("--no-start", dest="start", action="store_false", help="leave the service as it is")


def _add_socket(room: argparse.ArgumentParser) -> None:
    room.add_argument("--socket", metavar="PATH", help="the agent's control socket (default: the usual ones)")


CREATE_DESCRIPTION: Final = """
    Begin a team with this machine as its first robot: finds its address, makes its keys, enables and starts the service where
    systemd runs. Other robots join by failover team invite.

      failover team create lab
      failover team create lab --robot r1 --address 192.168.7.11 --address 10.0.0.11
      failover team create lab --empty --directory ./team    # a file without members, for failover team enrol
    """

INVITE_DESCRIPTION: Final = """
    Print one line, to be given to failover team join on the robot that shall join, and wait until it has joined. The line holds
    a secret: it works once, for that robot's name and role, until its time is over or the command ends. The agents of the team
    take the new member at once, and none of them is restarted. Every member must agree, so their agents must run.

      failover team invite r2
      failover team invite hall --role server --for 1h
      failover team invite r9 --site harbour
    """

JOIN_DESCRIPTION: Final = """
    Asks for the line of failover team invite, or reads it from standard input. As an argument, other users of this machine can
    see it. This machine makes its keys itself, and the secret one stays here. It gets the team file, and rights.toml and
    programs.toml where the team has them; its service is enabled and started where systemd runs.

      failover team join
      failover team join --address 192.168.7.12 --address 10.0.0.12
    """

LIST_DESCRIPTION: Final = """
    Show every member with its role, its addresses, and how this robot's agent sees it.

      failover team list
    """

REMOVE_DESCRIPTION: Final = """
    Take a member out. Every other one must agree. From then on no robot takes its heartbeats, its connections or its
    votes, and its agent ends. A robot that runs components must hand them over first. One that is lost can be taken out, too.

      failover team remove r3
    """

ROTATE_DESCRIPTION: Final = """
    Replace the keys of a robot, as a routine or because a copy of the secret one got lost. The robot makes the new pair itself.
    For some seconds both of its public keys count, until every member has the new one; then the old one is refused. Agents and
    programs run on, and stay protected. Every member must be there and agree. A rotation that was broken off goes on when the
    command is given again.

      failover team rotate
      failover team rotate r3
    """

ENROL_DESCRIPTION: Final = """
    Add a robot to the team file and make its key pair. The team file then goes to every robot. The secret key (keys/ROBOT.secret)
    belongs to that robot alone: enrolled on another machine, copy it to the robot and remove it here. Or make the pair on the
    robot (failover-agent keypair), so that the secret never travels, and enrol its public half. Restart the agents then.
    failover team invite does all that by itself.

      failover team enrol robot1 192.168.7.11
      failover team enrol robot2 192.168.7.12 10.0.0.12 --bulk 192.168.7.12
      failover team enrol hall 192.168.7.2 --role server
      failover team enrol robot3 192.168.7.13 --public-key 'lU^njTi%j-s0Um6-=T!3XtpbYKc@&EDt>F+fX01f'
    """
