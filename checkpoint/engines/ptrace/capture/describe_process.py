"""Describe a captured process and its threads as model values, from answers of the freeze and from /proc after it resumes."""

from __future__ import annotations

from msgspec.structs import replace

from checkpoint.arch import cpu as arch
from checkpoint.arch import extended
from checkpoint.engines.ptrace.capture.frozen_process import Standing
from checkpoint.engines.ptrace.capture.frozen_threads import ThreadStanding
from checkpoint.engines.ptrace.facts import describe
from checkpoint.engines.ptrace.facts.file_identity import Identities
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.particulars import Particulars
from checkpoint.linux.spawn import cpuid
from checkpoint.model import PosixTimer, ProcessState, ThreadState


def thread_states(standing: Standing) -> tuple[ThreadState, ...]:
    """Its threads, the first one first."""
    return (_first_thread(standing), *map(_other_thread, standing.others))


def _other_thread(standing: ThreadStanding) -> ThreadState:
    place = standing.place
    return ThreadState(
        tid=place.inner_tid,
        name=standing.name,
        registers={"prstatus": arch.encode_registers(standing.settled), "xstate": standing.reading.xstate},
        signal_mask=place.mask,
        pending=place.pending,
        altstack=standing.altstack,
        robust_list=standing.reading.robust_list,
        clear_tid=standing.clear_tid,
        rseq=place.rseq,
        policy=standing.reading.policy,
        priority=standing.reading.priority,
        nice=standing.reading.nice,
        io_priority=standing.reading.io_priority,
        affinity=standing.reading.affinity,
        timer_slack_ns=standing.timer_slack_ns,
        interrupted=standing.interrupted,
    )


def _first_thread(standing: Standing) -> ThreadState:
    place, told, stat, status = standing.place, standing.told, standing.stat, standing.status
    return ThreadState(
        tid=status.pids[-1],
        name=status.name,
        registers={
            "prstatus": arch.encode_registers(standing.settled),
            "xstate": standing.place.reading.xstate,
            "xstate_layout": extended.encode_layout(cpuid.xstate_layout()),
        },
        signal_mask=place.mask,
        pending=place.pending,
        altstack=told.altstack,
        robust_list=told.robust_list,
        clear_tid=told.clear_tid,
        rseq=place.rseq,
        policy=place.reading.policy,
        priority=stat.priority,
        nice=stat.nice,
        io_priority=place.reading.io_priority,
        affinity=place.reading.affinity,
        timer_slack_ns=told.timer_slack_ns,
        interrupted=standing.interrupted,
    )


def process_state(standing: Standing, identities: Identities, facts: Particulars) -> ProcessState:
    """The process as a whole."""
    status, told = standing.status, standing.told
    return ProcessState(
        pid=status.tgids[-1],
        ppid=status.ppid if len(status.pids) == 1 else 0,
        pgid=status.pgids[-1] if status.pgids else 0,
        sid=status.sids[-1] if status.sids else 0,
        executable=identities.executable(),
        arguments=facts.meaning("cmdline", _arguments),
        layout=describe.layout(standing.stat, told, facts.read("auxv")),
        working_directory=facts.link("cwd"),
        root_directory=facts.link("root"),
        umask=status.umask,
        credentials=describe.credentials(status, told),
        personality=facts.meaning("personality", _hexadecimal),
        limits=facts.meaning("limits", procfs.parse_limits),
        oom_score_adj=facts.meaning("oom_score_adj", int),
        dumpable=told.dumpable,
        keep_caps=told.keep_caps,
        child_subreaper=told.child_subreaper,
        parent_death_signal=told.parent_death_signal,
        thp_disabled=told.thp_disabled,
        switches=told.switches,
        coredump_filter=describe.coredump_filter(facts),
        signal_actions=told.actions,
        pending=standing.place.shared_pending,
        interval_timers=told.interval_timers,
        posix_timers=_timers(standing),
        isolated=len(status.pids) > 1,
    )


def _arguments(text: str) -> tuple[str, ...]:
    return tuple(text.split("\0")[:-1])


def _hexadecimal(text: str) -> int:
    return int(text, 16)


def _timers(standing: Standing) -> tuple[PosixTimer, ...]:
    """The timers of timer_create(2). Each names its thread as the program does; /proc names the thread as we do."""
    inner = {other.place.tracee.pid: other.place.inner_tid for other in standing.others}
    status = standing.status
    inner |= {status.pids[0]: status.pids[-1], status.tgid: status.tgids[-1]}
    return tuple(replace(timer, tid=inner.get(timer.tid, timer.tid)) for timer in standing.told.posix_timers)
