"""The team directory: the members, the address where each robot listens, and the key by which it is known.

::

    team.toml            the same on every robot; nothing secret in it
    keys/ROBOT.secret    that robot's own secret key, 0600; only on that robot
    keys/ROBOT.next      the one that it will use next, while it replaces its key

`failover team create` begins one, `enrol` adds a robot, and the operator carries team.toml to the others. Keys are CURVE
keys (Curve25519, 32 bytes) written as 40 characters of Z85. Source: rfc.zeromq.org/spec/32.
"""

from __future__ import annotations

import contextlib
import os
import re
import tomllib
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from checkpoint.store.whole_file import sync_directory, write_new, write_whole
from failover.config import strict_toml
from failover.config.board import BoardConfig, as_toml, board_of, text_of_board
from failover.core.frames.roster import Roster, roster
from failover.core.team_changes import seats
from failover.core.wire import names
from failover.errors import NameFormatError, TeamFileError

if TYPE_CHECKING:
    from failover.core.board.items import Board

Role = Literal["robot", "server", "witness"]
"""Robots run components; servers keep checkpoints and vote; witnesses vote."""

TEAM_FILE: Final = "team.toml"
KEY_CHARACTERS: Final = 40
Z85: Final = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
DEFAULT_BEAT_PORT: Final = 7420
DEFAULT_BULK_PORT: Final = 7421
ROBOT_LIMIT: Final = 64
"""Robots of one team: each beats to each, so the traffic grows with the square."""

FORMER_LIMIT: Final = 16
"""Members taken out that are remembered."""

CHANGE_MAX: Final = 1 << 40

_PORT = re.compile(r"[0-9]{1,5}", re.ASCII)
_ODD = re.compile(r"[:\"\\.]")
"""Not in a robot's name: it is the name of a file, a word of TOML, and stands before addresses."""


@dataclass(frozen=True, slots=True)
class Robot:
    """One member.

    Attributes:
        role: robot: runs components and protects those of others; server: keeps checkpoints of all; witness: votes only.
        beats: "host:port" for each of its links; beats go to all of them.
        bulk: "host:port" on the wired link, for snapshots.
        public_key: Z85, or "" in a team without keys; ``next_key``: the one that takes its place, while both count.
        seat: its number in the team, which stays while members come and go; -1: by the order of names.
        site: where it is. Only members of one site beat to each other, vote together and replace each other.
    """

    beats: tuple[str, ...]
    bulk: str
    role: Role = "robot"
    public_key: str = ""
    seat: int = -1
    next_key: str = ""
    site: str = ""

    @property
    def keys(self) -> tuple[str, ...]:
        """The public keys that prove to be this member: one, two while one replaces the other, none in a team without."""
        return tuple(key for key in (self.public_key, self.next_key) if key)

    @property
    def keyless(self) -> Robot:
        """All but its keys: what a member needs to know to be heard."""
        return replace(self, public_key="", next_key="")

    def at(self, site: str) -> Robot:
        """The same member at another site."""
        return replace(self, site=site)


@dataclass(frozen=True, slots=True)
class Team:
    """The members, by name, and the items of their board.

    Attributes:
        change: how often failover has changed the members.
        next_seat: above the seat that was given last.
        former: members that were taken out, the newest last: should one of them come back, it is told so, and ends.
    """

    team: str
    robots: dict[str, Robot] = field(default_factory=dict)
    board: BoardConfig = field(default_factory=BoardConfig)
    change: int = 0
    next_seat: int = 0
    former: dict[str, Robot] = field(default_factory=dict)

    def items(self) -> Board:
        """The board's declarations, checked when the file was read.

        Its `Board.terms` are part of the roster's digest: robots with different boards do not read each other's frames.
        """
        return board_of(self.board, lambda keys: f"{TEAM_FILE}: {'.'.join(keys)}")

    def roster(self) -> Roster:
        """All members by rank: what the files of the board and the C header mean by a member's number."""
        return roster(self.robots, self._terms())

    def roster_of_site(self, site: str) -> Roster:
        """The members of a site by rank, as frames mean it. Of a robot that knows other sites a frame's items are not read."""
        return roster(self.at_site(site), self._terms() + sites_digest(self))

    def at_site(self, site: str) -> dict[str, Robot]:
        """The members there, by name: with these and no others a member of that site decides."""
        return {name: robot for name, robot in self.robots.items() if robot.site == site}

    def _terms(self) -> bytes:
        return self.items().terms if self.board.items else b""  # no board: its modules are not loaded


def read(directory: Path) -> Team:
    """Read the team file.

    Raises:
        FileMistakeError: it is mistaken; names the line.
        TeamFileError: it is missing, or its content makes no team.
    """
    path = directory / TEAM_FILE
    try:
        is_there = path.exists()
    except OSError as error:
        raise TeamFileError(f"{path}: cannot be read: {error.strerror}") from error
    if not is_there:
        raise TeamFileError(
            f"{path}: there is no such file: failover team create begins a team, failover team join enters another robot's"
        )
    team = strict_toml.read(path, Team)
    check_team(str(path), team)
    if team.board.items:
        board_of(team.board, lambda keys: strict_toml.place_of(path, keys))
    return team


def check_team(where: str, team: Team) -> None:
    """Refuse members that cannot be a team.

    Raises:
        TeamFileError: says which and why.
    """
    if len(team.robots) > ROBOT_LIMIT:
        raise TeamFileError(f"{where}: {len(team.robots)} robots are over the limit of {ROBOT_LIMIT}")
    for name, robot in (*team.robots.items(), *team.former.items()):
        check_robot(where, name, robot)
    if len(team.former) > FORMER_LIMIT or not 0 <= team.change <= CHANGE_MAX or not 0 <= team.next_seat < ROBOT_LIMIT:
        raise TeamFileError(f"{where}: change, next_seat or former cannot be right; copy the file from another robot of the team")
    _check_keys_differ(where, team)
    given = sorted(robot.seat for robot in team.robots.values())
    if given and given[-1] >= 0 and (given[0] < 0 or len(set(given)) < len(given) or given[-1] >= ROBOT_LIMIT):
        raise TeamFileError(
            f"{where}: each member has a seat of its own from 0 to {ROBOT_LIMIT - 1}, or none has one; copy the file from a "
            "robot where it is whole"
        )


def sites_of(team: Team) -> dict[str, str]:
    """Where each member is, by name."""
    return {name: robot.site for name, robot in team.robots.items()}


def sites_digest(team: Team) -> bytes:
    """A part of the roster's digest; b"" in a team that has only one site, without a name."""
    told = sorted(sites_of(team).items())
    if not any(site for _, site in told):
        return b""
    return blake2b("".join(f"{name}:{site}\n" for name, site in told).encode(), digest_size=16).digest()


def _check_keys_differ(where: str, team: Team) -> None:
    owners: dict[str, str] = {}
    for name, key in ((name, key) for name, robot in team.robots.items() for key in robot.keys):
        if owners.setdefault(key, name) != name:
            raise TeamFileError(
                f"{where}: {name} and {owners[key]} have the same public key: each could speak for the other; give "
                f"one of them its own: failover team enrol {name} HOST --replace"
            )


def check_robot(where: str, name: str, robot: Robot) -> None:
    """Refuse a name, an address or a key that could not work.

    Raises:
        TeamFileError: says which and why.
    """
    try:
        names.check_robot(name)
    except NameFormatError as error:
        raise TeamFileError(f"{where}: {error}") from error
    if _ODD.search(name):
        raise TeamFileError(f'{where}: {name!r} cannot name a robot: it holds one of : . " and \\')
    if robot.site and (_ODD.search(robot.site) or not is_name_of_site(robot.site)):
        raise TeamFileError(f"{where}: {robot.site!r} of {name} cannot name a site: a site has a name as a robot has one")
    if not robot.beats:
        raise TeamFileError(f"{where}: robot {name} has no beat address; give at least one host:port")
    for address in (*robot.beats, robot.bulk):
        split_address(address, f"{where}: robot {name}")
    for key in robot.keys:
        if len(key) != KEY_CHARACTERS:
            raise TeamFileError(f"{where}: the public key of {name} has {len(key)} characters, not {KEY_CHARACTERS}")
        if not _is_z85(key):
            raise TeamFileError(f"{where}: the public key of {name} is not Z85: copy it again, every character of it")
    if robot.next_key and robot.public_key in ("", robot.next_key):
        raise TeamFileError(f"{where}: next_key of {name} is for a second key, beside another public_key; take it out")


def is_name_of_site(site: str) -> bool:
    """Whether a site may be called so: as a robot."""
    try:
        names.check_robot(site)
    except NameFormatError:
        return False
    return True


def _is_z85(text: str) -> bool:
    """Whether groups of five characters are numbers of four bytes each. Source: rfc.zeromq.org/spec/32."""
    digits = [Z85.find(character) for character in text]
    values = (
        sum(digit * 85 ** (4 - place) for place, digit in enumerate(digits[at : at + 5])) for at in range(0, len(digits), 5)
    )
    return -1 not in digits and all(value < 1 << 32 for value in values)


def split_address(address: str, where: str) -> tuple[str, int]:
    """("host", port) of "host:port" or "[v6]:port".

    Raises:
        TeamFileError: it is neither.
    """
    host, separator, port = address.rpartition(":")
    is_host = bool(separator and host) and host.isprintable() and not set(host) & set(' "\\')
    if not is_host or not _PORT.fullmatch(port) or not 0 < int(port) < 1 << 16:
        raise TeamFileError(f"{where}: {address!r} is no address; write host:port")
    return host.strip("[]"), int(port)


def for_lookup(host: str) -> str | bytes:
    """A host as getaddrinfo is asked for it: a str would go through the codec of names, half a megabyte for good."""
    return host.encode() if host.isascii() else host


def write(directory: Path, team: Team) -> None:
    """Write the team file whole: aside, then renamed. The operator's lines below ``[board]`` stay as they are."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / TEAM_FILE
    mode = path.stat().st_mode & 0o777 if path.exists() else None
    write_whole(path, (_as_toml(team) + _board_text(path, team.board)).encode(), mode=0o666, lasts="name")
    if mode is not None:
        path.chmod(mode)  # an agent's umask is another one than a person's, and programs read the file


def _board_text(path: Path, board: BoardConfig) -> str:
    """The table of the board for a file that is written anew: the lines of the one before, if they mean the same."""
    if board == BoardConfig():
        return ""
    if path.exists():
        kept = text_of_board(path.read_text())
        with contextlib.suppress(tomllib.TOMLDecodeError):
            if tomllib.loads(kept).get("board") == tomllib.loads(path.read_text()).get("board"):
                return "\n" + kept
    return "\n" + as_toml(board_of(board, ".".join))


def enrol(team: Team, name: str, robot: Robot) -> Team:
    """The team with one more robot, or with that robot's entry replaced, which keeps its seat."""
    check_robot("the new robot", name, robot)
    if len(team.robots) >= ROBOT_LIMIT and name not in team.robots:
        raise TeamFileError(f"team {team.team} has {ROBOT_LIMIT} members, and no more find a place")
    taken = {other: member.seat for other, member in team.robots.items()}
    mark = team.next_seat
    if robot.seat < 0 and any(seat >= 0 for seat in taken.values()):
        robot = replace(robot, seat=seats(taken | {name: taken.get(name, -1)}, [*taken, name], mark)[name])
        mark = mark if robot.seat == taken.get(name) else (robot.seat + 1) % ROBOT_LIMIT
    places = {*robot.keys, robot.bulk, *robot.beats}
    former = {
        other: one for other, one in team.former.items() if other != name and places.isdisjoint({*one.keys, one.bulk, *one.beats})
    }
    enrolled = replace(team, robots={**team.robots, name: robot}, next_seat=mark, former=former)
    _check_keys_differ("the new robot", enrolled)
    return enrolled


def secret_key_path(directory: Path, robot: str) -> Path:
    """Where a robot keeps its own secret key."""
    return directory / "keys" / f"{robot}.secret"


def write_secret_key(directory: Path, robot: str, secret: str) -> Path:
    """Keep a secret key, 0600; an existing one is never overwritten.

    Raises:
        TeamFileError: there is one already, or it cannot be written.
    """
    path = secret_key_path(directory, robot)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_new(path, f"{secret}\n".encode())
    except FileExistsError as error:
        raise TeamFileError(
            f"{path} exists, and a robot keeps its key: move the file away first if {robot} shall have a new one"
        ) from error
    except OSError as error:
        raise TeamFileError(f"cannot write {path}: {error.strerror}") from error
    return path


def read_secret_key(directory: Path, robot: str) -> str:
    """This robot's secret key.

    Raises:
        TeamFileError: it is missing, others may read it, or it is no key.
    """
    path = secret_key_path(directory, robot)
    try:
        mode = path.stat().st_mode
        secret = path.read_text().strip()
    except UnicodeDecodeError as error:
        raise TeamFileError(f"{path} is no key: it is not text; copy it here again from where {robot} was enrolled") from error
    except OSError as error:
        raise TeamFileError(
            f"cannot read this robot's key {path}: {error.strerror}; copy it here from where {robot} was enrolled, or make a new "
            f"one by failover team enrol {robot} HOST --replace, or run without keys by insecure = true"
        ) from error
    if mode & 0o077:
        raise TeamFileError(f"{path} is open to others (mode {mode & 0o777:o}); run: chmod 600 {path}")
    if len(secret) != KEY_CHARACTERS:
        raise TeamFileError(f"{path} holds {len(secret)} characters; a key has {KEY_CHARACTERS}")
    if not _is_z85(secret):
        raise TeamFileError(f"{path} is no key: it is not Z85; copy it here again, every character of it")
    return secret


def next_key_path(directory: Path, robot: str) -> Path:
    """Where a robot keeps the secret key that it will use next."""
    return directory / "keys" / f"{robot}.next"


def write_next_key(directory: Path, robot: str, secret: str) -> None:
    """Put aside the secret key that will be used next, in the place of one that never was.

    Raises:
        OSError: it cannot be written.
    """
    write_whole(next_key_path(directory, robot), f"{secret}\n".encode(), mode=0o600, lasts="name")


def read_next_key(directory: Path, robot: str) -> str:
    """That key; "" where there is none, or one that is cut off."""
    try:
        secret = next_key_path(directory, robot).read_text().strip()
    except (OSError, UnicodeDecodeError):
        return ""
    return secret if len(secret) == KEY_CHARACTERS else ""


def use_next_key(directory: Path, robot: str) -> None:
    """Let that key take the place of the secret key, which is no more; its file stays the owner's.

    Raises:
        OSError: it cannot.
    """
    following, present = next_key_path(directory, robot), secret_key_path(directory, robot)
    owner = present.stat()
    if (owner.st_uid, owner.st_gid) != (os.geteuid(), os.getegid()):
        os.chown(following, owner.st_uid, owner.st_gid, follow_symlinks=False)
    following.replace(present)
    sync_directory(present.parent)


def forget_secret_key(directory: Path, robot: str) -> None:
    """Remove a secret key that was carried to its robot."""
    with contextlib.suppress(FileNotFoundError):
        secret_key_path(directory, robot).unlink()


def _as_toml(team: Team) -> str:
    lines = ["# The team: the same file on every robot. Nothing in it is secret.", f'team = "{team.team}"']
    lines += [f"change = {team.change}"] if team.change else []
    lines += [f"next_seat = {team.next_seat}"] if team.next_seat else []
    for name, robot in sorted(team.robots.items()):
        lines += _table_of("robots", name, robot)
    for name, robot in team.former.items():
        lines += _table_of("former", name, robot)
    return "\n".join(lines) + "\n"


def _table_of(kind: str, name: str, robot: Robot) -> list[str]:
    beats = ", ".join(f'"{address}"' for address in robot.beats)
    lines = ["", f'[{kind}."{name}"]', f'role = "{robot.role}"', f"beats = [{beats}]", f'bulk = "{robot.bulk}"']
    lines += [f'public_key = "{robot.public_key}"'] if robot.public_key else []
    lines += [f'next_key = "{robot.next_key}"'] if robot.next_key else []
    lines += [f"seat = {robot.seat}"] if robot.seat >= 0 else []
    lines += [f'site = "{robot.site}"'] if robot.site else []
    return lines
