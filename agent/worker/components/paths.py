"""Paths of the components of one robot: sockets, output, and where their guards come from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct, field

from agent.guard.output_logs import OutputLogs, logs_of, total_of
from agent.worker.components.process_pool import ProcessPool
from checkpoint.snapshot import format
from checkpoint.store.index import folder_name
from checkpoint.store.xor_cache_budget import PageBudget


class Places(Struct, frozen=True):
    """Where the components of this robot keep their things.

    Attributes:
        sockets: directory of the guards' sockets; gone after a reboot, as the guards are.
        logs: directory with one directory of output a component.
        process_pool: where guards and keepers come from.
        cgroup: a delegated cgroup v2 directory that each component gets a cgroup of its own in; "" for the guard's own.
        robot: this robot's name, for the snapshots.
        contents: directory of files that programs brought along; "": none are brought to this robot.
        budget: for the pages that keepers and the store remember.
    """

    sockets: Path
    logs: Path
    process_pool: ProcessPool
    cgroup: str = ""
    robot: str = ""
    contents: str = ""
    budget: PageBudget = field(default_factory=lambda: PageBudget(0))


def guard_sockets(places: Places) -> tuple[Path, ...]:
    """The sockets of all guards that may still live, for `Component.reconnect` after a restart."""
    return tuple(sorted(places.sockets.glob("*.guard")))


def log_directory(name: str, places: Places) -> Path:
    """Where a component's output is kept on this robot."""
    return places.logs / folder_name(name)


def complete_logs(directory: Path, chain: Sequence[int], *, is_safe: bool = False, owner: int | None = None) -> bool:
    """Bring output logs as far as the newest snapshot of a chain says; returns whether they were shorter.

    They are where a robot died, or was killed, between storing a snapshot and extending its logs.

    Args:
        chain: descriptors of encoded snapshots, oldest first.
        is_safe: another robot holds the newest of them, too.
        owner: user id of whose component it is, see `agent.guard.output_logs.logs_of`; None: not known here.
    """
    logs = OutputLogs(directory) if owner is None else logs_of(directory, owner)
    try:
        told = total_of(format.read_outline(chain[-1]).output)
        short = any(has < total for has, total in zip(logs.totals(), told, strict=True))
        if short:
            for descriptor in chain:
                logs.apply(format.read_outline(descriptor).output)
        if is_safe:
            logs.commit(told, is_safe=True)
        return short
    finally:
        logs.close()
