"""The files of this robot's board: made when the agent starts, or taken over from the agent before, and never removed by it.

Programs keep them open while the agent restarts. Files of an earlier boot, of another roster or other declarations, or of users
without an agent are marked as gone, and others take their place; programs open those at their next call.
"""

from __future__ import annotations

import contextlib
import grp
import os
from collections.abc import Iterable
from pathlib import Path

from agent.errors import AgentError
from failover.boards import boottime
from failover.boards.directory import LINK_NAME, OWN_NAME, PEER_PREFIX, PRIVATE_NAME, SHARED_MEMORY, make_file
from failover.boards.mapping import GENERATION, MappedFile
from failover.core.board import layout
from failover.core.board.items import Board, Item
from failover.core.board.layout import GONE, OWN, PEER, PRIVATE, wanted_of
from failover.core.frames.roster import Roster
from failover.core.wire.codec import team_tag
from failover.errors import BoardError


class BoardFiles:
    """What the agent has mapped. ``peers``: by name of the robot."""

    def __init__(self, directory: Path, own: MappedFile, peers: dict[str, MappedFile]) -> None:
        self.directory, self.own, self.peers = directory, own, peers


def place_of(team: str, robot: str) -> Path:
    """Where the board of a robot of a team lies: robots of one machine, and teams, have one each."""
    return SHARED_MEMORY / f"failover-{team_tag(team).hex()}-{robot}"


def open_files(team: str, me: str, roster: Roster, board: Board, runtime_directory: Path) -> BoardFiles:
    """All files of the board of robot ``me``, and the link by which programs find them.

    Raises:
        AgentError: they cannot be made; says why, and what to do.
    """
    directory = place_of(team, me)
    group = _group_of(board)
    try:
        directory.mkdir(mode=0o755, exist_ok=True)
        if directory.lstat().st_uid != os.geteuid():
            raise AgentError(f"cannot make the board {directory}: it belongs to uid {directory.lstat().st_uid}; remove it")
        directory.chmod(0o755)
        _file(directory / PRIVATE_NAME, PRIVATE, me, roster, board.private_of(me).items(), group)
        peers = {
            name: _file(directory / f"{PEER_PREFIX}{name}", PEER, name, roster, board.shared_by(name).items(), group)
            for name in roster.names
            if name != me
        }
        own = _file(directory / OWN_NAME, OWN, me, roster, board.shared_by(me).items(), group)
        for stray in directory.glob(f"{PEER_PREFIX}*"):
            if stray.name.removeprefix(PEER_PREFIX) not in peers:
                _leave(stray)
        _link(runtime_directory / LINK_NAME, directory)
    except (OSError, BoardError) as error:
        raise AgentError(
            f"cannot make the board {directory}: {error}; remove the directory, or [board] from team.toml"
        ) from error
    return BoardFiles(directory, own, peers)


def _group_of(board: Board) -> int:
    """The group whose members may put items here; -1: none besides the agent's user.

    Raises:
        AgentError: there is no such group.
    """
    if not board.group:
        return -1
    try:
        return grp.getgrnam(board.group).gr_gid
    except KeyError as error:
        raise AgentError(
            f"there is no group {board.group!r} on this robot, and [board] of team.toml names it; make it with groupadd"
        ) from error


def _file(path: Path, area: int, robot: str, roster: Roster, declared: Iterable[tuple[int, Item]], group: int) -> MappedFile:
    """A file as it is, if it fits; else another one in its place."""
    file = _adopted(path, area, robot, roster)
    if file is None:
        _leave(path)
        mode = (0o640 if area == PEER else 0o660) if group >= 0 else 0o600
        state = layout.NOT if area == PEER else layout.RUN
        make_file(path, area, robot, rank=roster.ranks[robot], state=state, roster_digest=roster.digest, mode=mode)
        if group >= 0:
            os.chown(path, -1, group)
        file = MappedFile.open(path, writable=True)
        with file.changing():
            for number, item in declared:
                file.add(wanted_of(item, number))
    return file


def _adopted(path: Path, area: int, robot: str, roster: Roster) -> MappedFile | None:
    """The file of the agent before; None where there is none that fits."""
    try:
        file = MappedFile.open(path, writable=True)
    except (BoardError, OSError):
        return None
    header = file.header
    told = (header.flags, header.robot, header.roster_digest, header.boot_id)
    if told == (area, robot, roster.digest, boottime.boot_id()):
        file.mend()
        return file
    file.close()
    return None


def _leave(path: Path) -> None:
    """Tell those who have a file open that it is gone, and unlink it."""
    with contextlib.suppress(OSError, BoardError):
        file = MappedFile.open(path, writable=True)
        file.words[GENERATION] = GONE
        file.close()
    path.unlink(missing_ok=True)


def _link(link: Path, directory: Path) -> None:
    if link.is_symlink() and Path(os.readlink(link)) == directory:
        return
    link.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
    aside = link.with_name(f"{LINK_NAME}.new")
    aside.unlink(missing_ok=True)
    aside.symlink_to(directory)
    aside.replace(link)
