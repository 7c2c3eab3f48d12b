"""team create, enrol, show: the members of the team, and the key by which each robot is known."""

from __future__ import annotations

import argparse
import contextlib
import socket
import tomllib
from pathlib import Path

from failover.cli import key_pairs
from failover.cli.output import render
from failover.config import team
from failover.config.team import DEFAULT_BEAT_PORT, DEFAULT_BULK_PORT, Robot, Team
from failover.errors import TeamFileError


def create(arguments: argparse.Namespace) -> int:
    """Begin a team: a directory with a team file that has no member yet."""
    directory = Path(arguments.directory)
    path = directory / team.TEAM_FILE
    if path.exists():
        raise TeamFileError(f"{path} exists; remove it to begin anew, or enrol robots into it with failover team enrol")
    _write(directory, Team(arguments.name))
    return _tell(
        arguments, {"team": arguments.name, "file": str(path)}, f"{path}: team {arguments.name}; next: failover team enrol"
    )


def enrol(arguments: argparse.Namespace) -> int:
    """Add a member, with a key made here or brought along. One that is replaced keeps its role unless another is given."""
    directory = Path(arguments.directory)
    members = team.read(directory)
    if arguments.name in members.robots and not arguments.replace:
        raise TeamFileError(
            f"{arguments.name} is in {directory / team.TEAM_FILE} already; --replace gives it new addresses and a new key"
        )
    beats = tuple(_with_port(address, DEFAULT_BEAT_PORT) for address in arguments.address)
    bulk = _with_port(arguments.bulk or beats[0].rpartition(":")[0], DEFAULT_BULK_PORT)
    public, secret = (arguments.public_key, "") if arguments.public_key else key_pairs.new_pair()
    role = arguments.role or (members.robots[arguments.name].role if arguments.name in members.robots else "robot")
    enrolled = team.enrol(members, arguments.name, Robot(beats, bulk, role, public))
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
    with contextlib.suppress(OSError, ValueError):
        if tomllib.loads((directory.resolve().parent / "agent.toml").read_text()).get("robot") == name:
            return True
    return any(_is_ours(team.split_address(address, name)[0]) for address in member.beats)


def _is_ours(host: str) -> bool:
    """Whether a number is an address of this machine; a name is not looked up, for that can take its time."""
    with contextlib.suppress(OSError, ValueError):
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
            return True
    return False


def show(arguments: argparse.Namespace) -> int:
    """List the team."""
    members = team.read(Path(arguments.directory))
    if arguments.json:
        robots = {
            name: {"role": robot.role, "beats": robot.beats, "bulk": robot.bulk, "public_key": robot.public_key}
            for name, robot in members.robots.items()
        }
        board = members.items()
        of_board = {"items": [item.name for item in board.items], "digest": f"{board.digest:016x}"}
        render.as_json({"team": members.team, "robots": robots, "board": of_board})
        return 0
    lines = [
        (name, robot.role, " ".join(robot.beats), robot.bulk, robot.public_key or "none")
        for name, robot in sorted(members.robots.items())
    ]
    print(f"team {members.team}: {len(lines)} members")
    if lines:
        render.table(("robot", "role", "beats", "bulk", "public key"), lines)
    if members.board.items:
        print(
            f"board: {len(members.board.items)} items, digest {members.items().digest:016x}: it must be the same on every member"
        )
    return 0


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
