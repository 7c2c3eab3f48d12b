"""Find out what a capture of a process would preserve, without touching the process."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.engine import KEPT, NO_TERMS, NOTED, REFUSED, Finding, Report, Streams, Terms
from checkpoint.engines.ptrace.facts import birth_order
from checkpoint.engines.ptrace.facts.persistent_reasons import lasting
from checkpoint.errors import CheckpointError, ProbeError, ProcessGoneError
from checkpoint.linux.memory import choose_tracker
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import descendants, procfs, vm_flags
from checkpoint.linux.procfs.live_thread import told_by_spokesman
from checkpoint.linux.procfs.procfs import MapsLine, Status
from checkpoint.linux.spawn import cpuid
from checkpoint.linux.trace.entry import leftovers
from checkpoint.program import cpu_baseline
from checkpoint.resources import refusals, registry, shared_descriptions
from checkpoint.resources.events import aio
from checkpoint.resources.ipc import boards, pseudo_terminals, shared_memory, standard_streams, system_v_memory
from checkpoint.resources.open_file import Held, Kin, Opened, OpenFile, Surroundings
from checkpoint.resources.process import refused_threads
from checkpoint.resources.survey import gather, glance, look, pipes_of

LOOKS: Final = 10
"""How often a component whose processes come and go is looked at until it stays the same meanwhile."""
LOOK_PAUSE_S: Final = 0.01
EXECUTION_S: Final = 2.0
EXECUTION_PAUSE_S: Final = 0.001
"""How long a program that is being executed is waited for, and between two looks at it."""
COMMAND_LENGTH: Final = 200
"""Characters of a command line that a report shows."""


def probe(pid: int, surroundings: Surroundings | None = None, *, files_kept: bool = False, verb: str = "check") -> Report:
    """Look at a process.

    Args:
        surroundings: of a process that lives under a guard, see `surroundings_of`.
        verb: what the user asked for, as a refusal says it.

    Raises:
        ProbeError: there is no such process, it is no program, another process traces it, or we may not look.
    """
    try:
        around = surroundings or surroundings_of(pid, None)
        refusals.require_traceable(pid, procfs.status(pid), verb)
        return told_by_spokesman(pid, functools.partial(_probe, pid, around, files_kept))
    except ProcessGoneError as error:
        raise ProbeError(f"cannot examine pid {pid}: there is no such process (any more)") from error


def _probe(pid: int, surroundings: Surroundings, files_kept: bool, first: int) -> Report:
    status = procfs.status(first)
    _require_permission(first, status)
    _await_execution(first)
    kin, opened = _all_opened(pid, first, is_guarded=bool(surroundings.pipes))
    surroundings, detached = _with_detached(kin, surroundings)
    looked = _looked(opened, first, surroundings)
    detaches = surroundings.detached is not None
    findings = (
        *(Finding("memory", "shared memory", NOTED, text) for text in shared_memory.detached(detached)),
        *_process_findings(first, status, kin, files_kept, detaches=detaches),
        *_root_findings(first),
        *_processor_findings(first),
        *_memory_findings(first, opened[first]),
        *_segments_findings(pid, first, is_guarded=bool(surroundings.pipes), detaches=detaches),
        *looked[first].findings,
        *registry.findings_of_all([held for one in looked.values() for held in one.resources], surroundings, standing=False),
        *standard_streams.findings(opened[first], surroundings),
        *_others_findings(opened, pid, first, looked, detaches=detaches),
    )
    return Report(pid, _command(first, status), status.resident_size, choose_tracker.best_tracking(), findings)


def reasons_of(pid: int, surroundings: Surroundings, *, files_kept: bool = False) -> tuple[str, ...]:
    """Why a component cannot be captured, as far as it can be told without stopping it.

    Raises:
        ProbeError, ProcessGoneError: it cannot be looked at.
    """
    return told_by_spokesman(pid, functools.partial(_reasons_of, pid, surroundings, files_kept))


def _reasons_of(pid: int, surroundings: Surroundings, files_kept: bool, first: int) -> tuple[str, ...]:
    _await_execution(first)
    kin, opened = _all_opened(pid, first, is_guarded=bool(surroundings.pipes))
    surroundings, _ = _with_detached(kin, surroundings)
    detaches = surroundings.detached is not None
    looked = _looked(opened, first, surroundings)
    of_others = _others_findings(opened, pid, first, looked, detaches=detaches)
    others = [found.text for found in of_others if found.verdict == REFUSED]
    of_first = refusals.refuse_process(first, procfs.status(first), kin, files_kept=files_kept, detaches_memory=detaches)
    return (*looked[first].reasons, *of_first, *others)


def _with_detached(kin: Iterable[int], surroundings: Surroundings) -> tuple[Surroundings, tuple[shared_memory.Mapped, ...]]:
    """Where the rules say so, the shared memory of these processes that becomes the program's own copy."""
    if surroundings.detached is None:
        return surroundings, ()
    lines: dict[int, tuple[MapsLine, ...]] = {}
    for pid in kin:
        with contextlib.suppress(ProcessGoneError):
            lines[pid] = procfs.parse_maps(procfs.read_text(pid, "maps"))
    found = shared_memory.of_all(lines)
    covered = shared_memory.covered(itertools.chain.from_iterable(lines.values()), [one.key for one in found])
    return replace(surroundings, detached=covered), found


def _all_opened(pid: int, first: int, *, is_guarded: bool) -> tuple[tuple[int, ...], shared_descriptions.OpenedByAll]:
    """The living processes of a component and their open files; looked up again where some came or went meanwhile.

    Args:
        first: the id by which we look at the process ``pid``; it stands for that.
    """
    stubborn: set[int] | None = None
    for _ in range(LOOKS):
        kin = _kin(pid, first, is_guarded=is_guarded)
        opened = _opened(kin)
        young = set(filter(_has_still_to_execute, kin[1:]))
        stubborn = young if stubborn is None else stubborn & young
        if kin == _kin(pid, first, is_guarded=is_guarded) and not young:
            break
        time.sleep(LOOK_PAUSE_S)
    about_to = young - (stubborn or set())  # a capture that stops them later finds their new programs
    return tuple(one for one in kin if one not in about_to), {one: held for one, held in opened.items() if one not in about_to}


def _has_still_to_execute(pid: int) -> bool:
    """Whether a process has its parent's memory, as between vfork(2) and execve(2)."""
    with contextlib.suppress(CheckpointError):
        return bool(list(refused_threads.refuse_shared_memory(pid, procfs.status(pid))))
    return False


def _opened(kin: tuple[int, ...]) -> shared_descriptions.OpenedByAll:
    """The open files of each of these; one that ends meanwhile is left out, but for the first."""
    if len(kin) == 1:
        return {kin[0]: Opened(glance(kin[0]))}
    known = Kin(terminals=pseudo_terminals.masters([held for pid in kin for held in _gathered(pid)]))
    found = {kin[0]: glance(kin[0], known)}
    for pid in kin[1:]:
        with contextlib.suppress(ProcessGoneError):
            found[pid] = glance(pid, known)
    return shared_descriptions.together(found)


def _gathered(pid: int) -> tuple[OpenFile, ...]:
    with contextlib.suppress(ProcessGoneError):
        return gather(pid)
    return ()


def _kin(pid: int, first: int, *, is_guarded: bool) -> tuple[int, ...]:
    """The processes of a component that live, the first one first."""
    found = [first]
    for other in descendants.others(pid, descendants.reaper_of(pid, is_guarded=is_guarded)):
        with contextlib.suppress(CheckpointError):
            if procfs.stat(other).state not in "ZX":
                found.append(other)
    return tuple(found)


def _looked(opened: shared_descriptions.OpenedByAll, first: int, surroundings: Surroundings) -> dict[int, Held]:
    """The open files of each process, sorted into the kinds."""
    around = replace(
        surroundings, pipes={**standard_streams.of_first(opened[first], surroundings), **surroundings.pipes}, is_first=False
    )
    return {pid: look(held, surroundings if pid == first else around) for pid, held in opened.items()}


def _others_findings(
    opened: shared_descriptions.OpenedByAll, process: int, first: int, looked: Mapping[int, Held], *, detaches: bool
) -> Iterator[Finding]:
    """Reasons against the processes besides the first; none against one that ends meanwhile."""
    if first != process and len(opened) > 1:
        yield Finding("process", "threads", REFUSED, refused_threads.OF_SEVERAL)
    for pid, held in looked.items():
        if pid != first:
            for reason in (*_named(pid, held.reasons), *lasting(functools.partial(_against, pid, opened, detaches))):
                yield Finding("process", f"pid {pid}", REFUSED, reason)
    for reason in lasting(functools.partial(_births_refused, process)):
        yield Finding("process", "births", REFUSED, reason)


def _against(pid: int, opened: shared_descriptions.OpenedByAll, detaches: bool) -> tuple[str, ...]:
    """Reasons against a process besides the first, without those of its open files."""
    try:
        reasons = list(refusals.refuse_process(pid, procfs.status(pid), tuple(opened), detaches_memory=detaches))
        mapped = _Mapped.by(pid)
    except (CheckpointError, FileNotFoundError, ProcessLookupError):
        return ()
    reasons += [why for _, why in mapped.refused()]
    reasons += aio.refuse(opened[pid]) if any(map(aio.is_ring, mapped.lines)) else ()
    return _named(pid, reasons)


def _named(pid: int, reasons: Iterable[str]) -> tuple[str, ...]:
    """Reasons with whose they are; none of a process that has ended."""
    with contextlib.suppress(CheckpointError):
        name = procfs.status(pid).name
        return tuple(f"its process {pid} ({name}): {reason}" for reason in reasons)
    return ()


def _births_refused(first: int) -> tuple[str, ...]:
    """Why its processes could not be born again."""
    with contextlib.suppress(CheckpointError):
        everybody = list(map(procfs.status, (first, *descendants.component(first))))
        ended = [(one, why) for one in everybody[1:] for why in refused_threads.refuse_ended_first(one)]
        if ended:
            return tuple(f"its process {one.pids[0]} ({one.name}): {why}" for one, why in ended)
        return tuple(birth_order.refuse_persons(everybody[0], birth_order.persons(everybody)[1:], descendants.taken_pids(first)))
    return ()


def surroundings_of(pid: int, streams: Streams | None, terms: Terms = NO_TERMS, *, may_repeat: bool = True) -> Surroundings:
    """The facts about a process, its guard and its operator's rules that the kinds of resources must know.

    Raises:
        ProbeError: that is no process.
    """
    if not 0 < pid < procfs.pid_max():
        raise ProbeError(f"cannot examine pid {pid}: that is not the number of a process")
    pipes = pipes_of(streams.outputs) if streams else {}
    detached: Mapping[tuple[int, int], int] | None = {} if terms.detaches_memory else None
    return Surroundings(pipes, terms.devices, terms.connections, detached=detached, terms=terms, may_repeat=may_repeat)


def _require_permission(pid: int, status: Status) -> None:
    """Fail as seizing would, before anything is touched."""
    try:
        procfs.read_bytes(pid, "auxv")
        os.stat(f"/proc/{pid}/exe")
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"pid {pid} ({status.name}) has ended, or becomes another program") from error
    except (ProbeError, PermissionError) as error:
        raise ProbeError(
            f"cannot examine pid {pid} ({status.name}) of uid {status.uids[0]}: not permitted; run as that user or as root"
        ) from error


def _await_execution(pid: int) -> None:
    """Wait until a process has the program that it executes. execve(2) lets the starter go on before that program has a vdso,
    arguments or variables; the kernel notes the variables last. A program whose file comes slowly is looked at as it is.

    Source: create_elf_tables() in fs/binfmt_elf.c; begin_new_exec() in fs/exec.c closes descriptors (close-on-exec) long before.
    """
    deadline = time.monotonic() + EXECUTION_S
    while not (stat := procfs.stat(pid)).env_end and stat.state not in "ZX" and time.monotonic() < deadline:
        time.sleep(EXECUTION_PAUSE_S)


def _process_findings(pid: int, status: Status, kin: tuple[int, ...], files_kept: bool, *, detaches: bool) -> Iterator[Finding]:
    for reason in refusals.refuse_process(pid, status, kin, files_kept=files_kept, detaches_memory=detaches):
        yield Finding("process", f"pid {pid}", REFUSED, reason)
    if status.ppid and len(status.pids) == 1:
        text = "its PID is kept where it is free on the other robot: failover run gives a program a PID namespace of its own"
        yield Finding("process", f"pid {pid}", NOTED, text)


def _root_findings(pid: int) -> Iterator[Finding]:
    """Rights that a restore of it needs."""
    if (root := procfs.read_link(pid, "root")) != "/":
        text = f"its root directory is {root}: to enter that again takes CAP_SYS_CHROOT (an agent of root, and a program of root)"
        yield Finding("process", "root", NOTED, text)


def _processor_findings(pid: int) -> Iterator[Finding]:
    """The features that another robot's processor must have."""
    level = cpu_baseline.level_in(procfs.read_bytes(pid, "environ"))
    if level:
        yield Finding("process", "processor", KEPT, f"started for {level}: it can resume on such processors")
        return
    needed = ", ".join(cpu_baseline.lacking(cpuid.features(), ())) or "nothing special"
    yield Finding("process", "processor", KEPT, f"not started with failover run --portable: it may have chosen {needed}")


class _Mapped(Struct, frozen=True):
    """The mappings of a process.

    Attributes:
        flags: VmFlags by start, without those that our own write protection sets.
        is_followed: failover protects it already.
    """

    lines: tuple[MapsLine, ...]
    flags: Mapping[int, tuple[str, ...]]
    is_followed: bool

    @classmethod
    def by(cls, pid: int) -> _Mapped:
        """Look.

        Raises:
            ProcessGoneError, ProbeError: it has ended, or we may not.
        """
        flags: Mapping[int, tuple[str, ...]] = vm_flags.parse(procfs.read_text(pid, "smaps"))
        lines = procfs.parse_maps(procfs.read_text(pid, "maps"))
        is_followed = False
        if any(not vm_flags.WATCHED.isdisjoint(told) for told in flags.values()):
            with contextlib.suppress(CheckpointError):  # it unmaps something just now
                is_followed = bool(leftovers(Memory(pid), lines))
        if is_followed:
            flags = {start: tuple(flag for flag in told if flag not in vm_flags.WATCHED) for start, told in flags.items()}
        return cls(lines, flags, is_followed)

    def refused(self) -> Iterator[tuple[MapsLine, str]]:
        """Mappings that cannot be made again, and why."""
        for line in self.lines:
            if why := refusals.refuse_mapping(line, self.flags.get(line.start, ())):
                yield line, why


def _memory_findings(pid: int, opened: Sequence[OpenFile]) -> Iterator[Finding]:
    mapped = _Mapped.by(pid)
    lines = mapped.lines
    if mapped.is_followed:
        yield Finding("memory", "written pages", NOTED, "failover follows them already: the program is protected")
    for line, reason in mapped.refused():
        yield Finding("memory", f"VMA {line.start:x}-{line.end:x}", REFUSED, reason)
    yield from boards.findings(pid, lines)
    if any(map(aio.is_ring, lines)):
        yield Finding("memory", "asynchronous I/O", NOTED, aio.NOTE)
        for reason in aio.refuse(opened):
            yield Finding("memory", "asynchronous I/O", REFUSED, reason)
    for path, note in refusals.note_mappings(line for line in lines if not system_v_memory.is_segment(line)):
        yield Finding("memory", path, NOTED, note)


def _segments_findings(pid: int, first: int, *, is_guarded: bool, detaches: bool) -> Iterator[Finding]:
    for reason in lasting(lambda: _segments_refused(_kin(pid, first, is_guarded=is_guarded), detaches=detaches)):
        yield Finding("memory", "System V shared memory", REFUSED, reason)


def _segments_refused(kin: Iterable[int], *, detaches: bool) -> tuple[str, ...]:
    """Why their System V shared memory cannot be kept; one may be born or end in between, so this may not last."""
    lines: list[MapsLine] = []
    for pid in kin:
        with contextlib.suppress(ProcessGoneError):
            lines += procfs.parse_maps(procfs.read_text(pid, "maps"))
    return tuple(system_v_memory.refuse(lines, system_v_memory.here(lines), detaches=detaches))


def _command(pid: int, status: Status) -> str:
    words = procfs.read_text(pid, "cmdline").rstrip("\0").split("\0")
    command = " ".join(" ".join(words).split()) or f"[{status.name}]"
    return command if len(command) <= COMMAND_LENGTH else command[: COMMAND_LENGTH - 1] + "…"
