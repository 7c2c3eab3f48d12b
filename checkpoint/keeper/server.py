"""The keeper, the tracer's own process: one alone is ``python -m checkpoint keeper FD``; an agent's `fork_server` forks its own.

A last word names a module whose function ``gate`` tells when a program may stand still (`WaitingGate`); it is loaded when a
capture is to ask it.

One thread serves one channel; `checkpoint.keeper.messages` defines the requests and answers. The keeper follows at most one
process. When its peer has gone, it releases that process, which runs on, and ends. A restore that was not resumed by then ends
with it.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pkgutil
import resource
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

import checkpoint
from checkpoint import engine
from checkpoint.engine import (
    LASTING_NOTES,
    RESET_NOTE,
    CaptureOrder,
    Copy,
    Engine,
    ProtectOrder,
    Restored,
    RestoreOptions,
    Session,
    Streams,
)
from checkpoint.engines import registry
from checkpoint.errors import CaptureError, CheckpointError, FormatError, ProcessGoneError, RestoreError, StoreError, let_go
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Channel, ChannelClosedError, ChannelError, Reply, Request
from checkpoint.linux.signal_wakeup import waking
from checkpoint.linux.spawn import namespaces
from checkpoint.model import Position, Snapshot
from checkpoint.resources.sockets import tcp
from checkpoint.runtime import allocator, parallel, slim_imports
from checkpoint.snapshot import carried_files, format, untrusted
from checkpoint.snapshot.credentials import Owner
from checkpoint.snapshot.required_files import names_of_contents, needs
from checkpoint.store import chain
from checkpoint.store.base_in_process import UnreadBase
from checkpoint.store.base_on_disk import stored_base
from checkpoint.store.digest_cache import DigestsOfFiles
from checkpoint.store.disk import Disk, DiskFile, with_cure
from checkpoint.store.xor_cache import Sender

if TYPE_CHECKING:
    from checkpoint.engines.cooperative.engine import GuardedTask

USAGE: Final = f"usage: python -m {checkpoint.__name__} keeper FD [MODULE]\n"

FILES: Final = 65536
"""Descriptors that it may have, as its unit says."""

COLLECTED_AFTER: Final = 128
"""Requests after which we collect objects that refer to each other, and give free memory back: 4 ms, every few seconds."""

STREAM_DESCRIPTORS: Final = 5
"""Counters, two outputs, two logs: what a message brings along for streams."""

Descriptors = tuple[int, ...]
Answer = tuple[Reply, Descriptors]


class _Encoded(msgspec.Struct, frozen=True):
    """A capture as bytes.

    Attributes:
        snapshot: its pages are not used any more.
        size: bytes of the file; ``dirty_bytes``: of the pages in it; ``known_bytes``: of those told as differences.
        descriptors: a memory file with it, where it is not in the file that the request brought.
    """

    snapshot: Snapshot
    size: int
    dirty_bytes: int
    known_bytes: int = 0
    descriptors: Descriptors = ()


class WaitingGate(engine.Gate, Protocol):
    """A gate that a program's captures ask one after the other."""

    def begin(self, lag_ns: int) -> None:
        """A capture begins, which may wait for so long."""
        ...

    @property
    def outcome(self) -> messages.Slack | None:
        """How it went; None: the program runs no tasks."""
        ...


class Keeper:
    """Obeys one peer, one request at a time.

    Args:
        gates: name of the module that tells when a program may stand still; "": it may at any time.
    """

    def __init__(self, link: Channel[Request], tracer: Engine, gates: str = "") -> None:
        self._gates = gates
        self._gate: WaitingGate | None = None
        self._link = link
        self._tracer = tracer
        self._session: Session | None = None
        self._restored: Restored | None = None
        self._copy: Copy | None = None
        self._lasting: tuple[str, ...] = ()
        self._connections = 0
        self._revived: tuple[messages.Restore, Streams | None] | None = None
        self._sender = Sender()
        self._robot = ""
        self._names: dict[str, str] | None = None
        self._verbs: dict[type[msgspec.Struct], Callable[..., Answer | None]] = {
            messages.Probe: self._probe,
            messages.Tabulate: self._tabulate,
            messages.Protect: self._protect,
            messages.Capture: self._capture,
            messages.Acknowledge: self._acknowledge,
            messages.Restore: self._restore,
            messages.Lay: self._lay,
            messages.Advance: self._advance,
            messages.Finish: self._finish,
            messages.Fill: self._fill,
            messages.Compare: self._compare,
            messages.OpenFile: self._open_file,
            messages.Resume: self._resume,
            messages.Release: self._release,
        }

    def serve(self) -> None:
        """Answer until the peer hangs up; then let go."""
        try:
            with waking() as await_readable:  # a program that is held and killed meanwhile waits for us
                while True:
                    for _ in range(COLLECTED_AFTER):
                        await_readable(self._link.fileno())
                        self._serve_one()
                    gc.collect()
                    allocator.give_back()
        except ChannelClosedError:
            pass
        finally:
            self._let_go()

    def _serve_one(self) -> None:
        request, descriptors = self._link.receive()
        try:
            answer = self._verbs[type(request)](request, descriptors)
        except CheckpointError as error:
            answer = messages.failed(error), ()
            let_go(error)
        if answer is None:
            return
        reply, carried = answer
        try:
            self._link.send(reply, carried)
        finally:
            messages.close_all(carried)

    def _probe(self, request: messages.Probe, _: Descriptors) -> Answer:
        return messages.Probed(self._tracer.probe(request.pid)), ()

    def _tabulate(self, _: messages.Tabulate, __: Descriptors) -> Answer:
        from checkpoint.engines import capability_table

        return messages.Tabulated(capability_table.rows()), ()

    def _protect(self, request: messages.Protect, descriptors: Descriptors) -> Answer:
        if self._is_busy:
            messages.close_all(descriptors)
            raise CaptureError(f"cannot {request.verb} pid {request.pid}: this keeper follows another one already; start another")
        self._robot = request.robot
        streams = streams_of(descriptors) if request.streams else None
        chosen = self._tracer if request.engine == self._tracer.name else registry.engine_named(request.engine)
        names = request.names if request.robot else None
        self._session = chosen.protect(request.pid, ProtectOrder(request.component, streams, request.terms, names, request.verb))
        return messages.Protected(self._session.notes), ()

    def _capture(self, request: messages.Capture, descriptors: Descriptors) -> Answer:
        try:
            return self._captured(request, descriptors[0] if descriptors else None)
        finally:
            messages.close_all(descriptors)

    def _captured(self, request: messages.Capture, target: int | None) -> Answer:
        began_ns, session = time.process_time_ns(), self._following("capture")
        self._sender.limit(request.xor_cache)
        if unchanged := _unchanged(session, request):
            return unchanged, ()
        gate = self._asked_gate(request)
        order = CaptureOrder(
            *(request.base, request.generation, request.sequence, request.epoch, self._robot, request.hold), gate=gate
        )
        made = self._made(session, order, target, request)
        snapshot = made.snapshot
        commit, age_ns = _commit_at(session, snapshot.position)
        answer = messages.Captured(
            position=snapshot.position,
            parent=snapshot.parent,
            size=made.size,
            freeze_us=snapshot.freeze_us,
            dirty_bytes=made.dirty_bytes,
            notes=(*self._lasting_notes(snapshot), *snapshot.notes),
            totals=session.totals,
            commit=commit,
            age_ns=age_ns,
            known_bytes=made.known_bytes,
            frozen_bytes=session.frozen_size,
            remembered_bytes=self._sender.held,
            wanted_bytes=self._sender.wanted,
            slack=gate.outcome if gate is not None else None,
            cpu_us=(time.process_time_ns() - began_ns) // 1_000,
        )
        return answer, made.descriptors

    def _asked_gate(self, request: messages.Capture) -> WaitingGate | None:
        """The gate of the followed program, which learns from all its captures; None: this one does not wait."""
        if not self._gates or not request.lag_ns:
            return None
        if self._gate is None:
            made: WaitingGate = importlib.import_module(self._gates).gate()
            self._gate = made
        self._gate.begin(request.lag_ns)
        return self._gate

    def _lasting_notes(self, snapshot: Snapshot) -> tuple[str, ...]:
        """Notes about losses of the restore that last. Lost connections count until the program has opened as many."""
        if any(note.startswith(RESET_NOTE) for note in self._lasting):
            count = tcp.established(held for told in snapshot.processes for held in told.resources)
            if count >= self._connections:
                self._lasting = tuple(note for note in self._lasting if not note.startswith(RESET_NOTE))
        return self._lasting

    def _made(self, session: Session, order: CaptureOrder, target: int | None, request: messages.Capture) -> _Encoded:
        """Capture, and encode what was captured: into the target, or into a memory file where there is none."""
        threads = parallel.thread_count() if request.hold else 1  # a program that runs needs the processors itself
        may_stay = target is not None and not request.spare
        captured = session.capture_standing(order) if may_stay else session.capture(order)
        if not isinstance(captured, Snapshot):
            assert target is not None, "it was to be read otherwise"
            try:
                snapshot, size = written_in(target, captured, threads)
                return _Encoded(snapshot, size, sum(run.size for run in snapshot.runs))
            except ProcessGoneError:
                raise
            except CaptureError:  # an unreadable page (a guard that this kernel does not tell): a copy leaves it out
                os.ftruncate(target, 0)
                os.lseek(target, 0, os.SEEK_SET)
                captured = session.capture(order)
        told, known_bytes = self._sender.told(captured, request.xor_cache)
        if target is not None and not request.spare:
            return _Encoded(captured, encoded_in(target, told, threads), len(captured.contents), known_bytes)
        if target is not None and len(captured.contents) >= messages.LARGE_SIZE:
            with _written(captured.component):
                size = format.encode(told, DiskFile(Disk(), target), threads=threads)
            return _Encoded(captured, size, len(captured.contents), known_bytes)
        descriptor, size = encoded_in_memory(told, threads)
        return _Encoded(captured, size, len(captured.contents), known_bytes, (descriptor,))

    def _acknowledge(self, request: messages.Acknowledge, _: Descriptors) -> None:
        if self._session is not None:
            self._session.acknowledge(request.position)
            self._sender.acknowledge(request.position)

    def _restore(self, request: messages.Restore, descriptors: Descriptors) -> Answer:
        files, ends = descriptors, None
        if request.streams:
            files, last = descriptors[:-STREAM_DESCRIPTORS], descriptors[-STREAM_DESCRIPTORS:]
            ends = streams_of(last)
        try:
            if self._is_busy:
                raise RestoreError(f"cannot restore into pid {request.pid}: this keeper follows a process already")
            if request.bound is not None:
                if self._gates:
                    importlib.import_module(self._gates)
                _become(request.bound)
            with untrusted.facts(f"restore {request.component}"):
                self._restored, names = self._restored_from(files, request)
        finally:
            messages.close_all(files)
        self._revived, self._names = (request, ends), names
        return messages.Restored(self._restored.pid, self._restored.position, self._restored.notes), ()

    def _restored_from(self, files: Descriptors, request: messages.Restore) -> tuple[Restored, dict[str, str] | None]:
        """Restore what a chain's files amount to; and what its program knows its files by, where a robot keeps them."""
        places = dict(request.terms.carry.places)
        if not files or _has_several_processes(files):
            state = carried_files.relocated(folded(files), places)
            names = _names_of(state, request)
            return self._tracer.restore(request.pid, state, _options(request)), names
        with stored_base(*files) as base:
            base.relocate(places)
            names = _names_of(base.outline, request)
            return self._tracer.restore(request.pid, base, _options(request)), names

    def _lay(self, request: messages.Lay, descriptors: Descriptors) -> Answer:
        try:
            if self._is_busy:
                raise RestoreError(f"cannot build a ready copy in pid {request.pid}: this keeper follows a process already")
            options = RestoreOptions(own_eyes=request.own_eyes, contents=request.contents, terms=request.terms)
            with untrusted.facts(f"build a ready copy of {request.component}"):
                is_whole = _has_several_processes(descriptors)  # a process that came or went within the chain is not followed
                if is_whole:
                    self._copy = self._tracer.lay(request.pid, folded(descriptors), options)
                else:
                    with stored_base(descriptors[0]) as base:
                        self._copy = self._tracer.lay(request.pid, base, options)
            return self._brought_on(self._copy, () if is_whole else descriptors[1:], request.elapsed_ns)
        finally:
            messages.close_all(descriptors)

    def _advance(self, request: messages.Advance, descriptors: Descriptors) -> Answer:
        try:
            if self._copy is None:
                raise RestoreError("cannot advance a ready copy: this keeper has none")
            return self._brought_on(self._copy, descriptors, request.elapsed_ns)
        finally:
            messages.close_all(descriptors)

    def _brought_on(self, copy: Copy, deltas: Descriptors, elapsed_ns: int) -> Answer:
        """Apply deltas to the copy, each as soon as it is verified; what does not come as far as the last is ended."""
        try:
            with untrusted.facts("advance a ready copy"):
                for delta in deltas:
                    copy.advance(format.decode(delta))
            copy.require_clocks(elapsed_ns)
            return messages.Laid(copy.position, copy.size), ()
        except CheckpointError:
            self._copy = None
            copy.end()
            raise

    def _finish(self, request: messages.Finish, _: Descriptors) -> Answer:
        copy, self._copy = self._copy, None
        if copy is None or copy.position != request.position:
            if copy is not None:
                copy.end()
            raise RestoreError(f"cannot make {request.order.component} of a ready copy: this keeper has none of that position")
        try:
            with untrusted.facts(f"restore {request.order.component}"):
                needed = needs(copy.state)
        except FormatError:
            copy.end()
            raise
        with untrusted.facts(f"restore {request.order.component}"):
            self._restored = copy.finish(_options(request.order))
        self._revived = request.order, None
        self._names = names_of_contents(needed, request.order.contents) if request.order.robot else None
        return messages.Restored(self._restored.pid, self._restored.position, self._restored.notes), ()

    def _fill(self, request: messages.Fill, descriptors: Descriptors) -> Answer:
        try:
            with untrusted.facts(f"fill the state of {request.component}"):
                state = carried_files.relocated(folded(descriptors), dict(request.places))
        finally:
            messages.close_all(descriptors)
        from checkpoint.engines.cooperative.session import fill_segment
        from checkpoint.resources.carried import restore

        with untrusted.facts(f"fill the state of {request.component}"):
            segment = fill_segment(state)
            laid = restore.lay_down_for(state, os.getpid(), own_eyes=request.own_eyes)
        return messages.Filled(state.position, laid.notes), (segment.descriptor,)

    def _compare(self, request: messages.Compare, descriptors: Descriptors) -> Answer:
        try:
            with untrusted.facts("compare a snapshot with this machine"):
                outline = carried_files.relocated(format.read_outline(descriptors[-1]), dict(request.terms.carry.places))
        finally:
            messages.close_all(descriptors)
        chosen = self._tracer if outline.engine == self._tracer.name else registry.engine_named(outline.engine)
        digests = DigestsOfFiles(request.known)
        with untrusted.facts(f"compare {outline.component} with this machine"):
            options = RestoreOptions(own_eyes=request.own_eyes, contents=request.contents, terms=request.terms)
            if request.running:
                return messages.Compared(chosen.contested(outline, options, request.running, request.components)), ()
            found = chosen.lacks(outline, options, digests.of)
        return messages.Compared(found, tuple(digests.used.values())), ()

    def _open_file(self, request: messages.OpenFile, _: Descriptors) -> Answer:
        session = self._following("open a file of the program")
        return messages.Opened(), (session.open_file(request.path, request.digest),)

    def _resume(self, request: messages.Resume, descriptors: Descriptors) -> Answer:
        restored, revived = self._restored, self._revived
        late = streams_of(descriptors) if request.streams else None
        if restored is None or revived is None:
            messages.close_all(descriptors)
            raise RestoreError("cannot resume: nothing was restored by this keeper")
        self._restored = self._revived = None
        self._lasting = tuple(note for note in restored.notes if note.startswith(LASTING_NOTES))
        self._connections = restored.connections
        restored.resume()
        let_go_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        order, streams = revived
        self._robot = order.robot
        notes = self._follow(restored.pid, order, streams or late) if order.follow else ()
        return messages.Resumed(notes, let_go_ns), ()

    def _follow(self, pid: int, request: messages.Restore, streams: Streams | None) -> tuple[str, ...]:
        """Protect the program that has just been let go; a failure must not end it."""
        try:
            order = ProtectOrder(request.component, streams, request.terms, self._names)
            self._session = self._tracer.protect(pid, order)
        except CheckpointError as error:
            return (f"{messages.UNPROTECTED}: {error}",)
        return self._session.notes

    def _release(self, _: messages.Release, __: Descriptors) -> Answer:
        self._let_go()
        return messages.Released(), ()

    def _following(self, verb: str) -> Session:
        if self._session is None:
            raise CaptureError(f"cannot {verb}: this keeper follows no process; protect one first")
        return self._session

    @property
    def _is_busy(self) -> bool:
        """Whether it follows a process, or is to."""
        return any(one is not None for one in (self._session, self._restored, self._copy))

    def _let_go(self) -> None:
        copy, self._copy = self._copy, None
        if copy is not None:
            copy.end()
        session, self._session, self._gate = self._session, None, None
        self._sender = Sender()
        self._restored = self._revived = None
        if session is not None:
            session.close()


def _become(owner: Owner) -> None:
    """Be an ordinary user from now on: what a snapshot names is opened, asked and made with that user's rights, by the kernel.

    All of us is loaded before: that user may have no right to read where we are installed.
    """
    slim_imports.load_seldom_used()
    for module in pkgutil.walk_packages(checkpoint.__path__, f"{checkpoint.__name__}."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    try:
        namespaces.become(owner.uid, owner.gid, owner.groups or ())
    except OSError as error:
        raise RestoreError(
            f"cannot restore with the rights of uid {owner.uid}: {error.strerror}; restore it as that user"
        ) from error


def _names_of(state: Snapshot, request: messages.Restore) -> dict[str, str] | None:
    return names_of_contents(needs(state), request.contents) if request.robot else None


def _options(order: messages.Restore) -> RestoreOptions:
    return RestoreOptions(
        order.elapsed_ns,
        order.accept_changed,
        order.own_eyes,
        order.epoch,
        order.contents,
        terms=order.terms,
        stood_still=order.stood_still,
        all_connections=order.all_connections,
        bound=order.bound,
    )


def _commit_at(session: Session, position: Position) -> tuple[int, int]:
    """The number of the commit that a cooperative capture holds, and its age, in nanoseconds."""
    task = _as_task(session)
    return (task.commit_at(position), task.age_ns(position)) if task else (0, 0)


def _unchanged(session: Session, request: messages.Capture) -> messages.Unchanged | None:
    """The answer in place of an empty delta; a base, and the last delta of a handover, are always made."""
    if request.base or request.hold or not request.if_changed or (position := session.unchanged(request.epoch)) is None:
        return None
    return messages.Unchanged(position, *_commit_at(session, position), is_current=_as_task(session) is None)


def _as_task(session: Session) -> GuardedTask | None:
    """The session, if it is of the cooperative engine; nothing is loaded to find out that it is not."""
    module = sys.modules.get("checkpoint.engines.cooperative.engine")
    return session if module is not None and isinstance(session, module.GuardedTask) else None


def streams_of(descriptors: Descriptors) -> Streams:
    """The guard's ends of the standard streams, in the order of the message.

    Raises:
        ChannelError: too few or too many.
    """
    if len(descriptors) != STREAM_DESCRIPTORS:
        messages.close_all(descriptors)
        raise ChannelError(f"a request with streams brings {STREAM_DESCRIPTORS} descriptors, not {len(descriptors)}")
    counters, first_output, second_output, first_log, second_log = descriptors
    return Streams(counters, (first_output, second_output), (first_log, second_log))


def encoded_in_memory(snapshot: Snapshot, threads: int = 1) -> tuple[int, int]:
    """A sealed memory file with the snapshot encoded, ours to close, and its size in bytes."""
    descriptor = os.memfd_create("snapshot", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        size = encoded_in(descriptor, snapshot, threads)
        messages.seal(descriptor)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor, size


def encoded_in(descriptor: int, snapshot: Snapshot, threads: int) -> int:
    """Encode a snapshot into an empty file; its size in bytes.

    Raises:
        StoreError: the file does not take it.
    """
    with _written(snapshot.component), open(descriptor, "wb", buffering=0, closefd=False) as file:
        return format.encode(snapshot, file, threads=threads)


def written_in(descriptor: int, base: UnreadBase, threads: int) -> tuple[Snapshot, int]:
    """The same of one whose pages are still in its program; raises as `UnreadBase.write`, too."""
    with _written(base.outline.component), open(descriptor, "wb", buffering=0, closefd=False) as file:
        return base.write(file, threads)


@contextlib.contextmanager
def _written(component: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot write a snapshot of {component}: {with_cure(error)}") from error


def _has_several_processes(files: Descriptors) -> bool:
    return any(map(format.is_of_several_processes, files))


def folded(files: Descriptors) -> Snapshot:
    """The base that a chain's files amount to.

    Raises:
        FormatError: one of them is damaged.
        ChainError: they do not continue each other.
    """
    threads = parallel.thread_count()
    return chain.fold([format.decode(descriptor, threads=threads) for descriptor in files])


def main(arguments: list[str]) -> int:
    """Run a keeper on an inherited socket."""
    if len(arguments) not in (2, 3) or arguments[0] != "keeper" or not arguments[1].isdigit():
        sys.stderr.write(USAGE)
        return 2
    prepare()
    try:
        end = socket.socket(fileno=int(arguments[1]))
    except OSError as error:
        sys.stderr.write(f"keeper: no agent to serve at {arguments[1]}: {error.strerror or error}\n")
        return 1
    serve(end, *arguments[2:])
    return 0


def prepare() -> None:
    """Have this process be one that can serve as a keeper, or be forked to one."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # a Ctrl-C at the terminal is for our peer to act on
    _allow_many_files()
    gc.disable()  # no collection inside a freeze: nearly all that a capture makes is freed by counting
    gc.freeze()


def serve(end: socket.socket, gates: str = "") -> None:
    """Be a keeper until the peer at the other end of this socket hangs up; see `Keeper`."""
    link: Channel[Request] = Channel(end, Request)
    Keeper(link, registry.engine_named(engine.PTRACE), gates).serve()


def _allow_many_files() -> None:
    """Threads and processes take some descriptors each, and a shell allows 1,024."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
