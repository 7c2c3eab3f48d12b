"""team invite, join: a robot comes into the team by one line, typed on it (`failover.config.invitation`).

The inviting side listens as long as the command runs: until the robot has joined, the time is over, or Ctrl-C. The joining side
makes its keys itself; only the public one leaves it. Nothing is written there before the team has taken it.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import secrets
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole
from failover.cli import agent_service, key_pairs
from failover.cli.agent_service import own_name
from failover.cli.output import render
from failover.cli.verbs.team import change_by_agent, member_of
from failover.config import addresses, members, team
from failover.config.invitation import SECRET_SIZE, Invitation, read
from failover.config.quantities import span_ms
from failover.config.team import Robot, Team
from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.core.wire.messages import VERSION
from failover.errors import DriverError, FailoverError, InvitationError, LostAgentError, NoAgentError, TeamFileError

if TYPE_CHECKING:
    from failover.drivers.sockets import OneTimeListener as Listener

SPAN_MS_MAX: Final = 86_400_000
"""A day."""

CONNECT_S: Final = 5.0
HANDSHAKE_MS: Final = 30_000
ANSWER_MS: Final = 90_000
"""The inviting robot asks the other members first."""

CONFIRM_MS: Final = 30_000
POLL_MS: Final = 500
FAREWELL_MS: Final = 2_000

FURTHER_FILES: Final = ("rights.toml", "programs.toml")
"""What is the same at every robot, and goes to one that joins, beside the team file."""

FILES_SIZE_MAX: Final = MESSAGE_SIZE_MAX // 2
"""Bytes of them; the team file has room beside them."""


class Wish(msgspec.Struct, frozen=True):
    """The joining side's message."""

    version: int
    robot: str
    member: Robot


class Welcome(msgspec.Struct, frozen=True):
    """The answer.

    Attributes:
        refusal: why not; "": it belongs to the team now.
        files: name → content.
    """

    refusal: str = ""
    files: dict[str, bytes] = {}


# --- invite ----------------------------------------------------------------------------------------------------------


def invite(arguments: argparse.Namespace) -> int:
    """Print a line, and listen until a robot has joined by it, or its time is over."""
    directory, robot = Path(arguments.directory), arguments.name
    before, me = team.read(directory), own_name(directory)
    span = _span_ms(arguments.span)
    if me not in before.robots:
        raise TeamFileError(f"{me} is no member of {directory / team.TEAM_FILE}; invite at a robot of the team")
    if robot in before.robots:
        raise TeamFileError(f"{robot} belongs to team {before.team} already; failover team remove {robot} takes it out")
    host = arguments.address or team.split_address(before.robots[me].bulk, me)[0]
    site = before.robots[me].site if arguments.site is None else arguments.site
    team.check_robot("the invitation", robot, Robot((f"{host}:1",), f"{host}:1", site=site))
    with _listening(Invitation(robot, host, arguments.port, secrets.token_bytes(SECRET_SIZE), arguments.role)) as (
        invitation,
        listener,
    ):
        if arguments.json:
            render.as_json({"robot": robot, "line": invitation.line, "command": "failover team join", "span_ms": span})
        else:
            print(invitation.line)
            print(
                f"on {robot}: failover team join, which asks for that line; it works once, for {arguments.span}, while this "
                "command runs; Ctrl-C ends it",
                file=sys.stderr,
            )
        sys.stdout.flush()
        return _await_it(arguments, listener, robot, span, site)


@contextmanager
def _listening(draft: Invitation) -> Iterator[tuple[Invitation, Listener]]:
    from failover.drivers.sockets import OneTimeListener  # here: ZeroMQ

    try:
        listener = OneTimeListener(draft.host, draft.port, draft.robot, draft.inviting_secret(), draft.joining_secret())
    except DriverError as error:
        raise InvitationError(f"cannot invite: {error}; {_cure(draft, error)}") from error
    try:
        yield replace(draft, port=listener.port), listener
    finally:
        listener.close()


def _cure(draft: Invitation, error: DriverError) -> str:
    number = getattr(error.__cause__, "errno", 0)
    if number == errno.EADDRINUSE:
        return f"another invitation is open, or another program uses port {draft.port}: --port names another one"
    if number == errno.EADDRNOTAVAIL:
        return f"no interface has {draft.host} now: see ip address; --address names another one of this robot"
    if number in (errno.EACCES, errno.EPERM):
        return f"only root may listen at port {draft.port}: --port names one from 1024 on"
    return "--address names another address of this robot, --port another port"


def _await_it(arguments: argparse.Namespace, listener: Listener, robot: str, span: int, site: str) -> int:
    until = time.monotonic() + span / 1_000
    while (left := until - time.monotonic()) > 0:
        came = listener.next(round(min(left * 1_000, POLL_MS)))
        if came is None:
            continue
        whose, content = came
        welcome = _welcome(arguments, robot, content, site)
        listener.answer(whose, msgspec.msgpack.encode(welcome))
        if welcome.refusal:
            print(f"failover: {robot} was refused: {welcome.refusal}", file=sys.stderr)
            continue
        confirmed = _is_confirmed(listener, whose)
        print(f"{robot} belongs to the team now" if confirmed else _unconfirmed(robot), file=sys.stderr)
        return 0 if confirmed else 1
    strangers = f"; {listener.refused} connections did not know its secret" if listener.refused else ""
    raise InvitationError(
        f"the invitation of {robot} is over after {arguments.span}, and was not used{strangers}; make a new one"
    )


def _is_confirmed(listener: Listener, whose: bytes) -> bool:
    """Whether the robot that was admitted says so, on the same connection."""
    until = time.monotonic() + CONFIRM_MS / 1_000
    while (left := until - time.monotonic()) > 0:
        came = listener.next(round(left * 1_000))
        if came is not None and came == (whose, b""):
            return True
    return False


def _unconfirmed(robot: str) -> str:
    return (
        f"{robot} belongs to the team now, and did not say that it has the answer: if failover status there does not work, "
        f"failover team remove {robot}, and invite it again"
    )


def _welcome(arguments: argparse.Namespace, robot: str, content: bytes, site: str = "") -> Welcome:
    """Take the robot into the team, if it can be."""
    directory = Path(arguments.directory)
    try:
        wish = msgspec.msgpack.decode(content, type=Wish)
        if wish.version != VERSION:
            raise InvitationError("it has another release of failover; install the same one on both")
        if wish.robot != robot:
            raise InvitationError(f"the invitation is for {robot}, and it calls itself {wish.robot}")
        if wish.member.role != arguments.role:
            raise InvitationError(f"the invitation is for a {arguments.role}, and {robot} would be a {wish.member.role}")
        further = _further_files(directory)
        _admit(arguments, directory, robot, wish.member.at(site))
    except UNDECODABLE:
        return Welcome("its message is not understood; install the same release of failover on both")
    except (FailoverError, OSError) as error:
        return Welcome(str(error))
    return Welcome(files=further | {team.TEAM_FILE: (directory / team.TEAM_FILE).read_bytes()})


def _further_files(directory: Path) -> dict[str, bytes]:
    """The other files that go along, looked at before the team changes.

    Raises:
        InvitationError: they are too large for a message.
    """
    files = {name: (directory / name).read_bytes() for name in FURTHER_FILES if (directory / name).exists()}
    size = sum(map(len, files.values()))
    if size > FILES_SIZE_MAX:
        raise InvitationError(f"{', '.join(files)} have {size} bytes, and {FILES_SIZE_MAX} can travel; copy the team by hand")
    return files


def _admit(arguments: argparse.Namespace, directory: Path, robot: str, member: Robot) -> None:
    """By the agent, which asks the other members; where none runs, only a robot that is alone in its team can admit another."""
    try:
        change_by_agent(arguments, "add", robot, member)
    except NoAgentError as error:
        before = team.read(directory)
        if len(before.robots) > 1:
            raise TeamFileError(f"the agent of the inviting robot must run, to ask the other members: {error}") from error
        team.write(directory, members.joined(before, robot, member))
    except LostAgentError:
        present = team.read(directory).robots.get(robot)
        if present is None or present.public_key != member.public_key:
            raise


# --- join ------------------------------------------------------------------------------------------------------------


def join(arguments: argparse.Namespace) -> int:
    """Make this machine a member, by the line that another robot has printed."""
    directory, invitation = Path(arguments.directory), read(_line(arguments.line, is_quiet=arguments.json))
    robot = invitation.robot
    agent_service.check_name(directory, robot)
    _check_that_it_is_free(directory, robot)
    _set_stray_key_aside(directory, robot)
    found = arguments.address or [addresses.address_towards(invitation.host, invitation.port)]
    public, secret = key_pairs.new_pair()
    member = member_of(robot, found, arguments.bulk, invitation.role, public)
    with _way(invitation) as way:
        way.send(msgspec.msgpack.encode(Wish(VERSION, robot, member)))
        answer = way.await_message(ANSWER_MS)
        if answer is None:
            raise InvitationError(
                f"{invitation.host} did not answer; failover team list there tells whether {robot} was taken in: if it was, "
                f"failover team remove {robot} there, then invite it again"
            )
        welcome = _understood(answer, invitation)
        if welcome.refusal:
            raise InvitationError(f"{invitation.host} refused: {welcome.refusal}")
        joined = _write(directory, robot, secret, welcome.files)
        way.send(b"")
        way.farewell()
    agent_service.name_robot(directory, robot)
    told = agent_service.start(directory) if arguments.start else agent_service.NOT_STARTED
    if arguments.json:
        render.as_json({"robot": robot, "team": joined.team, "members": sorted(joined.robots), "service": told})
    else:
        print(f"this machine is {robot} of team {joined.team}, with {', '.join(sorted(set(joined.robots) - {robot}))}; {told}")
    return 0


def _line(given: str, *, is_quiet: bool = False) -> str:
    """The invitation's line: asked for, so that its secret stands in no list of processes and in no shell's history.

    Raises:
        InvitationError: nothing came.
    """
    if given != "-" and is_quiet:
        return given
    if given != "-":
        print(
            "failover: the line's secret was on the command line, where other users of this machine may have seen it; without "
            "LINE, failover team join asks for it",
            file=sys.stderr,
        )
        return given
    if sys.stdin.isatty():
        print("the line of failover team invite: ", end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline().strip()
    if not line:
        raise InvitationError("no line came on standard input: paste the one that failover team invite printed")
    return line


def _understood(answer: bytes, invitation: Invitation) -> Welcome:
    try:
        return msgspec.msgpack.decode(answer, type=Welcome)
    except UNDECODABLE as error:
        raise InvitationError(
            f"the answer of {invitation.host} is not understood: {error}; install the same release of failover on both, and "
            f"there: failover team remove {invitation.robot}"
        ) from error


def _check_that_it_is_free(directory: Path, robot: str) -> None:
    if not (directory / team.TEAM_FILE).exists():
        return
    present = team.read(directory)
    if robot in present.robots:
        raise TeamFileError(
            f"{directory / team.TEAM_FILE} has {robot} in team {present.team} already; to leave that team: failover team remove "
            f"{robot} at another robot of it, then remove {directory} here"
        )
    if present.robots:
        me = own_name(directory)
        if me in present.robots:
            raise TeamFileError(f"this machine is {me} of team {present.team}; the invitation is for {robot}")


def _set_stray_key_aside(directory: Path, robot: str) -> None:
    """A key without a team that has this robot: of a join that broke off, or of a team that it has left.

    Raises:
        TeamFileError: it cannot be moved; nothing was asked yet.
    """
    key = team.secret_key_path(directory, robot)
    try:
        if key.exists():
            key.replace(key.with_suffix(".former"))
    except OSError as error:
        raise TeamFileError(f"cannot set the former key {key} aside: {error.strerror}; move it away") from error


class _Way:
    """The joining side's connection."""

    def __init__(self, invitation: Invitation) -> None:
        from failover.drivers.sockets import OneTimeWay  # here: ZeroMQ

        self._invitation = invitation
        self._linger_ms = 0
        host, port = invitation.host, invitation.port
        try:
            socket.create_connection((host, port), CONNECT_S).close()
        except OSError as error:
            raise InvitationError(
                f"no invitation is open at {host}:{port} ({error.strerror or error}): it was used, is over, or was ended; or a "
                f"firewall closes TCP port {port}; failover team invite {invitation.robot} makes a new one"
            ) from error
        self._way = OneTimeWay(host, port, invitation.joining_secret(), invitation.inviting_secret())

    def open(self) -> None:
        if not self._way.await_open(HANDSHAKE_MS):
            raise InvitationError(
                f"{self._invitation.host} does not know this invitation: it is of another time, for another robot, or altered; "
                f"failover team invite {self._invitation.robot} makes a new one"
            )

    def send(self, content: bytes) -> None:
        """Raises InvitationError: the connection is gone."""
        if not self._way.send(content):
            raise InvitationError(f"the connection to {self._invitation.host} was lost; try again while the invitation is open")

    def await_message(self, timeout_ms: int) -> bytes | None:
        return self._way.await_message(timeout_ms)

    def farewell(self) -> None:
        """What was sent last may still leave."""
        self._linger_ms = FAREWELL_MS

    def close(self) -> None:
        self._way.close(self._linger_ms)


@contextmanager
def _way(invitation: Invitation) -> Iterator[_Way]:
    way = _Way(invitation)
    try:
        way.open()
        yield way
    finally:
        way.close()


def _write(directory: Path, robot: str, secret: str, files: dict[str, bytes]) -> Team:
    """The files of the team and this robot's key: all of them, or none.

    Raises:
        TeamFileError: they cannot be written, or are none.
    """
    written: list[Path] = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        written.append(team.write_secret_key(directory, robot, secret))
        for name in (*FURTHER_FILES, team.TEAM_FILE):  # with the last one, it has joined
            if name in files:
                write_whole(directory / name, files[name], mode=0o666, lasts="name")
                written.append(directory / name)
        joined = team.read(directory)
        if robot not in joined.robots:
            raise TeamFileError(f"the answer has no robot {robot}; install the same release of failover on both")
    except (OSError, FailoverError) as error:
        for path in written:
            with contextlib.suppress(OSError):
                path.unlink()
        why = f"{error.strerror}: {error.filename}" if isinstance(error, OSError) else str(error)
        raise TeamFileError(
            f"cannot keep the team in {directory}: {why}; at the other robot: failover team remove {robot}"
        ) from error
    return joined


def _span_ms(text: str) -> int:
    try:
        span = span_ms(text)
    except ValueError as error:
        raise TeamFileError(f"--for: {error}") from error
    if not 0 < span <= SPAN_MS_MAX:
        raise TeamFileError(f"--for {text}: an invitation is open for a day at most")
    return span
