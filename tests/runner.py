"""How the tests run: which of them side by side, and how a test that hangs or kills its worker fails alone.

A test that is over its limit (``timeout`` of pytest-timeout) gets SIGALRM, whose handler raises. pytest takes an exception
for that of the test only inside a phase: set-up, call, teardown. Elsewhere the same exception is an internal error, and ends
the run: a busy machine takes seconds to write a long report. So here the handler waits for the next phase, or for the end of
the test.

What SIGALRM cannot end ends with its worker: a call that does not return, a test that catches the exception. After `LIMITS`
limits the kernel sends the worker SIGABRT, for which faulthandler writes all stacks, and SIGKILL one limit later. An
internal error ends its worker, too. pytest-xdist then reports the test as failed and starts another worker. Its own
scheduler would run that test again, until every worker has died of it, and give work to a new worker that has not collected
yet; `OneStage` does neither.

Source: timer_create(2); xdist/scheduler/loadscope.py, xdist/dsession.py and pytest_timeout.py.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import signal
import struct
import threading
import zlib
from collections import Counter
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, Any, Final

import pytest
import pytest_timeout

if TYPE_CHECKING:
    from xdist.scheduler import LoadScopeScheduling
    from xdist.workermanage import WorkerController

SEGMENTS: Final = ("tests/checkpoint/engines/ptrace/restore/test_memory_kinds.py", "tests/checkpoint/resources/test_refusals.py")
"""They make System V segments, or look at all that there are on the machine."""

LIMITS: Final = 2
"""Limits of a test after which its worker ends."""
AGAIN_S: Final = 0.5
"""How soon the handler looks again at a limit that was over between two phases; and what the next phase has at least."""
CRASHED: Final = 70
"""Exit status of a worker with an internal error."""

SIGEV_SIGNAL: Final = 0  # asm-generic/siginfo.h
SIGEV_SIZE: Final = 64


# --- Side by side ----------------------------------------------------------------------------------------------------


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadScopeScheduling:
    """With ``-n 2`` files run side by side, but never two tests of whole robots: one worker begins with these, in their order."""
    from xdist.scheduler import LoadScopeScheduling

    class OneStage(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::")[0]
            if file.startswith("tests/e2e/"):
                return "robots"
            return "segments" if file in SEGMENTS else file

        def remove_node(self, node: WorkerController) -> str | None:
            """Give what a worker leaves to the others, but for the test in which it died; answers which that was."""
            left = {scope: tests for scope, tests in self.assigned_work.pop(node).items() if not all(tests.values())}
            if not left:
                return None
            died_in = next(test for test, is_done in next(iter(left.values())).items() if not is_done)
            next(iter(left.values()))[died_in] = True
            self.workqueue.update({scope: tests for scope, tests in left.items() if not all(tests.values())})
            for other in self.nodes:
                self._reschedule(other)
            return died_in

        def _reschedule(self, node: WorkerController) -> None:
            if node in self.registered_collections:  # one that replaces another has yet to collect
                super()._reschedule(node)

    return OneStage(config, log)


# --- Which cases -----------------------------------------------------------------------------------------------------


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Of a test's cases take one in n, where it is ``sampled(n)``: always the same ones, spread over all its parameters.

    All are taken with ``FAILOVER_CASES=all`` in the environment, and where the command line names tests, by ``::`` or ``-k``.
    """
    is_named = config.option.keyword or any("::" in word for word in config.args)
    if is_named or os.environ.get("FAILOVER_CASES") == "all":
        return
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sampled"):
            cases.setdefault(item.nodeid.split("[")[0], []).append(item)
    left: set[pytest.Item] = set()
    for of_one in cases.values():
        count = -(-len(of_one) // of_one[0].get_closest_marker("sampled").args[0])
        left.update(sorted(of_one, key=lambda item: zlib.crc32(item.nodeid.encode()))[count:])
    if left:
        config.hook.pytest_deselected(items=list(left))
        items[:] = [item for item in items if item not in left]


# --- Where the time goes ---------------------------------------------------------------------------------------------


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """With ``--durations``, how many seconds each worker spent in which folder: a run lasts as long as its last worker."""
    if config.getoption("durations") is None:
        return
    spent: dict[str, Counter[str]] = {}
    for report in itertools.chain.from_iterable(terminalreporter.stats.values()):
        if isinstance(report, pytest.TestReport):
            folder = "/".join(report.nodeid.split("::")[0].split("/")[:-1][:2]) or "."
            spent.setdefault(getattr(report, "worker_id", "here"), Counter())[folder] += report.duration
    for worker, folders in sorted(spent.items()):
        told = ", ".join(f"{folder} {seconds:.0f} s" for folder, seconds in folders.most_common())
        terminalreporter.write_line(f"{worker}: {sum(folders.values()):.0f} s: {told}")


# --- The limit of a test ---------------------------------------------------------------------------------------------

_in_phase = False


@contextlib.contextmanager
def _phase() -> Iterator[None]:
    """A phase has at least `AGAIN_S`: an alarm at its very beginning would skip a teardown, and break the next test."""
    global _in_phase
    if 0 < signal.getitimer(signal.ITIMER_REAL)[0] < AGAIN_S:
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    _in_phase = True
    try:
        yield
    finally:
        _in_phase = False


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup() -> Generator[None, Any, Any]:
    with _phase():
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call() -> Generator[None, Any, Any]:
    with _phase():
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown() -> Generator[None, Any, Any]:
    with _phase():
        return (yield)


@pytest.hookimpl(tryfirst=True, optionalhook=True)
def pytest_timeout_set_timer(item: Any, settings: Any) -> bool | None:
    """As pytest-timeout does by ``signal``, but for what its handler does between two phases."""
    if settings.method != "signal" or threading.current_thread() is not threading.main_thread():
        return None

    def over(_signal: int, _frame: object) -> None:
        __tracebackhide__ = True
        if _in_phase:
            pytest_timeout.timeout_sigalrm(item, settings)
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)

    last = [_Death(end, settings.timeout * count) for count, end in ((LIMITS, signal.SIGABRT), (LIMITS + 1, signal.SIGKILL))]

    def cancel() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        for death in last:
            death.put_off()

    item.cancel_timeout = cancel
    signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, settings.timeout)
    if is_worker(item.config):
        for death in last:
            death.set()
    return True


def is_worker(config: pytest.Config) -> bool:
    """Whether this process runs tests for another one, which starts a new worker when this one ends."""
    return hasattr(config, "workerinput")


class _Death:
    """A timer of the kernel that ends this process by a signal, whatever it does. It needs no thread, which tests would meet."""

    def __init__(self, end: signal.Signals, after_s: float) -> None:
        self._end = end
        self._after_s = after_s
        self._timer: ctypes.c_void_p | None = None

    def set(self) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        event = struct.pack("<qii", 0, self._end, SIGEV_SIGNAL).ljust(SIGEV_SIZE, b"\0")
        made = ctypes.c_void_p()
        if libc.timer_create(1, event, ctypes.byref(made)):  # CLOCK_MONOTONIC
            return
        self._timer = made
        seconds = int(self._after_s) + 1
        libc.timer_settime(made, 0, struct.pack("<4q", seconds, 0, seconds, 0), None)

    def put_off(self) -> None:
        if self._timer is not None:
            ctypes.CDLL(None).timer_delete(self._timer)
            self._timer = None


# --- An internal error of a worker -----------------------------------------------------------------------------------


@pytest.hookimpl(tryfirst=True)
def pytest_internalerror(excrepr: object) -> None:
    """End a worker with the test in which its error came; pytest-xdist would end the run."""
    for config in _workers:
        capturing = config.pluginmanager.getplugin("capturemanager")
        if capturing is not None:
            capturing.suspend_global_capture(in_=True)
        os.write(2, f"internal error of a worker: {excrepr}\n".encode())
        os._exit(CRASHED)


_workers: Final[list[pytest.Config]] = []


def pytest_configure(config: pytest.Config) -> None:
    """Remember whether this process is a worker: an internal error does not say."""
    if is_worker(config):
        _workers.append(config)
