"""Ways in which a component begins on this robot: started, taken in, restored from a checkpoint, or found again.

component = await launch.start("/lab/robot1/mapper", program, places)           # it runs, and is not protected yet
component = await launch.restore(name, chain_descriptors, places, options)      # stopped, whole, uncommitted: `resume` it
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from agent.errors import GuardError, GuardLostError, KeeperLostError
from agent.guard import messages
from agent.guard.output_logs import total_of
from agent.system.adopted_process import Guest
from agent.system.clock import Laps, now_ns
from agent.system.permissions import ROOT
from agent.worker.components.component import Component, Prepared
from agent.worker.components.paths import Places, complete_logs, log_directory
from agent.worker.components.process_pool import KeeperLink, connect
from agent.worker.components.restore_limits import bound_of, check_rights
from checkpoint.engine import COOPERATIVE, COPY_CLOCKS_AHEAD_NS, NO_TERMS, PTRACE, Terms, pid_taken
from checkpoint.engines.cooperative.session import age_ns as commit_age_ns
from checkpoint.errors import ChainError, CheckpointError, MismatchError
from checkpoint.keeper import messages as keeper_messages
from checkpoint.keeper.messages import Laid
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.model import Snapshot
from checkpoint.program import epoch_variable
from checkpoint.segment.task_messages import Origin
from checkpoint.sentences import copy_outdated
from checkpoint.snapshot import format
from checkpoint.snapshot.carried_files import paths_of
from checkpoint.snapshot.credentials import Owner
from checkpoint.snapshot.required_files import names_of_contents, needs


class Program(Struct, frozen=True):
    """The program to start, as execve(2) wants it.

    Attributes:
        brought: its files that were brought here, for where its own are missing: (path, content, mode).
    """

    argv: tuple[bytes, ...]
    environment: tuple[bytes, ...]
    working_directory: bytes
    umask: int = 0o022
    isolate: bool = True
    inheritance: Inheritance | None = None
    engine: str = PTRACE
    holds_output: bool = False
    brought: tuple[tuple[str, str, int], ...] = ()


class RestoreOptions(Struct, frozen=True):
    """How a component comes back on this robot.

    Attributes:
        outage_ns: added to the program's monotonic and boot time: how long ago the newest snapshot was taken.
        owner: uid; None: the one it ran as. A program that is not root's opens its files with its owner's rights alone.
        started: its inheritance when it was started; None: not known.
        task: for a program that may still say that it keeps its state.
        epoch: the fencing token.
        terms: this robot's.
        stood_still: nothing of it has run since the newest snapshot.
    """

    outage_ns: int = 0
    owner: int | None = None
    started: Inheritance | None = None
    task: messages.Task | None = None
    epoch: int = 0
    terms: Terms = NO_TERMS
    stood_still: bool = False

    def owner_of(self, outline: Snapshot) -> int:
        """Whose the component is, also where nothing but its snapshot tells."""
        return outline.process.credentials.uids[0] if self.owner is None else self.owner

    @property
    def engine(self) -> str:
        """The engine that the component's program wants."""
        return self.task.engine if self.task is not None else PTRACE


async def start(name: str, program: Program, places: Places, epoch: int = 0, owner: int | None = None) -> Component:
    """Start a guard and under it the program. It runs, and is not protected yet.

    Args:
        owner: user id of whose component it is; None: of the agent's own user.

    Raises:
        GuardError: it could not be started; nothing is left of it.
    """
    component = Component(name, await places.process_pool.guard(), places)
    try:
        component.begin_output(os.geteuid() if owner is None else owner)
    except OSError as error:
        component.close()
        raise GuardError(f"{name}: cannot begin its output anew in {error.filename}: {error.strerror}") from error
    component.engine_wanted = program.engine
    task = messages.Task(epoch, engine=program.engine) if program.engine != PTRACE else None
    component.logs.hold(program.holds_output)
    return await _born(component, _starting(name, under_epoch(program, epoch), places, task))


def under_epoch(program: Program, epoch: int) -> Program:
    """The program with the fencing token in its environment; 0 while it waits for one."""
    others = tuple(one for one in program.environment if not one.startswith(epoch_variable.VARIABLE.encode() + b"="))
    return replace(program, environment=(*others, epoch_variable.assignment(epoch)))


def _starting(
    name: str, program: Program, places: Places, task: messages.Task | None, totals: tuple[int, int] = (0, 0)
) -> messages.Start:
    return messages.Start(
        component=name,
        argv=program.argv,
        environment=program.environment,
        working_directory=program.working_directory,
        umask=program.umask,
        isolate=program.isolate,
        log_directory=str(log_directory(name, places)),
        cgroup=places.cgroup,
        inheritance=program.inheritance,
        task=task,
        totals=totals,
        brought=program.brought,
    )


async def watch(name: str, guest: Guest, places: Places) -> Component:
    """Take a running process in: its guard is not its parent and does not own its streams.

    Args:
        guest: becomes the component's, also where this fails.

    Raises:
        GuardError: it has ended.
    """
    try:
        component = Component(name, await places.process_pool.guard(), places)
    except (GuardError, OSError):
        guest.close()
        raise
    component.guest = guest
    component.pid = component.inner_pid = guest.pid
    return await _born(component, messages.Watch(name, guest.pid), (guest.fileno(),))


async def restore(
    name: str,
    chain: Sequence[int],
    places: Places,
    options: RestoreOptions,
    laps: Laps | None = None,
) -> Component:
    """Rebuild a component from a chain (descriptors of encoded snapshots, oldest first), stopped, committed to nothing.

    Where a step fails, or agent or keeper ends before `resume`, nothing of it is left.

    Args:
        laps: told how long each stage took.

    Raises:
        checkpoint.errors.MismatchError, RestoreError, ChainError, FormatError; GuardError, KeeperLostError.
    """
    laps = laps or Laps()
    outline = await asyncio.to_thread(format.read_outline, chain[-1])
    owner = options.owner_of(outline)
    check_rights(name, outline, owner, options.started)
    await asyncio.to_thread(complete_logs, log_directory(name, places), chain, owner=owner)
    laps.lap("reading the newest")
    component = Component(name, await places.process_pool.guard(), places)
    request = _vessel_for(name, outline, places, options.outage_ns, total_of(outline.output), options.task)
    _prepare(component, outline, places, options)
    try:
        keeper = await component.keeper.give()
        laps.lap("guard and keeper")
        await _vessel(component, request, keeper)
        laps.lap("vessel")
        order = _order(component, places, options, owner, streams=True)
        restored, _ = await component.keeper.ask(order, (*chain, *component.streams))
        laps.lap("restore")
    except (CheckpointError, GuardError, KeeperLostError):
        await component.undo()
        raise
    component.notes = (*component.notes, *restored.notes)
    return component


def _prepare(component: Component, outline: Snapshot, places: Places, options: RestoreOptions) -> None:
    """Tell the component on which terms its keeper follows it from now on."""
    component.engine_wanted = options.engine
    component.keeper.terms = terms_of(outline, options.terms, bound_of(options.owner_of(outline), options.started))
    component.keeper.names = names_of_contents(needs(outline), places.contents)


def _order(
    component: Component, places: Places, options: RestoreOptions, owner: int, *, streams: bool
) -> keeper_messages.Restore:
    return keeper_messages.Restore(
        component.pid,
        component.name,
        options.outage_ns,
        streams=streams,
        robot=places.robot,
        own_eyes=owner != ROOT,
        epoch=options.epoch,
        contents=places.contents,
        terms=component.keeper.terms,
        stood_still=options.stood_still,
    )


def _vessel_for(
    name: str,
    outline: Snapshot,
    places: Places,
    elapsed_ns: int,
    totals: tuple[int, int] | None,
    task: messages.Task | None = None,
    counted_ns: int = 0,
) -> messages.MakeVessel:
    theirs = outline.process.credentials
    return messages.MakeVessel(
        component=name,
        inner_pid=outline.process.pid,
        isolate=outline.process.isolated,
        clocks=outline.clocks,
        elapsed_ns=elapsed_ns,
        totals=totals,
        log_directory=str(log_directory(name, places)),
        cgroup=places.cgroup,
        user=(theirs.uids[1], theirs.gids[1]),
        task=task,
        counted_ns=counted_ns,
    )


async def lay(
    name: str, chain: Sequence[int], places: Places, *, age_ns: int, owner: int, started: Inheritance | None, terms: Terms
) -> tuple[Component, Laid]:
    """Make a ready copy of a component from a chain: a vessel with its mappings and memory, which ends with this agent.

    Args:
        age_ns: of the newest snapshot.
        started: its inheritance when it was started; None: not known.
        terms: this robot's.

    Raises:
        checkpoint.errors.UnsupportedError: it can have none, with the reasons.
        MismatchError, RestoreError, ChainError, FormatError; GuardError, KeeperLostError: nothing of it is left.
    """
    counted_ns = now_ns()
    outline = await asyncio.to_thread(format.read_outline, chain[-1])
    check_rights(name, outline, owner, started)
    component = Component(name, await places.process_pool.guard(), places)
    component.keeper.terms = terms_of(outline, terms, bound_of(owner, started))
    request = _vessel_for(name, outline, places, age_ns + COPY_CLOCKS_AHEAD_NS, None, counted_ns=counted_ns)
    try:
        keeper = await component.keeper.give()
        await _vessel(component, request, keeper)
        if component.inner_pid != outline.process.pid:  # before all of it is read
            raise pid_taken(outline.process.pid)
        order = keeper_messages.Lay(component.pid, name, age_ns, owner != ROOT, places.contents, component.keeper.terms)
        laid, _ = await component.keeper.ask(order, tuple(chain))
    except (CheckpointError, GuardError, KeeperLostError):
        await component.undo()
        raise
    return component, laid


def stale(name: str) -> ChainError:
    """A ready copy does not lead to the chain that the store holds now: a base has come."""
    return ChainError(copy_outdated("a new chain has begun", name))


async def finish(component: Component, outline: Snapshot, places: Places, options: RestoreOptions) -> None:
    """Make the program of its ready copy, stopped, committed to nothing.

    Args:
        outline: of the snapshot that it stands at.

    Raises:
        checkpoint.errors.MismatchError, RestoreError; GuardError, KeeperLostError: nothing of it is left.
    """
    owner = options.owner_of(outline)
    try:
        check_rights(component.name, outline, owner, options.started)
        _prepare(component, outline, places, options)
        order = _order(component, places, options, owner, streams=False)
        restored, _ = await component.keeper.ask(keeper_messages.Finish(order, outline.position))
    except (CheckpointError, GuardError, KeeperLostError):
        await component.undo()
        raise
    component.commit = messages.Commit(total_of(outline.output), options.task)
    component.notes = (*component.notes, *restored.notes)


def terms_of(outline: Snapshot, here: Terms, owner: Owner | None) -> Terms:
    """The terms on which a component that comes back is followed on this robot: its snapshot says which files it carries.

    Args:
        owner: whose rights bound it, see `agent.worker.components.restore_limits.bound_of`.
    """
    places = dict(here.carry.places)
    paths = tuple(places.get(path, path) for path in paths_of(outline))
    return replace(here, carry=replace(here.carry, paths=paths), owner=owner)


async def begin_again(
    name: str,
    program: Program,
    chain: Sequence[int],
    places: Places,
    options: RestoreOptions,
    why: str,
    waiting: Component | None = None,
) -> Component:
    """Prepare a program that keeps its state to go on from a chain of the cooperative engine; `resume` lets it.

    Where a step fails, or agent or keeper ends before `resume`, nothing of it is left.

    Args:
        options: with its owner.
        why: one of `checkpoint.segment.task_messages.REASONS`.
        waiting: the program, started to wait (`start_to_wait`); None: `resume` starts it.

    Raises:
        checkpoint.errors.MismatchError, RestoreError, ChainError, FormatError; GuardError, KeeperLostError.
    """
    outline = await asyncio.to_thread(format.read_outline, chain[-1])
    owner = options.owner
    assert owner is not None, "a robot that knows a program's command knows whose it is"
    _check_owner(name, program, owner)
    try:
        check_rights(name, outline, owner, program.inheritance)  # its carried files are laid down with them
    except CheckpointError:
        if waiting is not None:
            await waiting.undo()
        raise
    try:
        await asyncio.to_thread(complete_logs, log_directory(name, places), chain, owner=owner)
    except (CheckpointError, OSError):
        if waiting is not None:
            await waiting.undo()
        raise
    component = waiting or Component(name, await places.process_pool.guard(), places)
    component.engine_wanted = COOPERATIVE  # a snapshot by another engine before it says Hello would be older than its state
    component.keeper.terms = terms_of(outline, options.terms, bound_of(owner, program.inheritance))
    try:
        await component.keeper.give()
        filled, (segment,) = await component.keeper.ask(
            keeper_messages.Fill(name, owner != ROOT, options.terms.carry.places), tuple(chain)
        )
    except (CheckpointError, GuardError, KeeperLostError):
        await component.undo()
        raise
    component.notes = (*component.notes, *filled.notes)
    age_ns = options.outage_ns + commit_age_ns(outline)
    origin = Origin(outline.machine.robot, filled.position.generation, why, age_ns)
    totals = total_of(outline.output)
    if waiting is not None:
        component.prepared = Prepared(messages.BeginTask(options.epoch, origin, totals), segment, age_ns)
    else:
        task = messages.Task(options.epoch, origin)
        start = _starting(name, under_epoch(program, options.epoch), places, task, totals)
        component.prepared = Prepared(start, segment, age_ns)
    return component


async def start_to_wait(name: str, program: Program, places: Places, owner: int) -> Component:
    """Start a program that keeps its state in advance: it waits for `begin_again`, and ends with this agent until then.

    Raises:
        checkpoint.errors.MismatchError: it would run as another user than its owner.
        GuardError: it could not be started; nothing is left of it.
    """
    _check_owner(name, program, owner)
    component = Component(name, await places.process_pool.guard(), places)
    component.engine_wanted = COOPERATIVE
    return await _born(component, _starting(name, under_epoch(program, 0), places, messages.Task(warm=True)))


def _check_owner(name: str, program: Program, owner: int) -> None:
    """Raises MismatchError: a program of this owner's would run as another user."""
    inherited = program.inheritance.uid if program.inheritance is not None else os.geteuid()
    if owner not in (ROOT, inherited):
        reason = f"it is to run as uid {inherited}, which is not its owner, uid {owner}; start it as that user"
        raise MismatchError(f"cannot restore {name}: {reason}", (reason,))


async def reconnect(socket_path: Path, places: Places) -> Component:
    """Find a component again after the agent was restarted.

    Raises:
        GuardLostError: no guard listens there any more, and the left-over socket has been removed; or it cannot be asked now, and
            the socket stays for the next agent.
    """
    try:
        guard = connect(socket_path)
    except (ConnectionRefusedError, FileNotFoundError) as error:
        with contextlib.suppress(FileNotFoundError):
            socket_path.unlink()
        raise GuardLostError(f"the guard of {socket_path.name} has gone: {error.strerror}") from error
    except OSError as error:
        raise GuardLostError(f"cannot reach the guard of {socket_path.name}: {error.strerror}; its socket stays") from error
    early: list[Any] = []  # events behind the answer, which come before the component is there to hear them

    def keep(message: Any) -> bool:
        if is_event := isinstance(message, messages.Event):
            early.append(message)
        return is_event

    guard.heard = keep
    described, streams = await guard.ask(messages.Describe())
    if described.state == "none":
        guard.close()
        raise GuardLostError(f"the guard of {socket_path.name} guards nothing; it ends")
    component = Component(described.component, guard, places)
    component.take(described, streams)
    if described.watched and described.state != "ended":
        with contextlib.suppress(ProcessLookupError):
            component.guest = Guest(described.pid)
    if described.state == "ended" and not component.ended.done():
        component.ended.set_result(described.exit_status)
    for event in early:
        guard.heard(event)
    return component


async def _vessel(component: Component, request: messages.MakeVessel, keeper: KeeperLink) -> None:
    """Have its guard make a vessel that ends with the keeper until it is committed to."""
    pidfd = keeper.pidfd()
    try:
        await _born(component, request, (pidfd,))
    finally:
        os.close(pidfd)


async def _born(component: Component, request: Any, descriptors: tuple[int, ...] = ()) -> Component:
    """Have its guard begin it; a guard that refuses is hung up on, and ends."""
    try:
        born, streams = await component.ask_guard(request, descriptors)
    except GuardError:
        component.close()
        raise
    if isinstance(born, messages.Watching):
        component.notes = born.notes
    else:
        component.take(born, streams)
    return component
