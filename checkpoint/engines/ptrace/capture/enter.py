"""Enter a process: borrow pages from it, track the pages that it writes, and find where it is when it is stopped."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.engines.ptrace.capture.seccomp import Confinements
from checkpoint.engines.ptrace.capture.syscall_restart import Interruptions, outside_critical_section
from checkpoint.errors import CaptureError, UnsupportedError
from checkpoint.linux.memory import choose_tracker
from checkpoint.linux.memory.choose_tracker import SoftDirtyTracker
from checkpoint.linux.memory.digest_tracker import DigestTracker
from checkpoint.linux.memory.tracker import Tracker
from checkpoint.linux.memory.write_protect import PagemapTracker
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace import entry, interrupted_syscalls, seccomp, syscall_batch
from checkpoint.linux.trace.remote_syscalls import BorrowedPages
from checkpoint.linux.trace.seccomp import FILTERED
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Rseq
from checkpoint.resources.process import refused_threads, unrestorable_state
from checkpoint.resources.sockets import sockets

LEAVE_TIMEOUT_S: Final = 0.5
"""How long a program may take to leave the code of a tracer that died in the middle: unless it is stopped, that waits 100 ms."""
LEAVE_PAUSE_S: Final = 0.01


class Entered(Struct, frozen=True):
    """The tools of one session; ``notes`` are sentences for the operator."""

    pages: BorrowedPages
    tracker: Tracker
    interruptions: Interruptions
    notes: tuple[str, ...]


def enter_standing(threads: Threads, interruptions: Interruptions) -> Entered:
    """As `enter`, for a process that stands still for us already, and goes on standing.

    Raises:
        CaptureError: also when it stands in the code of a tracer that died.
    """
    entered = _enter_once(threads, interruptions, last=False)
    if entered is None:
        raise CaptureError(f"pid {threads.pid} is still in code of an earlier tracer; capture it again in a moment")
    tracker, notes = _tracker_for(threads.pid, entered)
    return Entered(entered.pages, tracker, interruptions, notes)


def enter(threads: Threads, interruptions: Interruptions) -> Entered:
    """Borrow pages, choose how to track, and let go again.

    Raises:
        CaptureError, ProcessGoneError: it could not be entered; nothing of ours is left in it.
    """
    deadline = time.perf_counter() + LEAVE_TIMEOUT_S
    while (entered := _try_to_enter(threads, interruptions, last=time.perf_counter() > deadline)) is None:
        time.sleep(LEAVE_PAUSE_S)
    tracker, notes = _tracker_for(threads.pid, entered)
    return Entered(entered.pages, tracker, interruptions, notes)


def _try_to_enter(threads: Threads, interruptions: Interruptions, *, last: bool) -> entry.Entered | None:
    """Enter once, by the first thread; None while the program still stands in the code of a tracer that died.

    Args:
        last: waiting has helped nothing: pages that a thread was in are left to the program.
    """
    modes = seccomp.modes(threads.pid)
    with stopped(threads):
        return _enter_once(threads, interruptions, last=last, modes=modes)


def _enter_once(
    threads: Threads, interruptions: Interruptions, *, last: bool, modes: Mapping[int, int] = seccomp.NO_MODES
) -> entry.Entered | None:
    """Enter a process that stands still.

    Args:
        modes: of seccomp(2), by thread, as far as they are known.
    """
    tracee = threads.leader
    if dispatching := [one.pid for one in (tracee, *threads.others) if one.dispatches_calls()]:
        reason = refused_threads.of_dispatching(dispatching[0])
        raise UnsupportedError(f"cannot enter pid {tracee.pid}: {reason}", (reason,))
    confinements = Confinements(interruptions)
    mode = seccomp.mode_in(procfs.read_bytes(tracee.pid, "status"))
    confinements.suspended(tracee, mode, (tracee.pid, 0))
    for one in threads.others if mode or modes else ():
        confinements.suspended(one, modes.get(one.pid, FILTERED if mode else 0), (one.pid, 0))
    mask = tracee.signal_mask()
    registers = where_it_stands(tracee, tracee.registers(), tracee.rseq, interruptions)
    decoded = arch.decode_registers(registers)
    lines = procfs.parse_maps(procfs.read_text(tracee.pid, "maps"))
    left = entry.leftovers(tracee.memory, lines)
    others = [(other, arch.decode_registers(other.registers())) for other in threads.others]
    places = [decoded[arch.INSTRUCTION_POINTER], *(found[arch.INSTRUCTION_POINTER] for _, found in others)]
    stands_inside = any(
        entry.is_in_stub(place, tracee.memory, lines) or any(borrowed.holds(place) for borrowed in left) for place in places
    )
    if stands_inside or (not last and any(borrowed.state() == syscall_batch.ARMED for borrowed in left)):
        if last:
            raise CaptureError(f"pid {tracee.pid} does not leave the code of an earlier tracer; protect it again")
        return None
    for one, found in ((tracee, decoded), *others):
        interruptions.of(one).settled(found)  # remembers the call that it stands in
    for borrowed in left:
        if borrowed.state() == syscall_batch.ARMED:
            borrowed.abandon()
        _put_back(threads.pid, borrowed)
    free = [borrowed for borrowed in left if borrowed.state() != syscall_batch.ABANDONED]
    if free:
        entered = entry.reenter(tracee, free[0], registers, mask)
    else:
        entered = entry.enter(tracee, lines, registers, mask)
    batch = syscall_batch.Batch(entered.pages.table)
    questions = unrestorable_state.Questions(batch)
    for number in {entered.inside, *entry.left_open(tracee.pid)}:
        batch.add("close", number)
    try:
        answers = entered.pages.run(tracee, batch, registers, mask)
        _require_none((*unrestorable_state.refuse_ports(tracee), *questions.refuse(answers)), tracee.pid)
    except BaseException:
        if entered.faults is not None:
            os.close(entered.faults)
        raise
    return entered


def _require_none(reasons: tuple[str, ...], pid: int) -> None:
    if reasons:
        raise UnsupportedError(f"cannot enter pid {pid}: {'; '.join(reasons)}", reasons)


def _put_back(pid: int, borrowed: BorrowedPages) -> None:
    """Put back where a socket's MSG_PEEK begins, where a tracer died that had moved it (`sockets.queue_of`)."""
    note = borrowed.take_note()
    if note is None:
        return
    number, offset = note
    with contextlib.suppress(OSError), sockets.looked_into(pid, number) as looked:  # it has closed it since
        sockets.set_peek_offset(looked, offset)


def where_it_stands(tracee: Tracee, registers: bytes, rseq: Callable[[], Rseq | None], interruptions: Interruptions) -> bytes:
    """The registers that the program is given back: as they are, but for what our stop alone has brought about.

    Args:
        rseq: answers with its registration for restartable sequences; it may be in one if it is in no call.
    """
    _, result, number = arch.stand_of(registers)
    if number >= 0:
        is_disturbed = interruptions.of(tracee).is_disturbed(result)
        return _undisturbed(tracee, registers, interruptions) if is_disturbed else registers
    if arch.FORGETS_CALLS:
        registers = _undisturbed(tracee, registers, interruptions)
    registration = rseq()
    if registration is None:
        return registers
    pointer, _, _ = arch.stand_of(registers)
    found = outside_critical_section(pointer, tracee.memory, registration.address)
    if found == pointer:
        return registers
    return arch.encode_registers({**arch.decode_registers(registers), arch.INSTRUCTION_POINTER: found})


def _undisturbed(tracee: Tracee, registers: bytes, interruptions: Interruptions) -> bytes:
    interruption = interruptions.of(tracee)
    if arch.FORGETS_CALLS:
        registers = interruption.going_on(tracee, registers)
    decoded = arch.decode_registers(registers)
    if arch.FORGETS_CALLS:
        decoded = interrupted_syscalls.told(tracee, decoded)
    found = interruption.undisturbed(decoded)
    return registers if found is decoded else arch.encode_registers(found)


def _tracker_for(pid: int, entered: entry.Entered) -> tuple[Tracker, tuple[str, ...]]:
    """The best way to find written pages that this kernel has for this process, and what to say about it."""
    why = os.strerror(entered.why_not)
    if entered.faults is not None:
        try:
            return PagemapTracker(pid, entered.faults), ()
        except BaseException as error:
            os.close(entered.faults)
            if not isinstance(error, OSError):
                raise
            why = str(error)
    tracker: Tracker = SoftDirtyTracker(pid) if choose_tracker.has_soft_dirty() else DigestTracker(pid)
    return tracker, (f"written pages are found by {tracker.name}: {tracker.cost}; no write protection ({why})",)


@contextlib.contextmanager
def stopped(threads: Threads) -> Iterator[None]:
    """Hold all of it still for the body; let it go however that ends."""
    threads.freeze()
    try:
        yield
    finally:
        threads.thaw()
