"""Ask the process for facts that only it knows: one batch of system calls made inside it, and the decoding of the answers."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Sequence
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.engines.ptrace.facts.prctl_state import Questions, Switch
from checkpoint.linux import abi
from checkpoint.linux.procfs.timers import TimerLine
from checkpoint.linux.trace.syscall_batch import Answers, Batch
from checkpoint.model import Clocks, IntervalTimer, PosixTimer, SignalAction

SIGCHLD: Final = 17
NS_PER_S: Final = 1_000_000_000
US_PER_S: Final = 1_000_000
CLOCK_REALTIME: Final = 0
CLOCK_MONOTONIC: Final = 1
CLOCK_BOOTTIME: Final = 7
INTERVAL_TIMER_COUNT: Final = 3
CHILD_SIZE: Final = 32
"""Bytes of a siginfo that waitid(2) writes: signal, error, code, four unused, pid, uid, status. Source: kernel/exit.c."""


class Told(Struct, frozen=True):
    """The answers of the process about itself; the fields are those of ``checkpoint.model``.

    Attributes:
        continued_child: one of its children that goes on after a stop, and of which it has not been told, as it knows it; or 0.
    """

    clocks: Clocks
    actions: tuple[SignalAction, ...]
    altstack: tuple[int, int, int]
    interval_timers: tuple[IntervalTimer, ...]
    posix_timers: tuple[PosixTimer, ...]
    robust_list: tuple[int, int]
    clear_tid: int
    brk: int
    dumpable: int
    keep_caps: bool
    child_subreaper: bool
    parent_death_signal: int
    thp_disabled: bool
    securebits: int
    timer_slack_ns: int
    switches: tuple[Switch, ...]
    continued_child: int = 0


class Inquiry:
    """One set of questions; `read` understands the answers to exactly these.

    Args:
        special: signals with an action of their own, bit 0 is signal 1.
    """

    def __init__(self, table: int, special: int, timers: Sequence[TimerLine]) -> None:
        self.batch = Batch(table)
        self._timers = timers
        self._clocks = [self._writes(16, "clock_gettime", clock) for clock in (CLOCK_REALTIME, CLOCK_MONOTONIC, CLOCK_BOOTTIME)]
        special |= 1 << (SIGCHLD - 1)
        self._actions = [
            (number, self._asks_action(number)) for number in range(1, abi.SIGNAL_COUNT + 1) if special >> (number - 1) & 1
        ]
        self._altstack = self._filled(24, lambda address: ("sigaltstack", 0, address))
        self._intervals = [self._writes(32, "getitimer", which) for which in range(INTERVAL_TIMER_COUNT)]
        self._posix = [
            (line, self._writes(32, "timer_gettime", line.timer_id), self.batch.add("timer_getoverrun", line.timer_id))
            for line in timers
        ]
        self._robust = self.batch.output(16)
        self.batch.add("get_robust_list", 0, self._robust, self._robust + 8)
        self._clear_tid = self._writes(8, "prctl", abi.PR_GET_TID_ADDRESS)
        self._brk = self.batch.add("brk", 0)
        self._dumpable = self.batch.add("prctl", abi.PR_GET_DUMPABLE)
        self._keep_caps = self.batch.add("prctl", abi.PR_GET_KEEPCAPS)
        self._subreaper = self._writes(8, "prctl", abi.PR_GET_CHILD_SUBREAPER)
        self._death_signal = self._writes(8, "prctl", abi.PR_GET_PDEATHSIG)
        self._thp = self.batch.add("prctl", abi.PR_GET_THP_DISABLE, 0, 0, 0, 0)
        self._securebits = self.batch.add("prctl", abi.PR_GET_SECUREBITS)
        self._switches = Questions(self.batch)
        self._slack = self.batch.add("prctl", abi.PR_GET_TIMERSLACK)
        self._child = self.batch.output(CHILD_SIZE)
        options = os.WCONTINUED | os.WNOHANG | os.WNOWAIT | abi.WALL
        self._told_child = self.batch.add("waitid", os.P_ALL, 0, self._child, options, 0)

    @property
    def has_timers(self) -> bool:
        """Whether a signal of timer_create(2) may come while the questions are asked."""
        return bool(self._timers)

    def _asks_action(self, signal: int) -> int:
        return self._filled(32, lambda address: ("rt_sigaction", signal, 0, address, abi.SIGSET_SIZE))

    def _writes(self, size: int, name: str, *arguments: int) -> int:
        """A call whose last argument points to its output; answers with that address."""
        return self._filled(size, lambda address: (name, *arguments, address))

    def _filled(self, size: int, call: Callable[[int], tuple[str | int, ...]]) -> int:
        address = self.batch.output(size)
        name, *arguments = call(address)
        self.batch.add(str(name), *(int(argument) for argument in arguments))
        return address

    def read(self, answers: Answers) -> Told:
        """Understand the answers."""

        def words(address: int, form: str) -> tuple[int, ...]:
            return struct.unpack(form, answers.at(address, struct.calcsize(form)))

        result = answers.results
        realtime, monotonic, boottime = (seconds * NS_PER_S + rest for seconds, rest in (words(at, "<qq") for at in self._clocks))
        sp, flags, _, size = words(self._altstack, "<QiiQ")
        head, length = words(self._robust, "<QQ")
        return Told(
            clocks=Clocks(realtime, monotonic, boottime),
            actions=tuple(_action(number, words(at, "<QQQQ")) for number, at in self._actions),
            altstack=(sp, flags, size),
            interval_timers=tuple(
                timer for which, at in enumerate(self._intervals) if (timer := _interval(which, words(at, "<qqqq"))) is not None
            ),
            posix_timers=tuple(_posix(line, words(at, "<qqqq"), result[overrun]) for line, at, overrun in self._posix),
            robust_list=(head, length),
            clear_tid=words(self._clear_tid, "<Q")[0],
            brk=result[self._brk],
            dumpable=result[self._dumpable],
            keep_caps=result[self._keep_caps] == 1,
            child_subreaper=words(self._subreaper, "<i")[0] == 1,
            parent_death_signal=words(self._death_signal, "<i")[0],
            thp_disabled=result[self._thp] == 1,
            securebits=max(result[self._securebits], 0),
            timer_slack_ns=max(result[self._slack], 0),
            switches=(*self._switches.read(answers), *_huge_pages(result[self._thp])),
            continued_child=words(self._child, "<16xi")[0] if result[self._told_child] == 0 else 0,
        )


def _huge_pages(told: int) -> tuple[Switch, ...]:
    """The switch of transparent huge pages, where more is said than that there are none (Linux 6.18)."""
    return ((abi.PR_SET_THP_DISABLE, 1, told & ~1),) if told > 1 else ()


def _action(number: int, words: tuple[int, ...]) -> SignalAction:
    handler, flags, restorer, mask = words
    return SignalAction(number, handler, flags, restorer, mask)


def _interval(which: int, words: tuple[int, ...]) -> IntervalTimer | None:
    interval_s, interval_us, value_s, value_us = words
    timer = IntervalTimer(which, interval_s * US_PER_S + interval_us, value_s * US_PER_S + value_us)
    return timer if timer.interval_us or timer.value_us else None


def _posix(line: TimerLine, words: tuple[int, ...], overrun: int) -> PosixTimer:
    interval_s, interval_ns, value_s, value_ns = words
    return PosixTimer(
        timer_id=line.timer_id,
        clock=line.clock,
        notify=line.notify,
        signal=line.signal,
        value=line.value,
        tid=line.tid,
        interval_ns=interval_s * NS_PER_S + interval_ns,
        value_ns=value_s * NS_PER_S + value_ns,
        overrun=max(overrun, 0),
    )


SI_TIMER: Final = -2
SI_KERNEL: Final = 0x80
INTERVAL_SIGNALS: Final = (14, 26, 27)
"""SIGALRM, SIGVTALRM, SIGPROF: of the interval timers 0, 1, 2."""


def rearmed(told: Told, before: Sequence[bytes], after: Sequence[bytes]) -> Told:
    """Timers that went off while the batch ran are set to go off at once: their signal is not in the snapshot.

    A periodic timer whose signal was pending before has its next period before it: the kernel winds it up only when the signal
    is taken.

    Args:
        before, after: every pending siginfo, at the freeze and after the batch.
    """
    fresh = [siginfo for siginfo in after if siginfo not in before]
    went_off = {number for number, code, _ in map(_origin, fresh) if code == SI_KERNEL}
    expired = {timer for _, code, timer in map(_origin, fresh) if code == SI_TIMER}
    intervals = [timer if timer.value_us else _wound(timer, went_off) for timer in told.interval_timers]
    known = {timer.which for timer in intervals}
    intervals += [
        IntervalTimer(which, 0, 1) for which, number in enumerate(INTERVAL_SIGNALS) if number in went_off and which not in known
    ]
    posix = [
        replace(timer, value_ns=1) if not timer.value_ns and timer.timer_id in expired else timer for timer in told.posix_timers
    ]
    return replace(told, interval_timers=tuple(intervals), posix_timers=tuple(posix))


def _wound(timer: IntervalTimer, went_off: set[int]) -> IntervalTimer:
    return replace(timer, value_us=1 if INTERVAL_SIGNALS[timer.which] in went_off else timer.interval_us)


def _origin(siginfo: bytes) -> tuple[int, int, int]:
    """Signal number, code and timer of a siginfo. Source: struct siginfo of asm-generic/siginfo.h."""
    number, _, code, timer = struct.unpack_from("<iii4xi", siginfo)
    return number, code, timer
