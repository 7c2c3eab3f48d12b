"""Functions by which a program keeps its state: `resume` gives it its state, `commit` makes a point to return to.

    state = failover.resume("mission", default=Mission())
    while state.leg < 10:
        state.leg += 1
        failover.commit()

A process keeps one state; the functions here are about that one. Commits go to a segment in shared memory
(`failover.kept_state.state`). A folder beside the program takes them from there (`failover.kept_state.file_store`). Only
`wait_committed` waits for a disk.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

from msgspec import Struct

from checkpoint.engines.cooperative.session import regions_of, this_machine
from checkpoint.errors import CheckpointError
from checkpoint.model import Snapshot
from failover.errors import NotCommittedError, TaskError
from failover.kept_state.adopt_arrays import adopt
from failover.kept_state.agent_link import Guarded, guarded
from failover.kept_state.file_store import Recorder, StateFile, folder_of
from failover.kept_state.period import Activations
from failover.kept_state.state import KeptState
from failover.state import Schema

S = TypeVar("S")

NAME_VARIABLE: Final = "FAILOVER_COMPONENT"
"""Names the component in place of the program; set by the agent or the person that starts it."""
FOLDER_VARIABLE: Final = "FAILOVER_STATE"
"""The folder in which states without an agent are kept; the working directory unless set."""

RESTARTED: Final = "restarted"
SWITCHED: Final = "switched"

_UNCHANGING: Final = (int, float, complex, str, bytes, bool, type(None), tuple, frozenset)


class Resumed(Struct, frozen=True):
    """Where the state came from that a program goes on with.

    Attributes:
        robot: name of the robot, or of the host, where it was committed.
        epoch: number of the primacy under which this program runs now: the fencing token. 0 without an agent.
        generation: of this run; every resume opens a new one. Under an agent: of the checkpoint that it goes on from.
        why: "restarted" on the same robot, from its agent's store or the folder beside the program; "taken over" from another
            that was lost; "handed over" by another, as an operator ordered: nothing was lost; "switched" from another version of
            a program (docs/programs.md).
        age_s: seconds since that commit.
        notes: what does not come back as it was: fields that were added or dropped, a damaged file that was passed over.
    """

    robot: str
    epoch: int
    generation: int
    why: str
    age_s: float
    notes: tuple[str, ...] = ()


class Task:
    """One state that is kept, from its beginning or its resuming to the end of the process.

    Attributes:
        name: of the component.
        epoch: under which it runs; 0 without an agent.
        value: the state that is committed.
        resumed: where it came from; None where it began here.
        activations: its steps, where it has any.
    """

    def __init__(self, name: str, state: KeptState, keeping: Recorder | Guarded, value: Any, resumed: Resumed | None) -> None:
        self.name = name
        self.epoch = keeping.handed.begin.epoch if isinstance(keeping, Guarded) else 0
        self.state = state
        self.value = value
        self.resumed = resumed
        self._keeping = keeping
        self._is_missing = False
        """The last commit found every bank held."""
        self.activations = Activations(0, 0)
        self._open_transaction: int | None = None
        """The thread that is in the middle of a change."""

    def commit(self) -> int:
        """Make the value, as it is now, the point to return to; answer the commit's number. Takes microseconds, without a wait.

        Raises:
            KeepError: something in it cannot be kept; names it. The last commit stands.
            TaskError: a transaction is open.
        """
        if self._open_transaction is not None:
            raise TaskError(f"cannot commit {self.name}: a transaction is open; it commits at its end")
        return self._commit()

    def _commit(self) -> int:
        self._is_missing = not self.state.commit(self.value)
        self._keeping.notice(self.state.segments)
        return self.state.number

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Commit at the end of the body, and never in the middle; not at all if it raises."""
        if self._open_transaction is not None:
            raise TaskError(f"cannot begin a transaction of {self.name}: one is open, and they do not nest")
        self._open_transaction = threading.get_ident()
        try:
            yield
        finally:
            self._open_transaction = None
        self._commit()

    @property
    def is_missing(self) -> bool:
        """Whether the last commit was not made, because readers held all its memory: commit again."""
        return self._is_missing

    def fileno(self) -> int:
        """Can be read when `safe` may have something new."""
        return self._keeping.fileno()

    def safe(self) -> int:
        """The number of the newest commit that is safe, without a wait; above all while no robot can stand by.

        Raises:
            NotCommittedError: no later one can become safe.
        """
        return self._keeping.hear()

    def wait_committed(self, timeout: float | None = None) -> None:
        """Return when the newest commit is safe.

        Raises:
            NotCommittedError: it is not, in time; says why.
        """
        if self._is_missing:
            raise NotCommittedError(f"the last commit of {self.name} was not made: readers held all its memory; commit again")
        self._keeping.wait(self.state.number, timeout)

    @property
    def trouble(self) -> str:
        """Why the last write to the disk failed; "" while all is well."""
        return self._keeping.trouble

    def close(self) -> None:
        """Write the newest commit and let the state go."""
        self._keeping.close()
        self.state.live.close()


def open_task(
    name: str,
    schema_of: Callable[[str], Schema],
    begin: Callable[[KeptState], Any],
    folder: Path | None = None,
) -> Task:
    """Begin a state, or resume it where there is one.

    Args:
        schema_of: the schema of the state of that name.
        begin: makes the first value.
        folder: where states are kept; from the environment unless named.

    Raises:
        StateTakenError: another process keeps it.
        FitError: it does not fit the declaration any more; names the field. It is still stored.
        TaskError: the folder cannot be used.
    """
    guard = guarded()
    name = guard.handed.begin.component if guard is not None else os.environ.get(NAME_VARIABLE) or name
    if not name.strip("/.") or "\0" in name:
        raise TaskError(f"cannot keep a state under the name {name!r}: choose a word, or a path such as /lab/robot1/mapper")
    schema = schema_of(name)
    state = KeptState(schema)

    def first() -> Any:
        value = begin(state)
        adopt(value, state.array)
        return value

    if guard is not None:
        return _open_guarded(name, state, guard, first)
    file = StateFile(folder_of(name, folder or Path(os.environ.get(FOLDER_VARIABLE) or Path.cwd())), name)
    try:
        snapshot = file.load()
        if snapshot is None:
            return _beside(name, state, file, first(), None)
        decoded = state.decode(_contents(snapshot, file))
    except BaseException:
        file.close()
        raise
    return _beside(name, state, file, decoded.value, _resumed(snapshot, file, decoded.notes))


def _beside(name: str, state: KeptState, file: StateFile, value: Any, resumed: Resumed | None) -> Task:
    """A task whose state is kept in a file beside the program."""
    _close_in_children(file)
    return Task(name, state, Recorder(state, file), value, resumed)


def _open_guarded(name: str, state: KeptState, guard: Guarded, begin: Callable[[], Any]) -> Task:
    """A task under an agent. Parts of its checkpoint that do not fit any more are still stored there."""
    state.outputs = guard.outputs
    kept, origin = guard.handed.state, guard.handed.begin.origin
    if kept is None or origin is None:
        return Task(name, state, guard, begin(), None)
    decoded = state.decode({region.name: bytes(kept.region(index)) for index, region in enumerate(kept.layout.regions)})
    epoch = guard.handed.begin.epoch
    resumed = Resumed(origin.robot, epoch, origin.generation, origin.why, origin.age_ns / 1e9, decoded.notes)
    task = Task(name, state, guard, decoded.value, resumed)
    task.commit()  # a standby gets it now, not at the end of the first step: until then no other robot may hold it
    return task


def _close_in_children(file: StateFile) -> None:
    """A forked child shares the lock on the folder: it would keep it after the death of its parent."""
    remembered = weakref.ref(file)

    def forked() -> None:
        known = remembered()
        if known is not None:
            known.close()

    os.register_at_fork(after_in_child=forked)


def _contents(snapshot: Snapshot, file: StateFile) -> dict[str, Any]:
    try:
        return {region.name: content for region, content in regions_of(snapshot)}
    except CheckpointError as error:
        raise TaskError(f"cannot resume from {file.folder}: {error}") from error


def _resumed(snapshot: Snapshot, file: StateFile, notes: tuple[str, ...]) -> Resumed:
    """By the clock that goes on over an outage: since the boot, if it is still the same one."""
    then, here = snapshot.clocks, this_machine("")
    if snapshot.machine.boot_id == here.boot_id:
        age_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - then.boottime_ns
    else:
        age_ns = time.time_ns() - then.realtime_ns
    return Resumed(
        robot=snapshot.machine.robot or snapshot.machine.hostname,
        epoch=snapshot.epoch,
        generation=file.generation,
        why=RESTARTED,
        age_s=max(age_ns, 0) / 1e9,
        notes=(*file.notices, *notes),
    )


# The state of this process


class _Process:
    """The one state that this process keeps: the functions below are about it."""

    def __init__(self) -> None:
        self.task: Task | None = None
        self._pid = 0
        """Of the process that keeps it: a forked child does not."""

    def keep(self, task: Task) -> None:
        self.task, self._pid = task, os.getpid()
        atexit.register(self.release)

    def release(self) -> None:
        """Write the newest commit, and let the task go."""
        if self.task is not None:
            task, self.task = self.task, None
            atexit.unregister(self.release)
            task.close()

    def the_task(self, tried: str) -> Task:
        if self.task is None:
            raise TaskError(f"cannot {tried}: this process keeps no state yet; begin with failover.resume(name, default=…)")
        return self.task

    def refuse_second(self, name: str) -> None:
        if self.task is not None and self._pid == os.getpid():
            raise TaskError(
                f"cannot keep {name}: this process keeps {self.task.name} already, and a commit covers one "
                "state; put both into one dataclass"
            )


PROCESS: Final = _Process()


def resume(
    name: str,
    *,
    default: S,
    version: int = 1,
    migrations: Mapping[int, Callable[[Any], Any]] | None = None,
    pickled: bool = False,
) -> S:
    """The state of this name as it was committed last, or ``default`` where there is none.

    Args:
        default: an object that can change: a dataclass, an attrs, msgspec or pydantic model, a dict, a list, an array.
        version: of the state's form; raise it when a migration is needed.
        migrations: by the version that they start from, see ``failover.state``.
        pickled: store what is no plain data by pickle. A person who can write the folder can then run code in this program.

    Raises:
        StateTakenError: another process keeps this state.
        SchemaError: the default cannot be kept; names the field.
        FitError: the stored state does not fit any more; names the field. It is still stored.
    """
    PROCESS.refuse_second(name)
    if isinstance(default, _UNCHANGING):
        kind = type(default).__name__
        raise TaskError(f"cannot keep {name}: a commit stores what the object holds then, and {kind} never changes; keep a dict")

    def schema_of(actual: str) -> Schema:
        return Schema.of(type(default), default, name=actual, version=version, migrations=migrations, pickled=pickled)

    task = open_task(name, schema_of, lambda _: default)
    PROCESS.keep(task)
    value: S = task.value
    return value


def commit() -> int:
    """Make the state, as it is now, the point to return to. Takes microseconds, without a wait.

    Returns:
        The number of the commit.

    Raises:
        KeepError: something in it cannot be kept; names it. The last commit stands.
    """
    return PROCESS.the_task("commit").commit()


@contextmanager
def transaction(state: S) -> Iterator[S]:
    """Change the state in the body; one commit at its end, none if it raises.

    Changes that the body has made in memory by then stay, for parts of the state may be known to the program by other names,
    and a rollback that reached some of them only would leave a state that never was. The code that catches the exception puts it
    right, or ends the program, which resumes from its last commit.
    """
    task = PROCESS.the_task("begin a transaction")
    if state is not task.value:
        raise TaskError(f"cannot begin a transaction: the object is not the state of {task.name} that resume() returned")
    with task.transaction():
        yield state


def wait_committed(timeout: float | None = None) -> None:
    """Return when the newest commit would survive a power cut.

    In an asyncio loop: ``await asyncio.to_thread(failover.wait_committed, 1.0)``.

    Args:
        timeout: seconds.

    Raises:
        NotCommittedError: it is not safe in time; says why.
    """
    PROCESS.the_task("wait for a commit").wait_committed(timeout)


def resumed() -> Resumed | None:
    """Where the state came from; None where it began in this run."""
    return PROCESS.the_task("tell where the state came from").resumed


def activations() -> Activations:
    """The steps of this process's component so far: how many, and how many beginnings were missed."""
    return PROCESS.the_task("count steps").activations
