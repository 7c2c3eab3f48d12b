"""Make the standby copy of a component, of one process or of several."""

from __future__ import annotations

from checkpoint.engine import Copy, RestoreOptions
from checkpoint.engines.ptrace.restore.deferred_verify import held_or_stored
from checkpoint.engines.ptrace.standby_copy.eligibility import require_covered, require_room
from checkpoint.engines.ptrace.standby_copy.single import ReadyCopy, ended_on_error
from checkpoint.engines.ptrace.standby_copy.tree import FamilyCopy
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Snapshot
from checkpoint.store.base_on_disk import StoredBase


def lay(vessel_pid: int, base: Snapshot | StoredBase, options: RestoreOptions) -> Copy:
    """Map and fill everything of a base in a vessel, and leave it standing there.

    Raises:
        UnsupportedError: the program can have no ready copy, or this machine has no room for it.
        MismatchError: this machine lacks a file that is mapped.
        RestoreError: it did not work; the caller kills the vessel.
    """
    outline = base if isinstance(base, Snapshot) else base.outline
    require_covered(outline)
    require_room(outline)
    state, stored = held_or_stored(base)
    copy = _copy_of(vessel_pid, state, options, stored)
    with ended_on_error(copy, f"build a ready copy of {state.component} in pid {vessel_pid}"):
        copy.lay()
    return copy


def _copy_of(vessel_pid: int, state: Snapshot, options: RestoreOptions, stored: StoredBase | None) -> ReadyCopy | FamilyCopy:
    if state.is_tree:
        return FamilyCopy(vessel_pid, state, options)
    return ReadyCopy(Tracee(vessel_pid), state, options, source=stored)
