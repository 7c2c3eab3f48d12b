"""team create, enrol, remove, rotate, list, show: the members of the team, and the key by which each robot is known."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from failover.cli import agent_service, key_pairs
from failover.cli.connection import connect
from failover.cli.output import render
from failover.config import addresses, team
from failover.config.team import DEFAULT_BEAT_PORT, DEFAULT_BULK_PORT, Robot, Role, Team
from failover.errors import NoAgentError, TeamFileError


def create(arguments: argparse.Namespace) -> int:
    """Begin a team with this machine as its first robot; or, ``--empty``, with no member yet."""
    directory = Path(arguments.directory)
    path = directory / team.TEAM_FILE
    if path.exists():
        raise TeamFileError(
            f"{path} exists: this machine has a team; failover team invite brings another robot into it, and to begin anew, "
            f"remove {directory}"
        )
    if arguments.empty:
        _write(directory, Team(arguments.name))
        told = {"team": arguments.name, "file": str(path)}
        return _tell(arguments, told, f"{path}: team {arguments.name}; next: failover team enrol")
    robot = arguments.robot or agent_service.own_name(directory)
    agent_service.check_name(directory, robot)
    public, secret = key_pairs.new_pair()
    member = member_of(robot, arguments.address or [addresses.usual_address()], arguments.bulk, "robot", public)
    begun = team.enrol(Team(arguments.name), robot, member)
    team.write_secret_key(directory, robot, secret)
    try:
        _write(directory, begun)
        agent_service.name_robot(directory, robot)
    except TeamFileError:
        team.forget_secret_key(directory, robot)
        path.unlink(missing_ok=True)
        raise
    service = agent_service.start(directory) if arguments.start else agent_service.NOT_STARTED
    answer = {"team": arguments.name, "file": str(path), "robot": robot, "beats": member.beats, "service": service}
    sentence = f"team {arguments.name}: this machine is {robot} at {member.beats[0]}; {service}; then: failover team invite ROBOT"
    return _tell(arguments, answer, sentence)


def member_of(name: str, hosts: Sequence[str], bulk: str | None, role: Role, public: str) -> Robot:
    """This machine as a member at these addresses; ports are the usual ones where they are left out.

    Raises:
        TeamFileError: an address cannot be right.
    """
    beats = tuple(_with_port(host, DEFAULT_BEAT_PORT) for host in hosts)
    member = Robot(beats, _bulk_of(bulk, beats, hosts), role, public)
    team.check_robot("this machine", name, member)
    addresses.check_addresses(name, member, {})
    addresses.check_own(name, member)
    return member


def _bulk_of(bulk: str | None, beats: Sequence[str], hosts: Sequence[str]) -> str:
    """Where snapshots come: as said; else at the first host, at the usual port, or one above a port that was named."""
    if bulk:
        return _with_port(bulk, DEFAULT_BULK_PORT)
    host, port = team.split_address(beats[0], "beat address")
    named = _with_port(hosts[0], DEFAULT_BEAT_PORT) == hosts[0]
    return _with_port(f"[{host}]" if ":" in host else host, port + 1 if named else DEFAULT_BULK_PORT)


def change_by_agent(arguments: argparse.Namespace, act: str, robot: str, member: Robot | None = None) -> dict[str, Any]:
    """Have this robot's agent change the team, which asks the other members.

    Raises:
        NoAgentError: none runs.
        AgentRefusedError: it, or another member, says no.
    """
    told = {"member": msgspec.to_builtins(member)} if member is not None else {}
    with connect(arguments) as control:
        return control.ask("team", act=act, robot=robot, **told)


def remove(arguments: argparse.Namespace) -> int:
    """Take a member out: its frames, its replication link and its votes count at no robot any more."""
    answer = change_by_agent(arguments, "remove", arguments.name)
    later = f"; {', '.join(answer['waiting'])} will hear of it when they are back" if answer["waiting"] else ""
    sentence = f"{arguments.name} is out of team {answer['team']}; there: systemctl disable --now failover-agent{later}"
    return _tell(arguments, {**answer, "removed": arguments.name}, sentence)


def rotate(arguments: argparse.Namespace) -> int:
    """Replace a robot's keys; it makes them itself."""
    answer = change_by_agent(arguments, "rotate", arguments.name)
    later = f"; {', '.join(answer['waiting'])} will hear of it when they are back" if answer["waiting"] else ""
    sentence = f"{answer['robot']} has new keys, and its former one is refused: its public key is {answer['public_key']}{later}"
    return _tell(arguments, answer, sentence)


def enrol(arguments: argparse.Namespace) -> int:
    """Add a member, with a key made here or brought along. One that is replaced keeps its role and site where none is given."""
    directory = Path(arguments.directory)
    members = team.read(directory)
    if arguments.name in members.robots and not arguments.replace:
        raise TeamFileError(
            f"{arguments.name} is in {directory / team.TEAM_FILE} already; --replace gives it new addresses and a new key"
        )
    beats = tuple(_with_port(address, DEFAULT_BEAT_PORT) for address in arguments.address)
    bulk = _with_port(arguments.bulk or beats[0].rpartition(":")[0], DEFAULT_BULK_PORT)
    known = members.robots.get(arguments.name, Robot(beats, bulk))
    role, site = arguments.role or known.role, known.site if arguments.site is None else arguments.site
    addresses.check_addresses(arguments.name, Robot(beats, bulk, site=site), members.robots)
    public, secret = (arguments.public_key, "") if arguments.public_key else key_pairs.new_pair()
    enrolled = team.enrol(members, arguments.name, Robot(beats, bulk, role, public, site=site))
    answer = {"robot": arguments.name, "role": role, "beats": beats, "bulk": bulk, "public_key": public}
    sentence = f"{arguments.name} is enrolled as a {role}; copy {directory / team.TEAM_FILE} to every member"
    if secret:
        if arguments.replace:
            team.forget_secret_key(directory, arguments.name)
        path = team.write_secret_key(directory, arguments.name, secret)
        answer["secret_key_file"] = str(path)
        sentence += f"; {_place_of(path, arguments.name, enrolled.robots[arguments.name], directory)}"
    _write(directory, enrolled)
    return _tell(arguments, answer, sentence)


def _place_of(key: Path, name: str, member: Robot, directory: Path) -> str:
    """Where a secret key that was made here belongs: on its own robot, which may be this machine."""
    if _is_here(name, member, directory):
        return f"this machine is {name}, so its secret key stays here, in {key}"
    return f"if this machine is not {name}, copy {key} to {name} alone, then remove it here"


def _is_here(name: str, member: Robot, directory: Path) -> bool:
    """Whether this machine is known to be that member: agent.toml beside the team says so, or one of its addresses is ours."""
    if agent_service.said_name(directory.resolve()) == name:
        return True
    return any(addresses.is_ours(team.split_address(address, name)[0]) for address in member.beats)


def members_now(arguments: argparse.Namespace) -> int:
    """List the members, and how this robot's agent sees each of them."""
    directory = Path(arguments.directory)
    members, me = team.read(directory), agent_service.own_name(directory)
    status: dict[str, Any] = {}
    with contextlib.suppress(NoAgentError), connect(arguments) as control:
        status = control.ask("status")
    states = {peer["name"]: peer["state"] for peer in status.get("peers", ())} | ({status["robot"]: "here"} if status else {})
    states |= {one["name"]: one["lane"] for one in status.get("far", ())}
    order = members.roster().names
    seen = {name: states.get(name, "not known" if status else "no agent here") for name in order}
    if arguments.json:
        robots = {name: {**msgspec.to_builtins(members.robots[name]), "state": seen[name]} for name in order}
        render.as_json({"team": members.team, "change": members.change, "robot": me, "robots": robots})
        return 0
    print(_counted(members.team, len(order)))
    has_sites = any(member.site for member in members.robots.values())
    heads = ("robot", "role", "state", "addresses", *(["site"] if has_sites else []))
    lines = [
        (name, one.role, seen[name], " ".join(one.beats), *([one.site] if has_sites else []))
        for name, one in ((name, members.robots[name]) for name in order)
    ]
    if lines:
        render.table(heads, lines)
    for name in (name for name in order if members.robots[name].next_key):
        print(f"two keys of {name} count: failover team rotate {name} goes on")
    return 0


def show(arguments: argparse.Namespace) -> int:
    """List the team."""
    members = team.read(Path(arguments.directory))
    if arguments.json:
        robots = {
            name: {"role": robot.role, "beats": robot.beats, "bulk": robot.bulk, "public_key": robot.public_key}
            | ({"next_key": robot.next_key} if robot.next_key else {})
            | ({"site": robot.site} if robot.site else {})
            for name, robot in members.robots.items()
        }
        board = members.items()
        of_board = {"items": [item.name for item in board.items], "digest": f"{board.digest:016x}"}
        render.as_json({"team": members.team, "robots": robots, "board": of_board})
        return 0
    lines = [
        (name, robot.role, " ".join(robot.beats), robot.bulk, ", ".join(robot.keys) or "none")
        for name, robot in sorted(members.robots.items())
    ]
    print(_counted(members.team, len(lines)))
    if lines:
        render.table(("robot", "role", "beats", "bulk", "public key"), lines)
    if members.board.items:
        print(
            f"board: {len(members.board.items)} items, digest {members.items().digest:016x}: it must be the same on every member"
        )
    return 0


def _counted(name: str, count: int) -> str:
    return f"team {name}: {count} member{'s' if count != 1 else ''}"


def _write(directory: Path, members: Team) -> None:
    try:
        team.write(directory, members)
    except OSError as error:
        raise TeamFileError(f"cannot write {directory / team.TEAM_FILE}: {error.strerror}") from error


def _with_port(address: str, port: int) -> str:
    """An address as it is, or with the usual port when it has none; an IPv6 address stands in brackets when it has one."""
    if address.startswith("["):
        return address if "]:" in address else f"{address}:{port}"
    if address.count(":") == 1:
        return address
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"


def _tell(arguments: argparse.Namespace, answer: dict[str, object], sentence: str) -> int:
    if arguments.json:
        render.as_json(answer)
    else:
        print(sentence)
    return 0
