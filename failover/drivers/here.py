"""Where this process is: the robot, the directory where its user's drivers meet, and whether other robots may reach them.

Drivers of one user on one robot meet in a directory that only this user may enter: `$FAILOVER_DRIVERS`, else
``/dev/shm/failover-uUID-drivers``. Of each driver there are in it, by the path's steps with dots between them:

======================== ============================================================================
``Lab.robot1.PWM.lock``  held by the driver's process as long as it lives; holds its pid
``Lab.robot1.PWM.calls`` a stream of messages, each after its size in four bytes
``Lab.robot1.PWM.hand``  a stream of JSON objects, as ``nc -U`` writes them
``Lab.robot1.PWM.names`` datagrams of its name service
``Lab.robot1.PWM.done``  what it has carried out, if it keeps no state
======================== ============================================================================

Other robots reach a driver only by CURVE keys of the team (`$FAILOVER_TEAM`, else ``/etc/failover/team``): without a key that
this user may read, no driver opens a port.
"""

from __future__ import annotations

import logging
import os
import stat
import time
from pathlib import Path
from typing import Final

import xxhash
from msgspec import Struct
from msgspec.structs import replace

from failover.boards import locks
from failover.boards.directory import SHARED_MEMORY, this_robot
from failover.config import team as team_file
from failover.config.team import Team, split_address
from failover.core.naming import worlds
from failover.core.naming.tree import Claims
from failover.errors import DriverError, FailoverError, TeamFileError

DIRECTORY: Final = "FAILOVER_DRIVERS"
TEAM: Final = "FAILOVER_TEAM"
ROBOT: Final = "FAILOVER_ROBOT"
SYSTEM_TEAM: Final = Path("/etc/failover/team")

ADDRESS_SIZE_MAX: Final = 107
"""Bytes of a unix socket's path. Source: unix(7)."""

LOCK_AT: Final = 0
"""The byte of a lock file that its driver holds."""

RETRY_NS: Final = 1_000_000_000
"""Between two tries to read files of the team that could not be read."""

log = logging.getLogger("failover.drivers")

_LONGEST_ENDING: Final = len(".names")
_HASH_SIZE: Final = 17


class Here(Struct, frozen=True):
    """This robot, as one process sees it.

    Attributes:
        directory: where the drivers of this user meet.
        team: the members and their public keys; None: other robots are not reached.
        secret: this robot's CURVE key, Z85; "" without a team.
        alone: why other robots are not reached, one sentence; "" if they are.
        rules: the team directory, where rights.toml may lie.
        world: where this process lives, see `failover.core.naming.worlds`.
    """

    robot: str
    directory: Path
    team: Team | None = None
    secret: str = ""
    alone: str = ""
    rules: Path = SYSTEM_TEAM
    world: str = ""

    @property
    def host(self) -> str:
        """The address at which other robots reach this one."""
        return host_and_port(self.team, self.robot)[0] if self.team is not None else ""

    @property
    def others(self) -> tuple[str, ...]:
        """All other robots of the team."""
        members = self.team.robots.items() if self.team is not None else ()
        return tuple(name for name, robot in members if name != self.robot and robot.role == "robot")

    @property
    def claims(self) -> Claims:
        """Which paths belong to which robot."""
        return Claims(frozenset(self.team.robots)) if self.team is not None else Claims()

    @property
    def keys(self) -> dict[str, str]:
        """Public key, Z85 → the member that it proves. A member that replaces its key has two for a while."""
        members = self.team.robots.items() if self.team is not None else ()
        return {key: name for name, robot in members for key in robot.keys}

    def file(self, path: str, ending: str) -> Path:
        """A driver's file."""
        return self.directory / f"{stem(path, self.directory)}.{ending}"


def here() -> Here:
    """What environment and files say.

    Raises:
        DriverError: the directory cannot be used, or the files contradict each other.
        NameFormatError: $FAILOVER_WORLD names no simulated world.
    """
    directory = Path(os.environ.get(DIRECTORY) or SHARED_MEMORY / f"failover-u{os.geteuid()}-drivers")
    _prepare(directory)
    place = Path(os.environ.get(TEAM) or SYSTEM_TEAM)
    world = worlds.checked(os.environ.get(worlds.VARIABLE, ""))
    try:
        return replace(_of_team(directory, place, os.environ.get(ROBOT) or _robot_of(place)), world=world)
    except (TeamFileError, OSError) as error:
        if os.environ.get(TEAM):
            raise DriverError(f"cannot use the team that {TEAM} names: {error}") from error
        alone = f"there is no key for other robots: {error}"
        return Here(os.environ.get(ROBOT) or this_robot(), directory, alone=alone, rules=place, world=world)


def _of_team(directory: Path, place: Path, robot: str) -> Here:
    team = team_file.read(place)
    if robot not in team.robots:
        raise TeamFileError(f"{place} has no robot {robot!r}; {ROBOT} says which one this is")
    if not all(one.public_key for one in team.robots.values()):
        raise TeamFileError(f"the team in {place} is one without keys; enrol its robots with keys")
    return Here(robot, directory, team, team_file.read_secret_key(place, robot), rules=place)


class TeamNow:
    """This robot and its team as the files have them now; used by one thread.

    Members come and go, and keys are replaced, while drivers run: the agents write the files, and no driver is told.

    Attributes:
        here: as it was at the last look. What cannot be read, or has no place for this robot, changes nothing.
    """

    def __init__(self, here: Here) -> None:
        self.here = here
        files = (here.rules / team_file.TEAM_FILE, team_file.secret_key_path(here.rules, here.robot))
        self._files = tuple(map(os.fspath, files))
        self._stamps: tuple[tuple[int, ...], ...] = ()
        self._failed_stamps: tuple[tuple[int, ...], ...] = ()
        self._retry_ns = 0
        self._trouble = ""

    def look(self) -> bool:
        """Whether members or keys are others than at the last look; a microsecond or two where no file has changed."""
        before = self.here
        if before.team is None:
            return False
        stamps = tuple(map(_stamp, self._files))
        if stamps == self._stamps or (stamps == self._failed_stamps and time.monotonic_ns() < self._retry_ns):
            return False
        try:
            self._read(before)
        except (FailoverError, OSError) as error:
            self._failed_stamps, self._retry_ns = stamps, time.monotonic_ns() + RETRY_NS
            self._say(f"cannot read the team's present members and keys: {error}; trying again once a second")
        else:
            self._stamps, self._failed_stamps = stamps, ()
            self._say("")
        return (self.here.team, self.here.secret) != (before.team, before.secret)

    def _read(self, before: Here) -> None:
        """Take the public keys first: they count, whether or not this robot's own key can be read."""
        team = team_file.read(before.rules)
        if before.team is not None and team.team != before.team.team:
            raise TeamFileError(f"{self._files[0]} is of team {team.team}, and this process began in {before.team.team}")
        if before.robot not in team.robots:
            raise TeamFileError(f"{self._files[0]} has no robot {before.robot!r} any more; end this process")
        self.here = replace(before, team=team)
        self.here = replace(self.here, secret=team_file.read_secret_key(before.rules, before.robot))

    def _say(self, trouble: str) -> None:
        """Log it once, not at each try."""
        if trouble and trouble != self._trouble:
            log.error("%s", trouble)
        self._trouble = trouble


def _stamp(path: str) -> tuple[int, ...]:
    """By which a file is told from the one that takes its place."""
    try:
        found = os.stat(path)
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size


def _robot_of(place: Path) -> str:
    """The robot whose secret key lies here; without just one: named as the machine."""
    secrets = list((place / "keys").glob("*.secret"))
    return secrets[0].stem if len(secrets) == 1 else this_robot()


def host_and_port(team: Team, robot: str) -> tuple[str, int]:
    """Where a robot's name service listens: at the host of its replication link, one port above."""
    host, port = split_address(team.robots[robot].bulk, f"robot {robot}")
    return host, port + 1


def _prepare(directory: Path) -> None:
    """Make it if need be; refuse one that others may enter, or that another user put there."""
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise DriverError(f"cannot make {directory}, where drivers meet: {error.strerror}; {DIRECTORY} names another") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        raise DriverError(f"{directory} is no directory of this user: remove it, or name another place in {DIRECTORY}")
    if found.st_mode & 0o022:
        raise DriverError(f"others may write to {directory} (mode {found.st_mode & 0o777:o}); run: chmod 700 {directory}")


def stem(path: str, directory: Path) -> str:
    """The name of a driver's files: readable; with a hash where that would be too long, or the name of another path's files."""
    plain = path.replace("/", ".")
    room = ADDRESS_SIZE_MAX - len(os.fsencode(directory)) - 1 - _LONGEST_ENDING
    if "." not in path and len(plain.encode()) <= room:
        return plain
    room -= _HASH_SIZE
    if room < 1:
        raise DriverError(f"{directory} is too long for the addresses of drivers: name a shorter place in {DIRECTORY}")
    return f"{plain.encode()[-room:].decode(errors='ignore').lstrip('.')}-{xxhash.xxh3_64_hexdigest(path.encode())}"


def hold(here: Here, path: str) -> int:
    """Be the one process of a driver on this robot: a lock, for as long as the descriptor is open.

    Raises:
        DriverError: another process is; names its pid.
    """
    lock = here.file(path, "lock")
    descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    if not locks.take(descriptor, LOCK_AT):
        told = _told_of(descriptor, path)
        os.close(descriptor)
        raise DriverError(told)
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, b"%d\n" % os.getpid(), 0)
    return descriptor


def _told_of(descriptor: int, path: str) -> str:
    pid = os.pread(descriptor, 20, 0).decode(errors="replace").strip()
    return f"pid {pid or 'unknown'} is the driver of {path} on this robot already; end that, or take another path"


def refuse_second(here: Here, path: str) -> None:
    """Nothing where no process is the driver of a path; `hold` decides later between two that come at once.

    Raises:
        DriverError: one is; names its pid.
    """
    try:
        descriptor = os.open(here.file(path, "lock"), os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if locks.is_taken(descriptor, LOCK_AT):
            raise DriverError(_told_of(descriptor, path))
    finally:
        os.close(descriptor)


def lives(here: Here, path: str) -> bool:
    """Whether a process of this robot is the driver of a path, and of no other."""
    return _is_held(here.file(path, "lock"))


def is_served(calls: str) -> bool:
    """Whether a process takes messages at this file of a driver, ``….calls``."""
    return _is_held(Path(calls).with_suffix(".lock"))


def _is_held(lock: Path) -> bool:
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return locks.is_taken(descriptor, LOCK_AT)
    finally:
        os.close(descriptor)
