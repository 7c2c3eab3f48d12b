"""Stop all threads of one process and release them together.

How none is missed, and none left behind (each step is a race):

1. The listing of /proc/PID/task is older than the seizing: a thread that has ended meanwhile is passed over.
2. A thread that is seized but still runs creates another: the new one is in /proc/PID/task before its creator can stop
   (copy_process in kernel/fork.c looks for signals before it adds it). So the threads are counted again, and listed, until every
   counted thread is stopped; only a running thread can create one.
3. A thread ends between seizing and stopping: the kernel notifies its tracer, which must reap it, or its process could never end.
4. A thread waits inside the kernel (a disk, a network file system, vfork) and does not stop: all others are released, and this
   one as soon as it stops, which SIGCHLD reports.
5. The process is killed while it is stopped: each thread ends for its tracer first, as in 3.
6. The tracer dies: the kernel releases all threads.
7. A thread executes another program during the seizing: it waits until the tracer has reaped the others, and the tracer waits for
   it (`checkpoint.linux.child_reaper`).
8. A seized thread executes another program: it is still traced, under its process's id, and its own id is gone. It runs on unless
   it has been asked to stop, or is asked once more. Requests to the first thread, which had that id, are void.

Source: ptrace(2), "Attaching and detaching", "Death under ptrace"; proc_pid_task(5).
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from checkpoint.arch import cpu as arch
from checkpoint.errors import CaptureError, CheckpointError, ProbeError, ProcessGoneError
from checkpoint.linux.child_reaper import Burial, bury
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.cpu_of_thread import Whereabouts
from checkpoint.linux.procfs.tasks import ThreadCount, thread_ids
from checkpoint.linux.trace import interrupted_syscalls, pending_sigstop, syscall_reentry
from checkpoint.linux.trace.bulk_stops import Together
from checkpoint.linux.trace.tracee import PLAIN_STOP, STOP_TIMEOUT_S, Tracee, no_stop, rest

GLANCE_S: Final = 0.02
"""How long a thread may take before we look whether it waits inside the kernel."""
PATIENCE_S: Final = 1.0
"""How long we wait for threads that do not stop where no signal can tell us (in a thread of ours that is not the first)."""
FEW: Final = 4
"""Fewer threads are asked one after the other: a table of calls costs something, too."""
SEIZINGS: Final = 30
"""How often a thread is seized before it is believed that we may not; the kernel has one word for that and for one that ends."""


def _seized_at_last(tracee: Tracee) -> None:
    """Seize a thread; its id may just be passing to the one that executes another program (8).

    Raises:
        ProbeError: we may not, or another process traces it.
    """
    for _ in range(SEIZINGS):
        try:
            return tracee.seize()
        except ProbeError:
            pass
        if procfs.status(tracee.pid).tracer:
            break
        time.sleep(0.0001)
    return tracee.seize()


class Ear:
    """SIGCHLD, heard for all listeners: a process has one such signal."""

    def __init__(self) -> None:
        self._listeners: list[Threads] = []
        self._before: Any = None

    def add(self, listener: Threads) -> None:
        """Have `Threads.hear` called; from the first thread of ours only."""
        if not self._listeners:
            self._before = signal.signal(signal.SIGCHLD, lambda *_: self._hear()) or signal.SIG_DFL
        if listener not in self._listeners:
            self._listeners.append(listener)

    def remove(self, listener: Threads) -> None:
        """Have it called no more."""
        if listener in self._listeners:
            self._listeners.remove(listener)
            if not self._listeners:
                signal.signal(signal.SIGCHLD, self._before)

    def _hear(self) -> None:
        for listener in tuple(self._listeners):
            listener.hear()


EAR: Final = Ear()


class Threads:
    """The threads of one process; every call from the thread of ours that makes the first one.

    Invariants: between `thaw` and `freeze` no thread is seized, but for those in ``_loose``, which had not stopped.

    Attributes:
        leader: the first thread, whose id is the process's; or, where that has ended, its spokesman.
        process: the process's id.
        asked_ns: when the first of them was asked to stop for the last `freeze`, by time.perf_counter_ns.
        is_one_of_many: other processes stand still meanwhile: one that waits inside the kernel (for a child of vfork, for one) is
            not waited for.
        patience_ns: how long they may take to stop; None: as long as is usual.

    Args:
        mend: is called for each thread that is let go as it was found, of which nothing else was asked.
        process: where it is not the leader's.
    """

    def __init__(self, leader: Tracee, mend: Callable[[Tracee], None] | None = None, process: int = 0) -> None:
        self.leader = leader
        self.process = process or leader.pid
        self._mend = mend
        self._whereabouts = leader.whereabouts = Whereabouts(leader.pid)
        self._thread_count = ThreadCount(leader.pid)
        self._known: dict[int, Tracee] = {leader.pid: leader}
        self._held: dict[int, Tracee] = {}
        self._moving: set[int] = set()
        self._loose: dict[int, Tracee] = {}
        self.asked_ns = 0
        self.is_one_of_many = False
        self.patience_ns: int | None = None
        self._burial: Burial | None = None
        self._seized: set[int] = set()
        self._have_ended = False

    @property
    def pid(self) -> int:
        """The id by which we look at the process (`checkpoint.linux.procfs.live_thread`)."""
        return self.leader.pid

    def _count(self) -> int:
        """The number of threads that can be stopped: the kernel counts a first thread that has ended until all have."""
        return self._thread_count.read() - (self.process != self.pid)

    @functools.cached_property
    def _together(self) -> Together:
        return Together()

    @property
    def others(self) -> tuple[Tracee, ...]:
        """The threads that stand still, besides the leader, oldest first."""
        first, held = self.pid, self._held
        return tuple([held[tid] for tid in sorted(held) if tid != first])

    # Stopping

    def freeze(self) -> None:
        """Stop every thread.

        Raises:
            ProcessGoneError: the process has ended.
            ProbeError: another process traces one of them, or we may not.
            CaptureError: one did not stop in time. No thread stands still for us after any of these.
        """
        self._require_none_loose()
        self._whereabouts.prepare()
        try:
            self._freeze()
            if any(tracee.stopped_by for tracee in self._held.values()):
                pending_sigstop.take_away(self._held.values())
        except BaseException:
            self.thaw()
            raise
        if len(self._known) > len(self._held):
            self._known = {self.pid: self.leader, **self._held}

    def _freeze(self) -> None:
        patience_s = STOP_TIMEOUT_S if self.patience_ns is None else min(STOP_TIMEOUT_S, self.patience_ns / 1e9)
        deadline = time.perf_counter() + patience_s
        ended: set[int] = set()
        self._moving.clear()
        self._have_ended = False
        self.asked_ns = 0
        if self.process != self.pid:
            self._await_end_of_first(deadline)
        fresh = [self.pid] if self._count() == 1 else thread_ids(self.pid)
        while fresh:
            ended |= self._stop(fresh, deadline)
            if self._count() == len(self._held):
                return
            fresh = [tid for tid in thread_ids(self.pid) if tid not in self._held and tid not in ended]
            if fresh and time.perf_counter() > deadline:
                raise CaptureError(
                    f"pid {self.pid} did not come to stand still within {patience_s:g} s: it starts threads all the time, "
                    "or the machine leaves it no processor; capture it again"
                )

    def _await_end_of_first(self, deadline: float) -> None:
        """See that its spokesman is of the process still, and that its first thread has done all that it does at its end.

        Until that is a zombie it may still write to the memory (robust futexes, and the word on which threads wait that join it).

        Raises:
            ProcessGoneError: no thread has the spokesman's id any more, or a stranger has it; or the first thread lives (8).
            CaptureError: it does not come to its end.
        """
        began = now = time.perf_counter()
        while True:
            procfs.thread_stat(self.process, self.pid)
            first = procfs.thread_stat(self.process, self.process)
            if first.state in "ZX":
                return
            if not first.flags & procfs.PF_EXITING:
                raise ProcessGoneError(f"pid {self.process} has become another program (exec)")
            if now > deadline:
                raise CaptureError(f"the first thread of pid {self.process} does not come to its end; capture it again")
            rest(now - began)
            now = time.perf_counter()

    def _stop(self, tids: list[int], deadline: float) -> set[int]:
        """Stop these; those that have ended instead."""
        ended: set[int] = set()
        if arch.FORGETS_CALLS:
            for tid in tids:
                interrupted_syscalls.look(self._tracee(tid))
        with self._watched(tids):
            seized = self._seize_together(tids) if len(tids) >= FEW else set[int]()
            asked = [tid for tid in tids if tid in seized or self._unless_ended(self._seize, tid, ended)]
        self.asked_ns = self.asked_ns or time.perf_counter_ns()
        told = self._ask_together(asked) if len(asked) >= FEW else set[int]()
        for tid in asked:
            if tid not in told:
                self._unless_ended(self._ask, tid, ended)
        self._await_all(deadline, ended)
        return ended

    def _watched(self, tids: list[int]) -> contextlib.AbstractContextManager[None]:
        """See that seizing them does not wait for ever (7): that takes two."""
        if len(tids) + len(self._held) <= 1:
            return contextlib.nullcontext()
        if self._burial is None:
            self._burial = Burial()
        self._seized = {*self._held, *tids} - {self.pid, self.process}  # one may be ours since an earlier look, and have ended
        return self._burial.watching(self._seized)

    def _seize_together(self, tids: list[int]) -> set[int]:
        """Seize these; answers with those seized. While it waits (7) all threads must be known whose end we may have to note."""
        self._seized.update(tid for tid in tids if tid != self.pid)
        seized = [tid for tid, is_ours in zip(tids, self._together.seize(tids), strict=True) if is_ours]
        for tid in seized:
            tracee = self._held[tid] = self._tracee(tid)
            tracee.is_as_found = True
        return set(seized)

    def _ask_together(self, tids: list[int]) -> set[int]:
        """Ask these to stop; answers with those asked."""
        asked = {tid for tid, was_asked in zip(tids, self._together.ask_to_stop(tids), strict=True) if was_asked}
        self._moving |= asked
        return asked

    def _tracee(self, tid: int) -> Tracee:
        tracee = self._known.get(tid)
        if tracee is None:
            tracee = self._known[tid] = Tracee(tid, self.leader.memory)
        return tracee

    def _seize(self, tid: int) -> None:
        tracee = self._tracee(tid)
        _seized_at_last(tracee)
        self._held[tid] = tracee
        if tid != self.pid:
            self._seized.add(tid)

    def _ask(self, tid: int) -> None:
        if self._held[tid].ask_to_stop() is None:
            self._moving.add(tid)

    def _unless_ended(self, act: Callable[[int], None], tid: int, ended: set[int]) -> bool:
        """Do something to a thread; False if it has ended. A process whose first thread has ended is another matter."""
        try:
            act(tid)
        except ProcessGoneError:
            if tid == self.pid:
                raise
            bury(tid)
            ended.add(tid)
            self._forget(tid)
            return False
        return True

    def _forget(self, tid: int) -> None:
        """A thread has ended."""
        self._held.pop(tid, None)
        self._moving.discard(tid)
        self._have_ended = True

    def _await_all(self, deadline: float, ended: set[int]) -> None:
        """Wait for the stops of those that move: for all at once, for the end of one may wait for our taking note of another's.

        Raises:
            CaptureError: one does not stop.
        """
        began = now = time.perf_counter()
        glance = began + GLANCE_S
        is_here = False
        while self._moving:
            count = len(self._moving)
            for tid in self._hear_reports(ended) if count >= FEW else tuple(self._moving):
                self._unless_ended(self._look_whether_it_stands, tid, ended)
            if len(self._moving) == count:
                is_here = is_here or (now == began and self._moving == {self.pid} and self.leader.is_here())
                rest(now - began, is_here=is_here)
            now = time.perf_counter()
            if self._moving and now > deadline:
                raise no_stop(min(self._moving), now - began)
            if now > glance:
                glance = now + GLANCE_S
                self._glance(now - began, ended)

    def _hear_reports(self, ended: set[int]) -> list[int]:
        """Hear of all in one go; answers with those to ask singly: lost ones, and the first, whose end its parent must note."""
        others = [tid for tid in self._moving if tid != self.pid]
        singly = [self.pid] if self.pid in self._moving else []
        for tid, report in zip(others, self._together.reports(others), strict=True):
            if report.status == PLAIN_STOP:
                self._held[tid].stopped_by = 0
                self._moving.discard(tid)
            elif report.status is not None:
                self._unless_ended(functools.partial(self._take_report, report.status), tid, ended)
            elif report.is_lost:
                singly.append(tid)
        return singly

    def _take_report(self, status: int, tid: int) -> None:
        if self._held[tid].stands_by(status):
            self._moving.discard(tid)

    def _look_whether_it_stands(self, tid: int) -> None:
        if self._held[tid].has_stopped():
            self._moving.discard(tid)

    def _glance(self, waited_s: float, ended: set[int]) -> None:
        """See which threads keep us waiting.

        Raises:
            ProcessGoneError: another thread has become the first one, which is not traced.
            CaptureError: one waits inside the kernel; but where no other thread stands still, that may take its time.
        """
        for tid in [tid for tid in self._held if tid not in self._moving and tid != self.pid and bury(tid)]:
            ended.add(tid)
            self._forget(tid)
        is_alone = self._count() == 1 and not self.is_one_of_many
        for tid in () if is_alone else sorted(self._moving):
            with contextlib.suppress(ProcessGoneError):
                if procfs.thread_stat(self.pid, tid).state == "D":
                    raise no_stop(tid, waited_s)
        if self.pid in self._moving:
            self._glance_at_first()

    def _glance_at_first(self) -> None:
        """The first thread may be another one than we have seized, or than we have asked (8)."""
        status = procfs.status(self.pid)
        if status.state in "ZX":  # the kernel does not report that while others live
            raise ProcessGoneError(f"the first thread of pid {self.pid} has ended")
        if status.tracer != threading.get_native_id():
            raise ProcessGoneError(f"pid {self.pid} has become another program (exec)")
        if self._have_ended:
            self.leader.interrupt()  # the same one could stop twice: not without need

    # Letting go

    def thaw(self) -> None:
        """Let all threads go, however far `freeze` came, also when some have ended meanwhile."""
        held, self._held = self._held, {}
        together: list[int] = []
        for tid, tracee in held.items():
            try:
                if self._mend and tracee.is_as_found:
                    self._mend(tracee)
                if arch.FORGETS_CALLS and not tracee.is_as_found:
                    syscall_reentry.enter(tracee)
                if len(held) < FEW:
                    tracee.detach()
                else:
                    together.append(tid)
            except CheckpointError:
                self._loose[tid] = tracee
        if together:
            gone = self._together.let_go(together)
            self._loose |= {tid: held[tid] for tid, is_gone in zip(together, gone, strict=True) if not is_gone}
        self._settle()

    def close(self) -> None:
        """Nothing more will be asked of it; no thread may be held."""
        self._whereabouts.close()
        self._thread_count.close()
        if self._burial is not None:
            self._burial.close()
            self._burial = None

    def adopt(self, others: tuple[Tracee, ...]) -> None:
        """Take over threads that are ours already and stand still, the leader among them."""
        self._held = {tracee.pid: tracee for tracee in (self.leader, *others)}
        self._known |= self._held

    def hold(self) -> None:
        """Leave them standing; should they be killed meanwhile, we take note, so that their parent hears of it."""
        self._listen()

    def _settle(self) -> None:
        """Let go of those that had not stopped, or take note of their end: now, or as soon as it can be."""
        self._tend()
        if not self._loose:
            self._listen_no_more()
            return
        if self._listen():
            self._tend()
            return
        deadline = time.perf_counter() + PATIENCE_S
        while self._loose and time.perf_counter() < deadline:
            time.sleep(0.001)
            self._tend()

    def _tend(self) -> None:
        """Let go of all threads that can be let go. SIGCHLD may make `hear` do the same in the middle of it; its results stay."""
        for tid, tracee in tuple(self._loose.items()):
            if self._is_let_go(tracee):
                self._loose.pop(tid, None)

    def _is_let_go(self, tracee: Tracee) -> bool:
        """Try once more to let go of a thread; whether it is ours no more."""
        if self._is_our_child(tracee) and tracee.is_dead():
            return True  # its parent, a part of this process, takes note of it
        try:
            stop = tracee.reported()
        except ProcessGoneError:
            self._look_for_heir(tracee)
            return True
        if stop is None:
            if tracee.interrupt_if_ours():
                return False  # (8): perhaps we have not asked it yet under this id
            self._look_for_heir(tracee)
            return True
        try:
            tracee.detach(stop.signal if stop.is_delivery else 0)
        except ProcessGoneError:
            return False  # killed just now: its end is still to come
        return True

    def _look_for_heir(self, gone: Tracee) -> None:
        """A thread whose id is gone may have its process's by now (8), and have stopped before we looked for it there."""
        heir = self.leader if self.process == self.pid else Tracee(self.process, self.leader.memory)
        if gone.pid != heir.pid and heir.pid not in self._held and not heir.is_dead() and heir.interrupt_if_ours():
            self._loose[heir.pid] = heir
            if self._is_let_go(heir):
                self._loose.pop(heir.pid, None)

    def _is_our_child(self, tracee: Tracee) -> bool:
        if tracee is not self.leader or self.process != self.pid:
            return False
        try:
            return procfs.status(self.pid).ppid == os.getpid()
        except CheckpointError:
            return False

    def _require_none_loose(self) -> None:
        if self._loose:
            self._settle()
        if self._loose:
            listed = ", ".join(map(str, self._loose))
            raise CaptureError(
                f"thread {listed} of pid {self.pid} waits inside the kernel since the last attempt, for a device or a file "
                "system; capture it again when that answers"
            )

    # Hearing of it

    def _listen(self) -> bool:
        """Have the kernel tell us; False where it cannot: signals go to our first thread."""
        if threading.current_thread() is not threading.main_thread():
            return False
        EAR.add(self)
        return True

    def _listen_no_more(self) -> None:
        EAR.remove(self)

    def hear(self) -> None:
        """A child or a traced thread of this process has stopped or ended."""
        for tracee in self._held.values():
            if not self._is_our_child(tracee):
                bury(tracee.pid)
        if self._loose:
            self._tend()
            if not (self._loose or self._held):
                self._listen_no_more()
