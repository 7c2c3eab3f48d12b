"""capture, restore, check: verbs that one command carries out alone, without an agent.

`inspect` is in `failover.cli.verbs.inspect_file`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from checkpoint.device_rules import DeviceRule, rule_from
from checkpoint.engine import GOES_ALONG, Terms
from checkpoint.errors import (
    CaptureError,
    ChainError,
    CheckpointError,
    FormatError,
    NothingCommittedError,
    ProbeError,
    ProcessGoneError,
    StoreError,
    UnsupportedError,
)
from checkpoint.keeper import messages
from checkpoint.keeper.messages import (
    Capture,
    Captured,
    Compare,
    Compared,
    Protect,
    Protected,
    Restore,
    Restored,
    Resume,
    Resumed,
)
from checkpoint.linux.file_author import Author, author_of
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.spawn import namespaces, vessel
from checkpoint.linux.spawn.inherited_limits import of_owner
from checkpoint.linux.spawn.vessel import Birth, Born
from checkpoint.snapshot import credentials, format
from checkpoint.snapshot.canonical_state import State
from checkpoint.snapshot.credentials import Owner
from checkpoint.store.whole_file import written_aside
from failover.cli.keeper_client import Keeper
from failover.cli.output import progress, render, team_tree
from failover.cli.systemd_note import notes_of_service
from failover.cli.verbs.components import exit_like
from failover.core.types import CARRY, DETACH, REFUSE, RESET
from failover.errors import FailoverError

CAPTURE_TRIES: Final = 12
REFUSED_TRIES: Final = 4
CAPTURE_PAUSE_S: Final = 0.25
"""How often, and how soon, a capture is made again that was begun in a bad moment: a machine without a processor to spare."""
END_TIMEOUT_S: Final = 10.0
"""How long a killed program may take to be dead; the kernel gives a large memory back first."""

IDS_TIMEOUT_S: Final = 2.0
IDS_PAUSE_S: Final = 0.01
"""How long the ids of a program that has just been ended may take to be free, and how often that is looked at."""
OWN_PIDS: Final = "it runs in a PID namespace of its own, with its old PIDs: here they are taken, or not this user's to choose"
LEFT_RUNNING: Final = (
    "cannot take along the TCP connections of pid {pid} and leave it running: only one of the two can have a connection, and the "
    "program keeps it; leave out --leave-running, or --connections carry"
)
SILENT: Final = "its peer hears nothing until the restore, for 15 minutes at most"

LARGE: Final = 64 << 20
"""Bytes of a snapshot from which on its restore may take a while. The modules that a keeper reads, too, are a tenth of that."""

ROOT: Final = 0

A = TypeVar("A")

# --- capture ---------------------------------------------------------------------------------------------------------


def capture(arguments: argparse.Namespace) -> int:
    """Write one snapshot of a process to a file, and end the process unless it is to run on."""
    target = Path(arguments.output)
    if arguments.leave_running and arguments.connections == CARRY:
        raise FailoverError(LEFT_RUNNING.format(pid=arguments.pid))
    if target.exists() and not arguments.force:
        raise FailoverError(f"cannot write {target}: it exists; give another name, or --force to replace it")
    with Keeper.spawn() as keeper:
        order = Protect(arguments.pid, f"/pid/{arguments.pid}", terms=terms_of(arguments), verb="capture")
        protected, _ = _at_last(arguments.pid, lambda: keeper.ask(order, Protected))
        held = not arguments.leave_running
        whole = Capture(base=True, generation=1, sequence=1, hold=held)
        with _written_whole(target) as file:
            captured = _captured(keeper, arguments.pid, whole, file, target)
            carried = _carried(arguments.pid, file) if arguments.connections == CARRY else ()
            notes = _contested(keeper, arguments, file)
        with _ended(arguments.pid) if held else contextlib.nullcontext():
            keeper.release()
    seen = [note for note in protected.notes + captured.notes if not (carried and note.endswith(GOES_ALONG))]
    return _tell_capture(arguments, captured, tuple(dict.fromkeys((*seen, *carried, *notes))))


def _carried(pid: int, file: int) -> tuple[str, ...]:
    """Which TCP connections a snapshot has taken along, as notes.

    Raises:
        FailoverError: one could not be taken along; the program is let go of, and is heard again.
    """
    from checkpoint.resources.sockets import tcp

    again = os.open(f"/proc/self/fd/{file}", os.O_RDONLY | os.O_CLOEXEC)
    try:
        state = format.read_state(again)
    finally:
        os.close(again)
    every = (*state.resources, *(one for member in state.members for one in member.resources))
    held = [one for one in every if one.kind == tcp.KIND]
    if left := [f"{tcp.named(one)} ({why})" for one in held if isinstance(why := one.facts.get(tcp.LEFT), str)]:
        what = f"cannot take along the TCP connection{'s' if len(left) > 1 else ''} {'; '.join(left)}"
        raise FailoverError(f"{what}. Pid {pid} runs on, with its connections. To capture it without them: --connections reset")
    return tuple(f"the TCP connection {tcp.named(one)} goes along; {SILENT}" for one in held if tcp.TAKEN in one.facts)


def _contested(keeper: Keeper, arguments: argparse.Namespace, file: int) -> tuple[str, ...]:
    """Which of its files others hold open for writing, as notes: as long as they do, a restore is refused."""
    again = os.open(f"/proc/self/fd/{file}", os.O_RDONLY | os.O_CLOEXEC)
    try:
        found, _ = keeper.ask(Compare(terms=terms_of(arguments), running=arguments.pid), Compared, (again,))
    except CheckpointError as untold:
        return (f"cannot see which other programs write to its files: {untold}",)
    finally:
        os.close(again)
    return tuple(f"a restore here would be refused now: {reason}" for reason in found.lacks)


def _captured(keeper: Keeper, pid: int, order: Capture, file: int, target: Path) -> Captured:
    """Have a snapshot written straight into a file: of a large program a copy more takes as long as all the rest."""

    def ask() -> Captured:
        os.ftruncate(file, 0)  # of a try before this one nothing may be left
        os.lseek(file, 0, os.SEEK_SET)
        return keeper.ask(order, Captured, (file,))[0]

    try:
        return _at_last(pid, ask)
    except StoreError as error:
        raise FailoverError(f"cannot write {target}: {error}; the program was not ended") from error


def _at_last(pid: int, ask: Callable[[], A]) -> A:
    """The answer of the keeper, asked again where the moment was bad: no agent is there to ask again.

    A refusal is asked again, too, until it was given `REFUSED_TRIES` times in the same words: a child that has not executed its
    program yet (vfork), or bytes on their way, are refused only for a moment.

    Raises:
        CheckpointError: the error of the last try, with the number of tries; or the first error that no later try would change.
    """
    began = time.monotonic()
    reasons: tuple[str, ...] = ()
    told = 0
    for left in reversed(range(CAPTURE_TRIES)):
        try:
            return ask()
        except (ProcessGoneError, NothingCommittedError):
            raise
        except UnsupportedError as error:
            reasons, told = error.reasons, told + 1 if error.reasons == reasons else 1
            if not left or told == REFUSED_TRIES:
                raise
        except CaptureError as error:
            if not left:
                raise CaptureError(_in_vain(pid, error, time.monotonic() - began)) from error
        time.sleep(CAPTURE_PAUSE_S)
    raise AssertionError("the last try answers or raises")


def _in_vain(pid: int, error: CaptureError, took_s: float) -> str:
    """Why no try succeeded, and the cure."""
    why = str(error).removesuffix("; capture it again")
    load, cores = os.getloadavg()[0], len(os.sched_getaffinity(0))
    tried = f"failover tried {CAPTURE_TRIES} times in {took_s:.0f} s; the machine has a load of {load:.0f} on {cores} cores"
    cure = f"kill -STOP {pid}, capture it, and kill -CONT it after the restore; or capture it when the machine has less to do"
    return f"cannot capture pid {pid}, which runs on: {why}. {tried}. To capture it: {cure}"


@contextmanager
def _ended(pid: int) -> Iterator[None]:
    """Kill a program that stands still, its children first, so that none runs on without it; after the body all are dead."""
    with contextlib.ExitStack() as held:
        dying: dict[int, int] = {}
        for one in (*reversed(descendants.component(pid)), pid):
            with contextlib.suppress(ProcessLookupError):
                end = os.pidfd_open(one)
                held.callback(os.close, end)
                signal.pidfd_send_signal(end, signal.SIGKILL)
                dying[end] = one
        yield
        _wait_for_ends(dying)


def _wait_for_ends(dying: Mapping[int, int]) -> None:
    """Wait, for a while, until these have ended, and their parents can be told: a restore at once finds files and PIDs free.

    The end of a traced process is told to its tracer first, and to its parent when that has taken note, or has ended itself.

    Args:
        dying: process ids by their pidfds.
    """
    deadline = time.monotonic() + END_TIMEOUT_S
    waiting, left = select.poll(), len(dying)
    for end in dying:
        waiting.register(end, select.POLLIN)
    while left and (left_s := deadline - time.monotonic()) > 0:
        for end, _ in waiting.poll(left_s * 1000):
            waiting.unregister(end)
            left -= 1
    for pid in dying.values():
        while _is_traced(pid) and time.monotonic() < deadline:
            time.sleep(0.001)


def _is_traced(pid: int) -> bool:
    try:
        return procfs.status(pid).tracer != 0
    except (ProbeError, ProcessGoneError):  # or one that we are not shown
        return False


def _tell_capture(arguments: argparse.Namespace, captured: Captured, notes: tuple[str, ...]) -> int:
    facts = {"pid": arguments.pid, "file": arguments.output, "size": captured.size, "freeze_us": captured.freeze_us}
    if arguments.json:
        render.as_json(facts | {"dirty_bytes": captured.dirty_bytes, "running": arguments.leave_running, "notes": notes})
        return 0
    fate = "runs on" if arguments.leave_running else "was ended"
    freeze = team_tree.microseconds(captured.freeze_us)
    print(f"{arguments.output}: {team_tree.size(captured.size)}; pid {arguments.pid} stood still for {freeze} and {fate}")
    _print_notes(notes)
    return 0


@contextmanager
def _written_whole(target: Path) -> Iterator[int]:
    """A descriptor of a file aside for the body to write; then the disk confirms it, and it gets its name.

    It is 0600, for memory is secret. Nothing is left of one that was not finished.
    """
    aside = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with written_aside(target, aside, lasts="name", is_exclusive=True) as descriptor:
            yield descriptor
    except OSError as error:
        raise FailoverError(f"cannot write {target}: {error.strerror}; the program was not ended") from error


def terms_of(arguments: argparse.Namespace) -> Terms:
    """The terms that the user ruled for this capture or restore.

    Raises:
        FailoverError: a rule is none.
    """
    shared = tuple(os.path.realpath(path) for path in arguments.shared)
    connections = arguments.connections
    return Terms(
        devices=device_rules(arguments),
        connections=connections not in (RESET, REFUSE),
        shared=shared,
        refuses_connections=connections == REFUSE,
        detaches_memory=getattr(arguments, "shared_memory", "") == DETACH,  # a snapshot says it for its restore
    )


def device_rules(arguments: argparse.Namespace) -> tuple[DeviceRule, ...]:
    """The rules for devices.

    Raises:
        FailoverError: a rule is none.
    """
    try:
        return tuple(rule_from(path, said) for path, said in arguments.devices)
    except ValueError as error:
        raise FailoverError(str(error)) from error


# --- restore ---------------------------------------------------------------------------------------------------------


def restore(arguments: argparse.Namespace) -> int:
    """Start the program of a snapshot where it stood; print its PID and return, or stay until it ends."""
    try:
        file = os.open(arguments.file, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe is refused, not waited for
    except OSError as error:
        raise FailoverError(f"cannot read {arguments.file}: {error.strerror}") from error
    try:
        return _restored(arguments, file, whose_rights(arguments, file))
    except (FormatError, ChainError) as error:
        raise FailoverError(f"cannot restore {arguments.file}: {error}") from error


def whose_rights(arguments: argparse.Namespace, file: int) -> Author | None:
    """The author of a snapshot, whose rights it gets at most; None: it gets the rights that it asks for, as far as we have them.

    Raises:
        AuthorError: that cannot be told.
    """
    if os.geteuid() != ROOT or arguments.trust:
        return None
    author = author_of(file, arguments.file)
    return author if author.owner is not None else None


def _restored(arguments: argparse.Namespace, file: int, author: Author | None) -> int:
    state = format.read_state(file)
    elapsed_ns, terms = vessel.elapsed_since(state.clocks), terms_of(arguments)
    birth = birth_of(state, elapsed_ns, own_session=not arguments.wait)
    owner = author.owner if author is not None else None
    reduced = _reduced(arguments.file, state, author) if author is not None else ()
    with (
        _told_of(reduced),
        contextlib.ExitStack() as opened,
        Keeper.spawn() as keeper,
        _born(_owned(birth, state, owner, opened)) as born,
    ):
        order = Restore(
            born.pid,
            state.component,
            elapsed_ns,
            terms=terms,
            stood_still=terms.connections,
            all_connections=arguments.connections == CARRY,
            follow=False,
            bound=owner,
            contents=os.path.abspath(arguments.contents) if arguments.contents else "",
        )
        with _told_how_far(arguments, keeper.pid, os.fstat(file).st_size):
            restored, _ = keeper.ask(order, Restored, (file,))
        resumed, _ = keeper.ask(Resume(), Resumed)
        if not arguments.wait:
            keeper.release()
    moved = (OWN_PIDS,) if born.isolated and not state.process.isolated else ()
    _tell_restore(arguments, restored.pid, reduced + born.notes + moved + restored.notes + resumed.notes)
    return _wait_for(born) if arguments.wait else 0


@contextmanager
def _told_how_far(arguments: argparse.Namespace, keeper: int, size: int) -> Iterator[None]:
    """Show how much of a large snapshot has been read."""
    if size < LARGE:
        yield
        return
    with (
        progress.Progress(is_quiet=arguments.json) as shown,
        progress.of_reading(keeper, f"restoring {arguments.file}", size, shown),
    ):
        yield


def _reduced(path: str, state: State, author: Author) -> tuple[str, ...]:
    """The rights that a snapshot asks for and does not get, as a note; none where it asks for no more than its owner has."""
    assert author.owner is not None
    if not (asked := credentials.excess(state, author.owner)):
        return ()
    cure = f"if {author.name} may run that as root: failover restore --trust {shlex.quote(path)}"
    return (f"{author.why}: the program has the rights of {author.name} and no more. It asks for {', '.join(asked)}; {cure}",)


@contextmanager
def _told_of(reduced: tuple[str, ...]) -> Iterator[None]:
    """Add to an error that the restore was tried with fewer rights than were asked for."""
    try:
        yield
    except CheckpointError as error:
        error.args = ("; ".join((str(error), *reduced)),)
        raise


def _owned(birth: Birth, state: State, owner: Owner | None, opened: contextlib.ExitStack) -> Birth:
    """The same for an owner other than root: with nothing of root's, also not root's terminal to read from."""
    if owner is None:
        return birth
    theirs = credentials.at_most(state.process.credentials, owner)
    stdio = _without_terminal(opened) if birth.own_session else birth.stdio
    return msgspec.structs.replace(birth, inheritance=of_owner(owner.uid, theirs.gids[0], theirs.groups), stdio=stdio)


def _without_terminal(opened: contextlib.ExitStack) -> tuple[int, int, int]:
    """Our standard streams for a program that must not read the typed text: a terminal is open for writing alone."""

    def unread(stream: int) -> int:
        if not os.isatty(stream):
            return stream
        descriptor = os.open(f"/proc/self/fd/{stream}", os.O_WRONLY | os.O_NOCTTY | os.O_CLOEXEC)
        opened.callback(os.close, descriptor)
        return descriptor

    return unread(0), unread(1), unread(2)


def birth_of(state: State, elapsed_ns: int, own_session: bool) -> Birth:
    """How the vessel for a snapshot must be born.

    On the boot that it was captured on, a program that lived in the machine's own PIDs and clocks finds them as they were.
    One that knows itself by several PIDs, which cannot be had here, gets PIDs of its own.
    """
    isolated = state.process.isolated
    here = Path("/proc/sys/kernel/random/boot_id").read_text().strip() == state.machine.boot_id
    clocks = None if here and not isolated else state.clocks
    return Birth(state.process.pid, isolated or _lacks_its_ids(state), clocks, elapsed_ns, own_session=own_session)


def _lacks_its_ids(state: State) -> bool:
    """Whether a program of several processes or threads finds one of its ids taken, or may not choose them at all.

    It waits a while for the ids of processes that have just ended: their parent, or init, has yet to take note of that.
    """
    threads = (*state.threads, *(thread for member in state.members for thread in member.threads))
    ids = {thread.tid for thread in threads} | {zombie.pid for zombie in state.zombies}
    if len(ids) == 1 or not namespaces.may_choose_pids():
        return len(ids) > 1
    deadline = time.monotonic() + IDS_TIMEOUT_S
    while any(map(_is_ending, ids)) and time.monotonic() < deadline:
        time.sleep(IDS_PAUSE_S)
    return any(Path(f"/proc/{number}").exists() for number in ids)


def _is_ending(pid: int) -> bool:
    """Whether a PID is of a process that has ended, and was not reaped."""
    with contextlib.suppress(ProbeError, ProcessGoneError):
        return procfs.status(pid).has_ended
    return False


@contextmanager
def _born(birth: Birth) -> Iterator[Born]:
    """A vessel for the body; if the body fails nothing of it is left."""
    born = vessel.spawn_vessel(birth)
    try:
        yield born
    except BaseException:
        vessel.discard(born)
        raise


def _tell_restore(arguments: argparse.Namespace, pid: int, notes: tuple[str, ...]) -> None:
    if arguments.json:
        render.as_json({"pid": pid, "file": arguments.file, "notes": notes})
        return
    print(pid, flush=True)
    _print_notes(notes)


def _wait_for(born: Born) -> int:
    """Stay until the program ends. Ctrl-C goes to the program, which shares our terminal, and is its business alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGQUIT, signal.SIG_IGN)
    _, status = os.waitpid(born.pid, 0)
    if born.init_pid:
        os.waitpid(born.init_pid, 0)
    return exit_like(status)


def _print_notes(notes: tuple[str, ...]) -> None:
    for note in notes:
        print(f"failover: note: {note}", file=sys.stderr)


# --- check -----------------------------------------------------------------------------------------------------------


def check(arguments: argparse.Namespace) -> int:
    """Say whether a process can be protected, or this machine protect, and what to change; or list all that can be kept."""
    if arguments.table:
        return _show_table(arguments)
    if arguments.pid is None:
        from failover.cli.verbs.check_machine import check_machine

        return check_machine(arguments)
    with Keeper.spawn() as keeper:
        report = keeper.ask(messages.Probe(arguments.pid), messages.Probed)[0].report
    notes = notes_of_service(arguments.pid)
    if arguments.json:
        render.as_json(msgspec.to_builtins(report) | {"supported": report.supported, "notes": notes})
        return 0 if report.supported else 1
    print(f"pid {report.pid}: {report.command}")
    print(f"{team_tree.size(report.resident_size)} in memory; written pages are found by {report.tracking}")
    render.table(("verdict", "what", "which", "why"), [(f.verdict, f.kind, f.name, f.text) for f in report.findings])
    count = len(report.reasons)
    cannot = f"it cannot be captured: {count} reason{'s' if count > 1 else ''}, see refused above"
    print("it can be captured" if report.supported else cannot)
    _print_notes(notes)
    return 0 if report.supported else 1


def _show_table(arguments: argparse.Namespace) -> int:
    """Show which things come back of any program, by which rule, and which are refused."""
    with Keeper.spawn() as keeper:
        rows = keeper.ask(messages.Tabulate(), messages.Tabulated)[0].rows
    if arguments.json:
        render.as_json([{"area": row.area, "kind": row.kind, "verdict": row.verdict, "sentence": row.sentence} for row in rows])
        return 0
    for area in dict.fromkeys(row.area for row in rows):
        lines = [(row.kind, row.verdict, row.sentence) for row in rows if row.area == area]
        render.table(("kind", "verdict", "how, or what to do instead"), lines, area[0].upper() + area[1:])
        print()
    return 0
