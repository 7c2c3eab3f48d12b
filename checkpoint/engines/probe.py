"""What a capture of a process would preserve, found without touching it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

from checkpoint import portable
from checkpoint.engine import KEPT, NO_TERMS, NOTED, REFUSED, Finding, Report, Streams, Terms
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux import dirty, processor, procfs, vm_flags
from checkpoint.linux.procfs import Status
from checkpoint.resources import Surroundings, glance, kinds, look, pipes_of, system_v_memory, unsupported

COMMAND_LENGTH: Final = 200
"""Characters of a command line that a report shows."""


def probe(pid: int, surroundings: Surroundings | None = None, *, files_kept: bool = False) -> Report:
    """Look at a process.

    Args:
        surroundings: of a process that lives under a guard, see `surroundings_of`.

    Raises:
        ProbeError: there is no such process, it is no program, somebody traces it, or we may not look.
    """
    try:
        return _probe(pid, surroundings or surroundings_of(pid, None), files_kept)
    except ProcessGoneError as error:
        raise ProbeError(f"cannot look at pid {pid}: there is no such process (any more)") from error


def _probe(pid: int, surroundings: Surroundings, files_kept: bool) -> Report:
    if not 0 < pid <= _largest_pid():
        raise ProbeError(f"cannot look at pid {pid}: that is not the number of a process")
    status = procfs.status(pid)
    unsupported.require_traceable(pid, status)
    _require_permission(pid, status)
    held = look(glance(pid), surroundings)
    findings = (
        *_process_findings(pid, status, files_kept),
        *_processor_findings(pid),
        *_memory_findings(pid),
        *held.findings,
        *kinds.findings_of_all(held.resources, standing=False),
    )
    return Report(pid, _command(pid, status), status.resident_size, dirty.best_tracking(), findings)


def surroundings_of(pid: int, streams: Streams | None, terms: Terms = NO_TERMS) -> Surroundings:
    """What the kinds of resources must know about a process, its guard and its operator's rules.

    Raises:
        ProbeError: that is no process.
    """
    if not 0 < pid <= _largest_pid():
        raise ProbeError(f"cannot look at pid {pid}: that is not the number of a process")
    return Surroundings(pipes_of(streams.outputs) if streams else {}, terms.devices)


def _largest_pid() -> int:
    with open("/proc/sys/kernel/pid_max") as file:
        return int(file.read())


def _require_permission(pid: int, status: Status) -> None:
    """Fail as seizing would, before anything is touched."""
    try:
        procfs.read_bytes(pid, "auxv")
        os.stat(f"/proc/{pid}/exe")
    except (ProbeError, PermissionError) as error:
        raise ProbeError(
            f"cannot look at pid {pid} ({status.name}) of uid {status.uids[0]}: not permitted; run as that user or as root"
        ) from error


def _process_findings(pid: int, status: Status, files_kept: bool) -> Iterator[Finding]:
    for reason in unsupported.refuse_process(pid, status, files_kept=files_kept):
        yield Finding("process", f"pid {pid}", REFUSED, reason)
    if status.ppid and len(status.pids) == 1:
        text = "its PID is kept where it is free on the other side: failover run gives a program a PID namespace of its own"
        yield Finding("process", f"pid {pid}", NOTED, text)


def _processor_findings(pid: int) -> Iterator[Finding]:
    """What another robot's processor must have."""
    level = portable.level_in(procfs.read_bytes(pid, "environ"))
    if level:
        yield Finding("process", "processor", KEPT, f"started for {level}: it can go on where that is")
        return
    needed = ", ".join(portable.lacking(processor.features(), ())) or "nothing special"
    yield Finding("process", "processor", KEPT, f"not started with failover run --portable: it may have chosen {needed}")


def _memory_findings(pid: int) -> Iterator[Finding]:
    flags = vm_flags.parse(procfs.read_text(pid, "smaps"))
    lines = procfs.parse_maps(procfs.read_text(pid, "maps"))
    for line in lines:
        reason = unsupported.refuse_mapping(line, flags.get(line.start, ()))
        if reason is not None:
            yield Finding("memory", f"VMA {line.start:x}-{line.end:x}", REFUSED, reason)
    for reason in system_v_memory.refuse(lines):
        yield Finding("memory", "System V shared memory", REFUSED, reason)
    for path, note in unsupported.note_mappings(line for line in lines if not system_v_memory.is_segment(line)):
        yield Finding("memory", path, NOTED, note)


def _command(pid: int, status: Status) -> str:
    words = procfs.read_text(pid, "cmdline").rstrip("\0").split("\0")
    command = " ".join(" ".join(words).split()) or f"[{status.name}]"
    return command if len(command) <= COMMAND_LENGTH else command[: COMMAND_LENGTH - 1] + "…"
