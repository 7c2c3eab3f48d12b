"""Turn a waiting vessel into the program of a base.

::

    checks           this machine has what the snapshot needs (`restore.checks`); nothing is touched before
    carried files    laid down at their paths (`checkpoint.resources.carried.restore`)
    processes        the vessel becomes the program: one process (`restore.process`) or several, its children (`restore.tree`)
    control groups   each process is put back where it was (`checkpoint.resources.process.control_groups`)
    connections      made again while they stay silent (`checkpoint.resources.sockets.tcp_handover`)

Until `Restored.resume` the program stands still and dies with its tracer (PTRACE_O_EXITKILL): an unfinished restore leaves
nothing.
"""

from __future__ import annotations

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.engines.ptrace.restore import checks
from checkpoint.engines.ptrace.restore.checks import Brought
from checkpoint.engines.ptrace.restore.deferred_verify import held_or_stored
from checkpoint.engines.ptrace.restore.process import ProcessRestore
from checkpoint.engines.ptrace.restore.tree import TreeRestore
from checkpoint.errors import ChainError, CheckpointError, FormatError, MismatchError, RestoreError
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Position, Snapshot
from checkpoint.resources.carried import file_numbers
from checkpoint.resources.carried import restore as carried_restore
from checkpoint.resources.process import control_groups
from checkpoint.resources.sockets import tcp_handover
from checkpoint.resources.sockets.tcp_handover import Arriving
from checkpoint.snapshot import carried_files, credentials
from checkpoint.store.base_on_disk import StoredBase


class RestoredProgram(Struct):
    """A restored program; see ``checkpoint.engine.Restored``.

    Attributes:
        threads: all of its first process; they stand still for us until `resume`.
        others: those of its other processes.
        arriving: its connections; their other ends hear nothing until then.
    """

    threads: Threads
    position: Position
    notes: tuple[str, ...]
    others: tuple[Threads, ...] = ()
    arriving: Arriving = field(default_factory=Arriving)

    @property
    def pid(self) -> int:
        """As this process sees it."""
        return self.threads.pid

    @property
    def connections(self) -> int:
        """See ``checkpoint.engine.Restored.connections``."""
        return self.arriving.established

    def put_back(self, state: Snapshot, options: RestoreOptions) -> None:
        """Have its processes where they were in control groups; what cannot be is noted."""
        pids = [self.pid, *(threads.pid for threads in self.others)]
        owner = options.terms.owner
        self.notes += control_groups.put_back(state, pids, owner.uid if owner is not None else None)

    def resume(self) -> None:
        """Let it go on, without us: all of its threads at once. Should we die halfway, it dies, too, or all of it goes on."""
        self.arriving.let_go()
        everybody = (*self.others, self.threads)
        try:
            for threads in everybody:
                for tracee in (*threads.others, threads.leader):
                    tracee.may_outlive_us()
        finally:
            for threads in everybody:
                threads.thaw()


def restore(vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> RestoredProgram:
    """See ``checkpoint.engine.Engine.restore``."""
    state, stored = held_or_stored(base)
    if options.bound is not None:
        state = credentials.bounded(state, options.bound)
    if not state.is_base:
        raise RestoreError("cannot restore a delta by itself: fold its chain first")
    if reasons := memory_limits.refuse_restore(state):
        raise MismatchError(f"cannot restore {state.component} here: {'; '.join(reasons)}", reasons)
    program = carried_files.without(state)
    if program is not state:
        options = replace(options, accept_changed=(*options.accept_changed, *carried_files.every_path(state)))
    brought = checks.require(program, options, vessel_pid)
    laid = carried_restore.lay_down_for(state, vessel_pid, own_eyes=options.own_eyes)
    program, _ = file_numbers.renewed(program, laid.identities)
    arriving, program = tcp_handover.arriving(program, wanted=options.stood_still, all_of_them=options.all_connections)
    try:
        restored = (
            _run_tree(vessel_pid, program, options, brought, arriving)
            if state.is_tree
            else _run_one(vessel_pid, program, options, brought[0], arriving, stored)
        )
        restored.arriving = arriving
        restored.notes += arriving.notes
        restored.notes += laid.notes
        restored.put_back(program, options)
        return restored
    except (RestoreError, FormatError, ChainError):
        raise
    except CheckpointError as error:
        raise RestoreError(f"cannot restore {state.component} into pid {vessel_pid}: {error}") from error


def _run_one(
    vessel_pid: int,
    state: Snapshot,
    options: RestoreOptions,
    brought: Brought,
    arriving: Arriving,
    stored: StoredBase | None,
) -> RestoredProgram:
    restoring = ProcessRestore(Tracee(vessel_pid), state, options, brought, source=stored)
    try:
        restoring.prepare()
        restoring.build()
        restoring.become_program()
        arriving.connect([vessel_pid])
    except BaseException:
        restoring.end()
        raise
    return RestoredProgram(restoring.held(), state.position, tuple(restoring.notes))


def _run_tree(
    vessel_pid: int, state: Snapshot, options: RestoreOptions, brought: tuple[Brought, ...], arriving: Arriving
) -> RestoredProgram:
    restoring = TreeRestore(vessel_pid, state, options, brought)
    try:
        restoring.run()
        arriving.connect(restoring.pids())
    except BaseException:
        restoring.end()
        raise
    first, *others = restoring.held()
    return RestoredProgram(first, state.position, restoring.notes(), tuple(others))
