"""The files of this robot's board as the team file declares it: made when the agent starts, or taken over as they were left.

The memory outlives the agent: programs go on with it, and an agent that starts again finds it. Only if the declarations or the
kernel's boot are others it is made anew; programs that have the old one open are told so, and open the new one.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import grp
import logging
import os
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from msgspec.structs import replace

from agent.config import Settings
from agent.errors import AgentError
from agent.system.permissions import NOBODY, uid_named
from agent.worker import kept_items
from failover.boards import LINK_NAME, SCHEDULE_NAME, SCHEDULE_PLACE, agents_file, boottime, directory
from failover.boards.agents_file import AgentsFile
from failover.boards.mapping import USER_PREFIX, uid_of
from failover.boards.received import ReceivedItems
from failover.boards.unmapped_file import UnmappedFile
from failover.boards.unmapped_schedule import UnmappedSchedule
from failover.core.board import layout
from failover.core.board.announcements import first_number
from failover.core.board.item_types import ITEM_SIZE_MAX
from failover.core.board.items import ITEMS_MAX, Board, Item
from failover.core.board.owners import Owner, Owners, encode
from failover.core.frames.frame import Portion
from failover.errors import BoardError, ScheduleError

DIRECTORY_MODE: Final = 0o755
PROGRAMS_MODE: Final = 0o660
PEERS_MODE: Final = 0o640

PRIMARIES: Final = Item(agents_file.PRIMARIES, "msgpack", size=ITEM_SIZE_MAX, shared=False)
"""In the agent's own file: which robot runs which component (`failover.boards.component_item`)."""
NO_LIST: Final = (errno.EOPNOTSUPP, errno.EINVAL)
"""The kernel has no access control lists on tmpfs; this agent's user namespace has no such uid."""
OWNERS_NUMBER: Final = 1
OWNERS: Final = Item(agents_file.OWNERS, size=ITEM_SIZE_MAX, shared=False)
"""There too, if there are such items: whose the items are that one user alone may put (`failover.core.board.owners`)."""

log = logging.getLogger("failover.lanes")


def place_of(settings: Settings) -> Path:
    """Where this robot's board is."""
    return directory.agents_place(settings.team.team, settings.config.robot)


def provide(settings: Settings, tell: Callable[[str], None] = log.warning) -> Path | None:
    """Have every file of the board at its place, and a link to it beside the control socket; None for a team without a board.

    Args:
        tell: is told of users whose items no program of this robot can put, in a sentence.

    Raises:
        AgentError, BoardError, OSError: it cannot be had.
    """
    board = settings.team.items()
    link = Path(settings.config.runtime_directory) / LINK_NAME
    if not board.items or settings.me.role != "robot":
        if link.is_symlink():
            directory.dismiss(link / SCHEDULE_NAME)  # its tasks go on at the place without a board
        link.unlink(missing_ok=True)
        return None
    place, me = place_of(settings), settings.config.robot
    _make_directory(place)
    ranks = settings.team.roster().ranks
    robots = [name for name in ranks if settings.team.robots[name].role == "robot"]
    files = _Files(place, board.digest, _group(board.group), ranks)
    for name in robots:
        if name != me:
            files.have(f"{directory.PEER_PREFIX}{name}", layout.PEER, name, board.shared_by(name))
    for path in place.glob(f"{directory.PEER_PREFIX}*"):
        if path.name.removeprefix(directory.PEER_PREFIX) not in set(robots) - {me}:
            directory.dismiss(path)
    owned = board.owned
    uids = _uids(
        [item for item in owned.values() if item.is_at(me)], files.former_owners(me), me, tell
    )  # first: a directory of users may let it wait
    files.retire_unfit(directory.OWN_NAME, layout.OWN, me)  # until another one is there no program sees a part of what follows
    files.have(directory.AGENT_NAME, layout.PEER, me, {0: PRIMARIES, OWNERS_NUMBER: OWNERS} if owned else {0: PRIMARIES})
    files.have_owned(me, owned, uids, tell)
    kept = _kept(Path(settings.config.state_directory), board, me)
    private, own = (
        {n: item for n, item in some.items() if not item.user} for some in (board.private_of(me), board.shared_by(me))
    )
    files.have(directory.PRIVATE_NAME, layout.PRIVATE, me, private, [one for one in kept if not one.shared])
    files.have(directory.OWN_NAME, layout.OWN, me, own, [one for one in kept if one.shared])
    files.have_schedule(me)
    _point(link, place)
    _leave(Path(settings.config.runtime_directory) / SCHEDULE_PLACE)
    return place


def damaged_files(place: Path) -> list[str]:
    """A sentence for each user who has damaged his file since it was made."""
    owners: Owners = {}
    with contextlib.suppress(BoardError):
        owners = AgentsFile(place).owners() or {}
    told = []
    for uid, user in sorted({(owner.uid, owner.user) for owner in owners.values() if owner.uid is not None}):
        try:
            with contextlib.closing(UnmappedFile.open(place / f"{USER_PREFIX}{uid}")) as file:
                file.table()
        except (BoardError, OSError) as error:
            told.append(
                f"user {user!r} has damaged the file of that user's items, which are not sent ({error}): end that program, and "
                "restart the agent, which makes the file anew"
            )
    return told


def _leave(former: Path) -> None:
    """The robot had no board before: tell its tasks that the schedule is beside the board now."""
    directory.dismiss(former / SCHEDULE_NAME)
    with contextlib.suppress(OSError):
        former.rmdir()


def _kept(state: Path, board: Board, robot: str) -> list[Item]:
    """What programs have added with keep = true, without what is declared now."""
    declared = {item.name for some in (board.shared_by(robot), board.private_of(robot), board.owned) for item in some.values()}
    kept = kept_items.read(state)
    for item in kept:
        if item.name in declared:
            log.warning("item %s is declared in team.toml now: what a program had added under this name is not kept", item.name)
    return [item for item in kept if item.name not in declared]


class _Files:
    """The files of one board."""

    def __init__(self, place: Path, digest: int, group: int, ranks: Mapping[str, int]) -> None:
        self._place = place
        self._digest = digest
        self._group = group
        self._ranks = ranks

    def former_owners(self, robot: str) -> Owners:
        """What the agent before told of these very items, since the machine started."""
        if self._fits(self._place / directory.AGENT_NAME, layout.PEER, robot):
            with contextlib.suppress(BoardError):
                return AgentsFile(self._place).owners() or {}
        return {}

    def retire_unfit(self, name: str, area: int, robot: str) -> None:
        """Tell the users of a file that it is to be made anew. Its name stays: where there is none, a program makes a board."""
        if not self._fits(self._place / name, area, robot):
            directory.retire(self._place / name)

    def have_owned(self, robot: str, items: Mapping[int, Item], uids: Mapping[str, int], tell: Callable[[str], None]) -> None:
        """A file of each user who alone may put items, and none of former ones; and the table that says whose is what.

        Also an item that this robot is not to have stands in the table: else each program could add one of that name.
        """
        of_uid: dict[int, dict[int, Item]] = {}
        for number, item in items.items():
            of_uid.setdefault(uids[item.user] if item.is_at(robot) else NOBODY, {})[number] = item
        lacking = of_uid.pop(NOBODY, {})
        for path in self._place.glob(f"{USER_PREFIX}*"):
            if uid_of(path) not in of_uid:
                directory.dismiss(path)
        for uid, theirs in of_uid.items():
            try:
                self._have_of_user(uid, robot, theirs)
            except (BoardError, OSError) as error:
                lacking |= theirs
                directory.dismiss(self._place / f"{USER_PREFIX}{uid}")
                why = f"there is no file for uid {uid} in {self._place} ({error})"
                cure = "free /dev/shm, and restart the agent"
                if isinstance(error, OSError) and error.errno in NO_LIST:
                    why = f"{self._place} takes no access control list with uid {uid} ({error.strerror})"
                    cure = (
                        "use a kernel with CONFIG_TMPFS_POSIX_ACL and a user namespace that has this uid, or declare them "
                        "without user"
                    )
                tell(f"{why}: no program here can put {_names(theirs.values())}; {cure}")
        owners = {one.name: Owner(n, one.user, None if n in lacking else uids[one.user]) for n, one in items.items()}
        if items and AgentsFile(self._place).owners() != owners:
            table = ReceivedItems.open(self._place / directory.AGENT_NAME)
            table.take((Portion(OWNERS_NUMBER, 0, 1, encode(owners)),), boottime.machine_ns(), 0, 0)
            table.file.close()

    def _have_of_user(self, uid: int, robot: str, items: Mapping[int, Item]) -> None:
        items = {number: replace(item, transmit=item.transmit and item.is_shared_by(robot)) for number, item in items.items()}
        path = self._place / f"{USER_PREFIX}{uid}"
        if self._fits(path, layout.OWN, robot, [layout.wanted_of(item, number) for number, item in items.items()]):
            os.chown(path, -1, self._group)
            directory.give_to(path, uid, PEERS_MODE)
            return
        self._make(path, layout.OWN, robot, PEERS_MODE, user=uid, capacity=len(items))(items=items)

    def have(self, name: str, area: int, robot: str, items: Mapping[int, Item], kept: Sequence[Item] = ()) -> None:
        """Keep a file that fits; make it otherwise, with the items that were ``kept`` as far as they have room."""
        path = self._place / name
        mode = PEERS_MODE if area == layout.PEER else PROGRAMS_MODE
        if self._fits(path, area, robot):
            os.chown(path, -1, self._group)
            path.chmod(mode)
            return
        make = self._make(path, area, robot, mode)
        first = first_number(self._ranks[robot])

        left_out: list[str] = []
        while True:
            added = kept[: len(kept) - len(left_out)]
            try:
                make(items={**items, **dict(enumerate(added, first))})
            except BoardError as error:
                if not added:
                    raise
                why, left_out = error, [added[-1].name, *left_out]
            else:
                break
        if left_out:
            log.warning("items that programs had added with keep = true are not added again: %s: %s", ", ".join(left_out), why)

    def _make(self, path: Path, area: int, robot: str, mode: int, **more: Any) -> Callable[..., int]:
        return functools.partial(
            directory.make_file,
            path,
            area,
            robot,
            rank=self._ranks[robot],
            state=layout.NOT if area == layout.PEER else layout.RUN,
            digest=self._digest,
            mode=mode,
            group=self._group,
            replacing=True,
            **more,
        )

    def have_schedule(self, robot: str) -> None:
        """Keep the table of this robot's tasks if it is of this boot: its tasks go on while no agent runs."""
        path = self._place / SCHEDULE_NAME
        with contextlib.suppress(ScheduleError, FileNotFoundError):
            file = UnmappedSchedule.at(path)
            header = file.header
            file.close()
            if (header.boot_id, header.robot) == (boottime.boot_id(), robot):
                os.chown(path, -1, self._group)
                path.chmod(PROGRAMS_MODE)
                return
        directory.dismiss(path)
        directory.make_schedule(self._place, robot, mode=PROGRAMS_MODE, group=self._group)

    def _fits(self, path: Path, area: int, robot: str, items: Sequence[layout.Wanted] | None = None) -> bool:
        """Whether a file is as it is to be; ``items``: with these and no others."""
        try:
            with contextlib.closing(UnmappedFile.open(path)) as file:
                header, records = file.table()
        except (BoardError, OSError):
            return False
        if area == layout.PEER and header.count - len(records) > ITEMS_MAX // 2:
            return False  # no room is left for what that robot adds
        if items is not None and not (len(records) == len(items) and all(map(layout.is_exactly, records, items))):
            return False
        found = (header.flags, header.roster_digest, header.boot_id, header.robot, header.rank)
        return found == (area, self._digest, boottime.boot_id(), robot, self._ranks[robot])


def _uids(items: Sequence[Item], former: Owners, robot: str, tell: Callable[[str], None]) -> dict[str, int]:
    """The numbers of the users who alone may put items; `NOBODY` for one whom this robot does not have.

    Where users are in a directory elsewhere, a look-up can fail for a while: who had a number keeps it until the next boot.
    """
    uids: dict[str, int] = {}
    before = {owner.user: owner.uid for owner in former.values() if owner.uid is not None}
    for user in sorted({item.user for item in items}):
        uids[user], names = uid_named(user), _names(item for item in items if item.user == user)
        if uids[user] == NOBODY and user in before:
            uids[user] = before[user]
            tell(
                f"{robot} finds no user {user!r} now, and had one: uid {before[user]} may still put {names}; see getent passwd, "
                "and restart the machine if the user was removed"
            )
        elif uids[user] == NOBODY:
            tell(f"{robot} has no user {user!r}: no program here can put {names}; make the user, and restart the agent")
    return uids


def _names(items: Iterable[Item]) -> str:
    return ", ".join(item.name for item in items)


def _make_directory(place: Path) -> None:
    with contextlib.suppress(FileExistsError):
        place.mkdir()
    found = place.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        raise AgentError(f"{place} belongs to uid {found.st_uid}, so this robot has no board; remove it, and restart the agent")
    place.chmod(DIRECTORY_MODE)


def _group(name: str) -> int:
    if not name:
        return os.getegid()
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError as error:
        raise AgentError(
            f"group = {name!r} of [board] in team.toml: this system has no such group, so this robot has no board; make the group"
        ) from error


def _point(link: Path, place: Path) -> None:
    aside = link.with_name(f"{link.name}.new")
    aside.unlink(missing_ok=True)
    aside.symlink_to(place)
    aside.replace(link)
