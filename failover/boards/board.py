"""The board of this robot, opened by a program: `failover.board()`."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from msgspec import Struct

from checkpoint.sentences import near
from failover.boards import boottime, directory
from failover.boards.agents_file import PRIMARIES, AgentsFile
from failover.boards.component_item import Primary, decode
from failover.boards.fence import FENCE
from failover.boards.item import Item, ItemWriter, Source, values_for
from failover.boards.mapping import USER_PREFIX, MappedFile, uid_of
from failover.boards.watch import Watch
from failover.core.board import ages, layout
from failover.core.board.announcements import DECLARATION_SIZE_MAX, told
from failover.core.board.banks import Place, Reading, get_carefully
from failover.core.board.items import Item as Declaration
from failover.core.board.layout import Record, wanted_of
from failover.core.board.owners import Owner, Owners
from failover.core.naming import worlds
from failover.errors import BoardError, BoardGoneError, ItemError, NeverWrittenError, OvertakenError, ValueMisfitError

COMPONENT_VARIABLE: Final = "FAILOVER_COMPONENT"


class RobotState(Struct, frozen=True):
    """One robot, as the board tells.

    Attributes:
        state: "run", "insert" and "remove" are robots that are heard, or were a moment ago; "not": it is not there.
        age_ns: since its newest frame came; None: none has. 0 for this robot.
        rank: its place among all members of the team, in the order of their names.
    """

    state: str
    age_ns: int | None
    rank: int


class _Opened:
    """The files of one board, and this program as a user of it."""

    def __init__(self, place: Path, name: str) -> None:
        self.directory = place.resolve() if place.exists() else place
        self.own, self.index = directory.enter(self.directory, name)
        self.robot = self.own.header.robot
        world = worlds.checked(os.environ.get(worlds.VARIABLE, ""))
        self._prefix = directory.GUEST_PREFIX + worlds.guest(world) if world else directory.PEER_PREFIX
        self.pid = os.getpid()
        self._others: dict[str, MappedFile] = {}
        self.peers: dict[str, MappedFile] = {}
        self._agents = AgentsFile(self.directory)
        if not self.own.header.flags & layout.ALONE:
            self.own.owners = self._agents.owners
        try:
            unowned = [] if self.owners() else [path.name for path in sorted(self.directory.glob(f"{USER_PREFIX}*"))]
            self._common = (directory.PRIVATE_NAME, *unowned)
            self._opened_of(self._common)
        except BaseException:
            self.leave()
            raise

    def _open(self, name: str) -> MappedFile:
        """One of the files beside `own`, mapped when it is first asked for, and again when the agent has made it anew."""
        file = self._others.get(name)
        if file is not None and file.is_gone:
            del self._others[name]
            file.close()
            file = None
        if file is None:
            file = self._others[name] = MappedFile.open(self.directory / name)
            file.owners = self.own.owners
        return file

    def _opened_of(self, names: Iterable[str]) -> list[MappedFile]:
        found = []
        for name in names:
            with contextlib.suppress(FileNotFoundError, BoardGoneError):
                try:
                    found.append(self._open(name))
                except BoardError:
                    if not name.startswith(USER_PREFIX):  # its user can spoil it: told when an item of it is used
                        raise
        return found

    @property
    def files(self) -> list[MappedFile]:
        """All that hold items of this robot, `own` first; without those of one user that cannot be opened."""
        return [self.own, *self._opened_of((*self._common, *[f"{USER_PREFIX}{uid}" for uid in self.uids()]))]

    def private(self) -> MappedFile | None:
        """The file of items that stay here."""
        return next(iter(self._opened_of((directory.PRIVATE_NAME,))), None)

    def owners(self) -> Owners:
        """Who alone may put which item.

        Raises:
            BoardError: the agent's table cannot be read.
        """
        return (self.own.owners() or {}) if self.own.owners is not None else {}

    def owner(self, name: str) -> Owner | None:
        """Who alone may put an item; None: who may write the board. Raises: see `owners`."""
        return self.owners().get(name)

    def uids(self) -> list[int]:
        """The users of this robot who have items of their own. Raises: see `owners`."""
        return sorted({owner.uid for owner in self.owners().values() if owner.uid is not None})

    def files_of(self, name: str) -> list[MappedFile]:
        """Where this robot's item of that name can be.

        Raises:
            BoardError: the file of the one user who may put it cannot be read.
        """
        owner = self.owner(name)
        if owner is None:
            return [self.own, *self._opened_of(self._common)]
        return [] if owner.uid is None else [self.of_user(owner.uid)]

    def of_user(self, uid: int) -> MappedFile:
        """The file that one user alone writes.

        Raises:
            BoardError: it cannot be read.
        """
        name = f"{USER_PREFIX}{uid}"
        try:
            return self._open(name)
        except FileNotFoundError:
            raise BoardError(f"{self.directory / name} is not there: the agent makes it when it starts") from None

    def peer(self, robot: str) -> MappedFile:
        """Another robot's file, or a guest's.

        Raises:
            BoardError: there is none; names those that there are.
        """
        file = self.peers.get(robot)
        if file is None or file.is_gone:
            file = self.peers[robot] = self._opened_peer(robot)
        return file

    def _opened_peer(self, robot: str) -> MappedFile:
        for prefix in (self._prefix, directory.GUEST_PREFIX) if "/" not in robot else ():
            with contextlib.suppress(FileNotFoundError):
                return MappedFile.open(self.directory / f"{prefix}{robot}", writable=False)
        known = ", ".join((self.robot, *self.peer_names(), *self.guest_names()))
        raise BoardError(f"there is no robot {robot!r} on the board {self.directory}; it has {known}")

    def agents(self) -> MappedFile:
        """The file in which the agent tells what it knows of the team.

        Raises:
            BoardError: there is none: no agent has made this board.
        """
        file = self._agents.opened()
        if file is None:
            raise BoardError(
                f"no agent has made the board {self.directory}: it alone knows which robot runs a component; "
                "read the item of a robot by its name"
            )
        return file

    def path_of(self, robot: str) -> Path:
        """Where another robot's file is."""
        return self.directory / f"{self._prefix}{robot}"

    def peer_names(self) -> list[str]:
        """The other robots: of the team, or of the simulated world in which this process lives."""
        return self._names(self._prefix)

    def guest_names(self) -> list[str]:
        """Simulated robots, as programs of the real world call them."""
        return self._names(directory.GUEST_PREFIX) if self._prefix == directory.PEER_PREFIX else []

    def _names(self, prefix: str) -> list[str]:
        return sorted(path.name.removeprefix(prefix) for path in self.directory.glob(f"{prefix}*"))

    def leave(self) -> None:
        """Give everything back; the last user without an agent removes the board. A forked child only closes its files."""
        self._close_others()
        if self.pid != os.getpid():
            self.own.close()
        elif self.own.descriptor >= 0:
            directory.leave(self.directory, self.own, self.index)

    def drop(self) -> None:
        """Close all without being the last user: the board is another one now, or this is a forked child."""
        self._close_others()
        self.own.close()

    def _close_others(self) -> None:
        for file in self._others.values():
            file.close()


class _Holder:
    """The files that are open now; survives its `Board` until that is collected, or the program ends."""

    opened: _Opened | None = None

    def leave(self) -> None:
        opened, self.opened = self.opened, None
        if opened is not None:
            opened.leave()


class Board:
    """The board of this robot: items to put and get, the other robots' items to get. A context manager, or call `close`.

    Attributes:
        guard: held while files are opened, mapped or examined; never while a program waits.
        skew_ns: by how much this process's CLOCK_BOOTTIME is ahead of the machine's.
    """

    def __init__(self, place: Path | None, name: str) -> None:
        self._place = place
        self._name = name
        self.guard: AbstractContextManager[Any] = threading.RLock()
        self.skew_ns = 0
        self._is_closed = False
        self._items: weakref.WeakSet[Item] = weakref.WeakSet()
        self._added: dict[str, Declaration] = {}
        self._writers: dict[str, ItemWriter] = {}
        self._sources: dict[str, Source] = {}
        self._primaries: tuple[MappedFile, Place, int, Mapping[str, Primary]] | None = None
        self._holder = _Holder()
        self._finalizer = weakref.finalize(self, self._holder.leave)
        self.ensured()
        _BOARDS.add(self)

    def __enter__(self) -> Board:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Use the board no more. The last user of one without an agent removes it."""
        with self.guard:
            self._is_closed = True
            self._forget()
            self._finalizer()

    # --- Items ---

    def item(self, name: str, type: Any = None) -> Item:
        """A handle of an item.

        Args:
            type: of the values put and got: ``bytes``, "msgpack", "json", a dataclass, a `msgspec.Struct`, a numpy dtype;
                None: dictionaries and numbers, as the item is declared.

        Raises:
            BoardError: it is not declared; names the nearest.
            ItemError: it is declared as another type; says both.
        """
        with self.guard:
            self.ensured()
            values_for(self._declared(name), type)
            item = Item(self, name, type)
            self._items.add(item)
            return item

    def names(self) -> list[str]:
        """The items of this robot, without those of a user who has damaged his file: the next use of one says so."""
        with self.guard:
            return [record.name for file in self.ensured().files for record in _records(file)]

    def add(self, declaration: Declaration) -> Item:
        """Declare an item while the board is in use; one that is declared alike already stays.

        The handle takes and gives values of the class that the declaration has as its type; as `item` where it has none. When
        the board is made anew, or this program resumes on another robot, its items are added there again.

        Raises:
            BoardError: it is declared otherwise already, or there is no room.
        """
        with self.guard:
            opened = self.ensured()
            self._check_user(opened, declaration)
            if opened.owner(declaration.name) is not None:
                return self.item(declaration.name, declaration.shape)
            file = opened.own if declaration.is_shared_by(opened.robot) else self._private(opened)
            if not file.is_writable:
                raise BoardError(f"cannot add item {declaration.name!r}: {file.path} may only be read by uid {os.geteuid()}")
            with file.changing():
                wanted = wanted_of(declaration, file.next_id(), layout.ADDED)
                size = len(told(wanted))
                if file is opened.own and size > DECLARATION_SIZE_MAX:
                    raise BoardError(
                        f"cannot add item {declaration.name!r}: to tell its type to other robots takes {size} bytes, over the "
                        f"limit of {DECLARATION_SIZE_MAX}; declare it in team.toml, split it, or say shared=False"
                    )
                there = self._where(opened, declaration.name)
                if there is None:
                    file.add(wanted)
                elif there[0] is not file or not is_alike(there[1], wanted):
                    raise BoardError(
                        f"cannot add item {declaration.name!r}: it is declared already as {there[1].text} in {there[0].path}, "
                        f"period {there[1].period}, banks {there[1].banks}; remove it first, or take it as it is"
                    )
            self._added[declaration.name] = declaration
            return self.item(declaration.name, declaration.shape)

    def _check_user(self, opened: _Opened, declaration: Declaration) -> None:
        """Refuse to add an item for one user which is another one's, or which only the team file can give to one user."""
        name, user, owner = declaration.name, declaration.user, opened.owner(declaration.name)
        if owner is not None:
            found = self._where(opened, name) or self._elsewhere(opened, name)
            if user not in ("", owner.user) or (found is not None and not is_alike(found[1], wanted_of(declaration, 0))):
                raise BoardError(
                    f"cannot add item {name!r}: team.toml declares it otherwise, for user {owner.user!r} alone; take it so"
                )
        elif user and not (opened.own.header.flags & layout.ALONE and is_this_user(user)):
            raise BoardError(
                f"cannot add item {name!r} for user {user!r} alone: an item of one user is declared in team.toml, and without "
                f"an agent the board is that of its user, here uid {os.geteuid()}; declare it there, or leave user out"
            )

    def remove(self, name: str) -> None:
        """Take an item off the board; its name is free then.

        Raises:
            BoardError: it is not declared, or may not be removed by this user.
        """
        with self.guard:
            file, record = self.found(name, self.ensured().robot)
            if not file.is_writable:
                raise BoardError(f"cannot remove item {name!r}: {self.read_only(file, record)}")
            self._added.pop(name, None)
            with file.changing():
                file.remove(record)

    def watch(self, *items: Item | tuple[Item, str]) -> Watch:
        """Wait for any of several items: a handle alone means this robot's, ``(handle, "robot2")`` another robot's.

        Raises:
            BoardError: there are none, or more than 128.
        """
        return Watch(tuple(one if isinstance(one, tuple) else (one, None) for one in items))

    # --- The whole ---

    @property
    def robot(self) -> str:
        """The name of this robot."""
        return self.ensured().robot

    @property
    def directory(self) -> Path:
        """Where the files are."""
        return self.ensured().directory

    def robots(self) -> dict[str, RobotState]:
        """Each robot of the board, this one first."""
        with self.guard:
            opened = self.ensured()
            found = {opened.robot: RobotState(layout.STATES[layout.RUN], 0, opened.own.header.rank)}
            return found | self._states(opened, opened.peer_names())

    def guests(self) -> dict[str, RobotState]:
        """Simulated robots beside the real ones; none for a program that lives in their world: there `robots` has them."""
        with self.guard:
            opened = self.ensured()
            return self._states(opened, opened.guest_names())

    def _states(self, opened: _Opened, robots: list[str]) -> dict[str, RobotState]:
        found = {}
        now = boottime.now_ns(self.skew_ns)
        for robot in robots:
            with contextlib.suppress(BoardGoneError):
                header = opened.peer(robot).read_header()
                age = now - header.heard_ns if header.heard_ns else None
                found[robot] = RobotState(layout.STATES[header.state], age, header.rank)
        return found

    def living(self) -> list[str]:
        """This robot, and those that are running."""
        return [robot for robot, state in self.robots().items() if state.state == layout.STATES[layout.RUN]]

    def primary(self, component: str) -> Primary:
        """Which robot runs a component, as this robot's agent sees it.

        Raises:
            BoardError: it knows none of that name, and names the nearest; or no agent has made this board.
        """
        with self.guard:
            file = self.ensured().agents()
            place = (
                file.place(_primaries_of(file))
                if self._primaries is None or self._primaries[0] is not file
                else self._primaries[1]
            )
            number = place.words[place.newest]
            if self._primaries is None or self._primaries[0] is not file or self._primaries[2] != number:
                table = decode(get_carefully(place, FENCE).value) if number else {}
                self._primaries = (file, place, number, table)
            table = self._primaries[3]
        if component not in table:
            cure = near(component, list(table)) or "; failover status shows the components of the team"
            raise BoardError(f"the agent of {self.robot} knows no robot that runs {component!r}{cure}")
        return table[component]

    def snapshot(self) -> dict[str, dict[str, Reading]]:
        """Robot → item → reading, of all that was ever put, without guests; each value whole, all ages at one instant.

        A value that its one user has damaged is left out: to get the item says why.
        """
        with self.guard:
            opened = self.ensured()
            owners = opened.owners()
            found = [(opened.robot, one) for file in opened.files for one in _all_found(file, owners)]
            for robot in opened.peer_names():
                with contextlib.suppress(BoardGoneError):
                    found += [(robot, one) for one in _all_found(opened.peer(robot), owners)]
            now = boottime.now_ns(self.skew_ns)
        readings: dict[str, dict[str, Reading]] = {robot: {} for robot in (opened.robot, *opened.peer_names())}
        for robot, (record, bank, formula_ns) in found:
            age_ns = now - bank.stamp_ns
            age_max_ns = ages.age_max_ns(age_ns, bank.error_us)
            stale = ages.is_stale(age_max_ns, record.bound_ns or formula_ns)
            try:
                value = values_for(record, None).unpack(bank.value)
            except (ValueMisfitError, ItemError, BoardError) as error:
                if record.name in owners:
                    continue
                if isinstance(error, ValueMisfitError):
                    raise ValueMisfitError(f"item {record.name!r} of {robot}: {error}") from None
                raise
            readings[robot][record.name] = Reading(value, age_ns, age_max_ns, robot, bank.number, stale)
        return readings

    def users(self) -> list[tuple[int, int, str]]:
        """Pid as it sees itself, uid and name of each program that has the board open."""
        with self.guard:
            opened = self.ensured()
            return opened.own.users(opened.index)

    # --- For items ---

    def writer(self, name: str) -> ItemWriter:
        """All puts of an item by this process."""
        with self.guard:
            return self._writers.setdefault(name, ItemWriter(self, name))

    def own_source(self, name: str) -> Source:
        """Where this robot's item lies now; the same object for as long as it lies there."""
        source = self._sources.get(name)
        if source is None or not self.is_good(source):
            file, record = self.found(name, self.ensured().robot)
            source = Source(file, record, values_for(record, None))
            source.generation = file.generation
            self._sources[name] = source
        return source

    def is_good(self, source: Source) -> bool:
        """Whether an item still lies where it did; opens the board anew if it was made anew. The guard is held."""
        file = source.file
        generation = file.generation
        if generation == source.generation:
            return True
        if file.is_gone:
            self.ensured()
            return False
        if not file.holds(source.record):
            return False
        if generation % 2:
            file.mend()
        source.remember(generation if generation % 2 == 0 else source.generation)
        return True

    def found(self, name: str, robot: str) -> tuple[MappedFile, Record]:
        """The file and the record of a robot's item; the guard is held.

        Raises:
            BoardError: it is not declared there.
        """
        opened = self.ensured()
        if robot == opened.robot:
            there = self._where(opened, name)
        else:
            file = opened.peer(robot)
            record = file.record(name)
            there = None if record is None else (file, record)
        if there is None:
            raise BoardError(self._unknown(name, robot))
        return there

    def has(self, name: str, robot: str) -> bool:
        """Whether a robot has an item."""
        with self.guard, contextlib.suppress(BoardError):
            return bool(self.found(name, robot))
        return False

    def read_only(self, file: MappedFile, record: Record) -> str:
        """Why this program may not put an item."""
        owner = self.ensured().owner(record.name)
        if owner is None:
            return f"{file.path} may only be read by uid {os.geteuid()}"
        return f"user {owner.user!r} (uid {owner.uid}) alone may put it, and this program runs as uid {os.geteuid()}"

    def whose(self, file: MappedFile, record: Record) -> str:
        """Why an item cannot be put: another process does."""
        pid = file.word32(record.at + layout.PID_FIELD)
        name = next((f" ({name})" for user, _, name in self.users() if user == pid and name), "")
        same = " in another opening of the board" if pid == os.getpid() else ""
        return f"item {record.name!r} is written by pid {pid}{name}{same}; one process writes an item: end that one first"

    def ensured(self) -> _Opened:
        """The open board; opened anew if it was made anew, or this is a forked child.

        Raises:
            BoardError: it is closed, or cannot be opened.
        """
        with self.guard:
            if self._is_closed:
                raise BoardError("the board is closed; open it again with failover.board()")
            opened = self._holder.opened
            if opened is None or opened.own.is_gone or opened.pid != os.getpid():
                if opened is not None:
                    opened.drop()
                    self._holder.opened = None
                self._forget()
                self.skew_ns = boottime.skew_ns()
                opened = self._holder.opened = _Opened(self._place or directory.find(), self._name)
                for declaration in list(self._added.values()):
                    with contextlib.suppress(BoardError):  # the next use of the item says why
                        self.add(declaration)
            return opened

    def _forget(self) -> None:
        for item in list(self._items):
            item.forget()
        for writer in self._writers.values():
            writer.forget()
        self._sources = {}

    def forget_after_fork(self) -> None:
        """In the child: the locks are the parent's, and so is the place among the users."""
        self.guard = threading.RLock()  # a thread that held it is not here
        opened = self._holder.opened
        self._forget()
        if opened is not None:
            opened.drop()

    # --- Records ---

    def _where(self, opened: _Opened, name: str) -> tuple[MappedFile, Record] | None:
        found = ((file, file.record(name)) for file in opened.files_of(name))
        return next(((file, record) for file, record in found if record is not None), None)

    def _declared(self, name: str) -> Record:
        """An item's record here, or at any other robot."""
        opened = self.ensured()
        there = self._where(opened, name) or self._elsewhere(opened, name)
        if there is None:
            raise BoardError(self._unknown(name, opened.robot))
        return there[1]

    def _elsewhere(self, opened: _Opened, name: str) -> tuple[MappedFile, Record] | None:
        for robot in (*opened.peer_names(), *opened.guest_names()):
            file = opened.peer(robot)
            record = file.record(name)
            if record is not None:
                return file, record
        return None

    def _unknown(self, name: str, robot: str) -> str:
        owner = self.ensured().owner(name)
        if owner is not None and robot == self.ensured().robot:
            why = f"failover status says why, or its robots in team.toml leave {robot} out"
            return f"item {name!r} is for user {owner.user!r} alone; no program of {robot} can put it: {why}"
        cure = near(name, self.names()) or "; declare it in team.toml, or with board.add()"
        return f"{robot} has no item {name!r} on the board {self.ensured().directory}{cure}"

    def _private(self, opened: _Opened) -> MappedFile:
        file = opened.private()
        if file is not None:
            return file
        raise BoardError(f"the board {opened.directory} has no file for private items")


def _primaries_of(file: MappedFile) -> Record:
    record = file.record(PRIMARIES)
    if record is None:
        raise BoardError(f"damaged: {file.path} has no table of primaries")
    return record


def is_this_user(user: str) -> bool:
    """Whether this process runs as that user."""
    from failover.config.accounts import account_of  # here: few programs need it

    try:
        return account_of(user).pw_uid == os.geteuid()
    except (KeyError, ValueError):
        return False


def is_alike(record: Record, wanted: layout.Wanted) -> bool:
    """Whether a table has an item as it is wanted: all but its number and how it came."""
    names = ("kind", "size", "banks", "period", "phase", "digest", "bound_ns")
    return all(getattr(record, name) == getattr(wanted, name) for name in names)


def _records(file: MappedFile) -> list[Record]:
    """All items of a file; none of one that its one user has damaged."""
    try:
        return file.records()
    except BoardError:
        if uid_of(file.path) is None:
            raise
        return []


def _all_found(file: MappedFile, owners: Owners) -> Iterator[tuple[Record, Any, int]]:
    """Record, bank and bound by the formula, of all items of a file that were ever put; of one user's only what is whole."""
    for record in _records(file):
        place = file.place(record)
        try:
            yield record, get_carefully(place, FENCE), place.words[place.formula]
        except NeverWrittenError:
            continue
        except (OvertakenError, BoardError) as error:
            if record.name in owners:
                continue
            raise type(error)(f"item {record.name!r} of {file.header.robot}: {error}") from None


_BOARDS: weakref.WeakSet[Board] = weakref.WeakSet()


def _after_fork() -> None:
    for board in list(_BOARDS):
        board.forget_after_fork()


os.register_at_fork(after_in_child=_after_fork)


def board(place: str | os.PathLike[str] | None = None, name: str = "") -> Board:
    """Open the board of this robot.

    Args:
        place: its directory; None: ``$FAILOVER_BOARD``, the agent's, or one that this user's programs share without an agent.
            In a simulated world (``$FAILOVER_WORLD``) the other robots are the simulated ones.
        name: of this program, for a person who looks which programs use the board; "": its component's, or its file's.

    Raises:
        BoardError: it cannot be opened or made; says why, and what to do.
    """
    said = name or os.environ.get(COMPONENT_VARIABLE) or os.path.basename(sys.argv[0] if sys.argv else "") or "python"
    return Board(None if place is None else Path(place), said)
