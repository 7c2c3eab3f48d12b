"""The directory of a board: where it is, and, without an agent, how its first user makes it and its last one removes it.

Each file appears whole: it is made without a name (O_TMPFILE), filled, and then linked to its place. `own` is linked last and
unlinked last, with its maker already counted as a user. So a directory with `own` is a board, and one without is none yet.
"""

from __future__ import annotations

import contextlib
import os
import stat
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from failover.boards import LINK_NAME, SCHEDULE_NAME, SCHEDULE_PLACE, boottime, locks
from failover.boards.mapping import MappedFile
from failover.boards.unmapped_file import UnmappedFile
from failover.client.control import socket_path
from failover.core.board import layout
from failover.core.board.items import ITEMS_MAX, Item
from failover.core.board.layout import ALONE, GONE, OWN, PEER, PRIVATE, TABLE_LOCK, USER_LOCKS, USERS_MAX
from failover.core.schedule import layout as schedule_layout
from failover.core.wire.codec import team_tag
from failover.core.wire.names import check_robot
from failover.errors import BoardError, BoardGoneError, NameFormatError

VARIABLE: Final = "FAILOVER_BOARD"
SHARED_MEMORY: Final = Path("/dev/shm")

OWN_NAME: Final = "own"
PRIVATE_NAME: Final = "private"
AGENT_NAME: Final = "agent"
PEER_PREFIX: Final = "peer-"
GUEST_PREFIX: Final = "guest-"
"""Of simulated robots: no agent receives for them, and only programs of their world take them for robots of the team."""

_RIGHTS: Final = "system.posix_acl_access"
_ACL_VERSION: Final = (2).to_bytes(4, "little")
_ENTRY: Final = struct.Struct("<HHI")
_USER_OBJ, _USER, _GROUP_OBJ, _MASK, _OTHER = 1, 2, 4, 16, 32
_NOBODY: Final = 2**32 - 1

TURNS: Final = 5000
"""Of making or opening a board that others make and remove at the same time."""

GONE_WAIT_S: Final = 2.0
GONE_LOOK_S: Final = 0.001
"""How long a program waits for a board that its agent makes anew, and between two looks."""


def find() -> Path:
    """Where this program's board is: ``$FAILOVER_BOARD``, the agent's, or that of this user's programs without an agent."""
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named)
    link = socket_path().parent / LINK_NAME
    if link.exists():
        return link
    return _of_this_user()


def find_schedule() -> Path:
    """Where this program's schedule is: beside the board; without one, the agent's place if this user may use it."""
    place = socket_path().parent / SCHEDULE_PLACE
    found = find()
    if found == _of_this_user() and os.access(place, os.R_OK | os.W_OK | os.X_OK, effective_ids=True):
        return place
    return found


def is_agents_place(directory: Path) -> bool:
    """Whether a directory holds the schedule of a robot without a board: no board is made there."""
    return directory.name == SCHEDULE_PLACE


def _of_this_user() -> Path:
    return SHARED_MEMORY / f"failover-u{os.geteuid()}-{this_robot()}"


def agents_place(team: str, robot: str) -> Path:
    """Where the agent of a robot of a team has the board: robots on one machine, and teams, have one each."""
    return SHARED_MEMORY / f"failover-{team_tag(team).hex()}-{robot}"


def this_robot() -> str:
    """What a robot without an agent is called: as its machine."""
    name = os.uname().nodename
    with contextlib.suppress(NameFormatError):
        return check_robot(name)
    return "robot"


def make_file(
    path: Path,
    flags: int,
    robot: str,
    *,
    items: Mapping[int, Item] | None = None,
    capacity: int = ITEMS_MAX,
    rank: int = 0,
    state: int = layout.RUN,
    digest: int = 0,
    mode: int = 0o600,
    group: int = -1,
    user: int | None = None,
    hold: bool = False,
    replacing: bool = False,
) -> int:
    """Make one file of a board, whole at its place.

    Args:
        flags: which area it is, and whether it is made without an agent.
        items: number → declaration; from `ITEMS_MAX` on they were added at run time.
        digest: of the team's declarations.
        group: whose it is to be; -1: this process's.
        user: the one who may write it beside its owner, with what ``mode`` lets its owner do; None: nobody.
        hold: return an opening that is user 0 already and has the table lock.
        replacing: it takes the place of a file that is there; at no instant is there none.

    Returns:
        The opening, or -1 without ``hold``.

    Raises:
        FileExistsError: there is one, without ``replacing``.
        OSError: it cannot be made there.
        BoardError: there is no room for so many items.
    """
    header = layout.new_header(
        flags, capacity, check_robot(robot), boottime.boot_id(), rank=rank, state=state, roster_digest=digest
    )
    with _linked(path, mode, group, replacing) as made:
        if user is not None:
            give_to(made, user, mode)
        os.ftruncate(made, layout.names_at(capacity))
        os.pwrite(made, header, 0)
        for number, item in (items or {}).items():
            fields = layout.read_header(os.pread(made, layout.names_at(capacity), 0))
            added = layout.ADDED if number >= ITEMS_MAX else 0
            addition = layout.addition(fields, layout.wanted_of(item, number, added))
            os.ftruncate(made, addition.size)
            for offset, piece in addition.pieces:
                os.pwrite(made, piece, offset)
        if hold:
            locks.take(made, TABLE_LOCK)
            locks.take(made, USER_LOCKS)
    if hold:
        return made
    os.close(made)
    return -1


def give_to(file: int | Path, user: int, mode: int) -> None:
    """Have one user read and write a file as its owner may, the owner's group as ``mode`` says, and nobody else.

    By an access control list, not by making the user its owner: that needs no capability, and the owner of a file could close
    it to the agent. Source: acl(5); the list's bytes: `struct posix_acl_xattr_entry` in include/uapi/linux/posix_acl_xattr.h.

    Raises:
        OSError: this kernel has no such lists on tmpfs (CONFIG_TMPFS_POSIX_ACL), or the file is not this user's.
    """
    owner, group = mode >> 6 & 7, mode >> 3 & 7
    entries = ((_USER_OBJ, owner, _NOBODY), (_USER, owner, user), (_GROUP_OBJ, group, _NOBODY), (_MASK, owner, _NOBODY))
    rights = b"".join(_ENTRY.pack(*entry) for entry in (*entries, (_OTHER, 0, _NOBODY)))
    if isinstance(file, int) or rights_of(file) != rights:
        os.setxattr(file, _RIGHTS, _ACL_VERSION + rights)


def rights_of(path: Path) -> bytes:
    """The entries of a file's access control list; b"" where it has none."""
    try:
        return os.getxattr(path, _RIGHTS)[len(_ACL_VERSION) :]
    except OSError:
        return b""


@contextmanager
def _linked(path: Path, mode: int, group: int = -1, replacing: bool = False) -> Iterator[int]:
    """A file without a name that the body fills; then it has its place. The caller closes it."""
    place = path.with_name(f".{path.name}.new") if replacing else path
    made = os.open(path.parent, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, mode)
    try:
        os.fchown(made, -1, group)
        os.fchmod(made, mode)  # not what the umask leaves of it
        yield made
        if replacing:
            place.unlink(missing_ok=True)
        os.link(f"/proc/self/fd/{made}", place, src_dir_fd=made)  # with a descriptor Python follows the link, linkat(2)
        if replacing:
            retire(path)
            place.replace(path)
    except BaseException:
        os.close(made)
        raise


def make_schedule(place: Path, robot: str, flags: int = 0, *, mode: int = 0o600, group: int = -1) -> None:
    """The table of a robot's tasks, without tasks.

    Raises:
        FileExistsError: there is one.
        OSError: it cannot be made there.
    """
    second = 1_000_000_000
    origin_ns = boottime.machine_ns() // second * second
    header = schedule_layout.new_header(check_robot(robot), boottime.boot_id(), origin_ns, flags)
    with _linked(place / SCHEDULE_NAME, mode, group) as made:
        os.ftruncate(made, schedule_layout.FILE_SIZE)
        os.pwrite(made, header, 0)
    os.close(made)


def make_peer(
    place: Path, robot: str, *, items: Mapping[int, Item] | None = None, rank: int = 0, state: int = layout.NOT
) -> MappedFile:
    """The file of another robot's items, for the one process that receives them.

    Raises:
        OSError: it cannot be made, or is there already.
    """
    path = place / f"{PEER_PREFIX}{robot}"
    make_file(path, PEER, robot, items=items, rank=rank, state=state, mode=0o640)
    return MappedFile.open(path, writable=True)


def dismiss(path: Path) -> None:
    """Unlink a file of a board, or the schedule, and tell all who have it open that it is another one now."""
    retire(path)
    path.unlink(missing_ok=True)


def retire(path: Path) -> None:
    """As `dismiss`, and leave the file its name."""
    with contextlib.suppress(OSError), contextlib.closing(UnmappedFile.open(path)) as file:
        file.retire()


def enter(directory: Path, name: str, robot: str = "") -> tuple[MappedFile, int]:
    """Open a board's ``own`` as a user of it; make the board if there is none, or one that its last user left by being killed.

    Args:
        name: of this program, for people.
        robot: whose board it is, where it is made; "": this machine's.

    Returns:
        The file, and the user's index.

    Raises:
        BoardError: it is no board, cannot be made, or has too many users.
    """
    until_s = time.monotonic() + GONE_WAIT_S
    for _ in range(TURNS):
        try:
            entered = _try_to_enter(directory, name, robot or this_robot())
        except BoardGoneError as error:
            if time.monotonic() > until_s:
                raise BoardError(f"{error}, and not replaced yet; is its agent running?") from None
            time.sleep(GONE_LOOK_S)
            continue
        if entered is not None:
            return entered
    raise BoardError(f"cannot open the board {directory}: others have made and removed it {TURNS} times meanwhile; try again")


def _try_to_enter(directory: Path, name: str, robot: str) -> tuple[MappedFile, int] | None:
    path = directory / OWN_NAME
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return _made(directory, name, robot)
    except OSError as error:
        raise BoardError(f"cannot open {path}: {error.strerror}; its owner may, and the group of [board] in team.toml") from error
    keep = False
    try:
        with locks.table(descriptor, f"cannot open the board {directory}"):
            if not _is_still(path, descriptor):
                return None
            if _is_abandoned(path, descriptor):
                _remove(directory, descriptor)
                return None
            file = MappedFile.open(path, descriptor, writable=True)
            index = file.enter(os.getpid(), os.geteuid(), name)
            keep = True
            return file, index
    finally:
        if not keep:
            os.close(descriptor)


def _made(directory: Path, name: str, robot: str) -> tuple[MappedFile, int] | None:
    """Make the board; None if another one was quicker."""
    try:
        _make_directory(directory)
        _examine(directory)
        with contextlib.suppress(FileExistsError):
            make_file(directory / PRIVATE_NAME, PRIVATE + ALONE, robot)
        descriptor = make_file(directory / OWN_NAME, OWN + ALONE, robot, hold=True)
    except (FileExistsError, FileNotFoundError):
        return None
    except OSError as error:
        raise BoardError(f"cannot make the board {directory}: {error.strerror}; {VARIABLE} names another place") from error
    file = MappedFile.open(directory / OWN_NAME, descriptor, writable=True)
    index = file.enter(os.getpid(), os.geteuid(), name)  # its own lock does not stand in the way: 0
    locks.give(descriptor, TABLE_LOCK)
    return file, index


def _make_directory(directory: Path) -> None:
    try:
        directory.mkdir(mode=0o700)
    except FileExistsError:
        pass
    except FileNotFoundError:
        raise BoardError(f"cannot make the board {directory}: no directory can be made in {directory.parent}") from None


def _examine(directory: Path) -> None:
    """Refuse a directory below /dev/shm that another user has put there."""
    found = directory.lstat()
    if VARIABLE in os.environ or (found.st_uid in (0, os.geteuid()) and stat.S_ISDIR(found.st_mode)):
        return
    raise BoardError(
        f"cannot make the board {directory}: it belongs to uid {found.st_uid}; remove it, or name another place in {VARIABLE}"
    )


def leave(directory: Path, file: MappedFile, index: int) -> None:
    """Be no user any more; the last one without an agent removes the board."""
    path = directory / OWN_NAME
    try:
        with locks.table(file.descriptor, f"cannot close the board {directory}"):
            locks.give(file.descriptor, USER_LOCKS + index)
            if _is_still(path, file.descriptor) and _is_abandoned(path, file.descriptor):
                _remove(directory, file.descriptor)
    finally:
        file.close()


def _is_still(path: Path, descriptor: int) -> bool:
    """Whether an open file is the one of that name."""
    opened = os.fstat(descriptor)
    try:
        there = os.lstat(path)
    except FileNotFoundError:
        return False
    return (opened.st_dev, opened.st_ino) == (there.st_dev, there.st_ino)


def _is_abandoned(path: Path, descriptor: int) -> bool:
    """Whether a board is to be removed: made without an agent and without users, of an earlier boot, or gone already."""
    head = os.pread(descriptor, layout.RECORDS_AT, 0)
    if len(head) < layout.HEADER.size or head[:8] != layout.MAGIC:
        return False  # not ours: what it is will be said when it is mapped
    fields = layout.HEADER.unpack_from(head)
    flags, generation, boot_id = fields[2], fields[3], fields[7]
    if not flags & ALONE:
        return False
    if generation == GONE or boot_id != boottime.boot_id():
        return True
    return not any(locks.is_taken(descriptor, USER_LOCKS + index) for index in range(USERS_MAX))


def _remove(directory: Path, own: int) -> None:
    """Tell all who have the files open, and unlink them, ``own`` last; the table lock of ``own`` is held."""
    os.pwrite(own, layout.WORD.pack(GONE), layout.GENERATION_AT)
    for path in (
        directory / PRIVATE_NAME,
        directory / SCHEDULE_NAME,
        *directory.glob(f"{OWN_NAME}+*"),
        *directory.glob(f"{PEER_PREFIX}*"),
        *directory.glob(f"{GUEST_PREFIX}*"),
    ):
        dismiss(path)
    (directory / OWN_NAME).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        directory.rmdir()
