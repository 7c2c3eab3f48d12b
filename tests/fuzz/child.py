"""Tries the cases of one target, in a process of its own whose memory and time are limited.

The kernel keeps the limits: a case that takes more memory gets a MemoryError, and one that takes more processor time, or hangs,
ends the process by a signal. The case stands in memory that the parent process shares, so that it can tell which one it was.
"""

from __future__ import annotations

import ctypes
import logging
import mmap
import os
import resource
import signal
import struct
import time
import traceback
from random import Random
from typing import Final

import msgspec
from msgspec import Struct

from tests.fuzz.mutation import SIZE_MAX, mutated
from tests.fuzz.reached import ROOT, Reached
from tests.fuzz.target import Decoder, Target

MEMORY_MAX: Final = 256 << 20
"""Bytes that a case may make the process larger by."""
CASE_CPU_S: Final = 2.0
TRACED_CPU_S: Final = 20.0
"""Processor time of a case; where lines are followed it takes about ten times as much."""
HANG_S: Final = 120.0
"""Of real time: it waits for something. Long, for the machine may be busy."""
CORPUS_MAX: Final = 400
FINDINGS_MAX: Final = 20
"""Of one target, each from another place; then its run ends."""

PR_SET_PDEATHSIG: Final = 1
"""Of prctl(2): die with the process that waits for us."""

_HEAD: Final = struct.Struct("<QQ")
SHARED_SIZE: Final = _HEAD.size + SIZE_MAX


class Plan(Struct, frozen=True):
    """Which cases to try.

    Attributes:
        first, count: numbers of cases; ``count`` 0: no limit.
        until: when to end, by the monotonic clock; 0: never.
        follows: whether it keeps cases that reach new lines.
    """

    seed: int
    first: int = 0
    count: int = 0
    until: float = 0
    follows: bool = False


class Finding(Struct, frozen=True):
    """A case with a wrong outcome. ``number``: -1 for a seed that was refused. ``place``: where two findings are one."""

    number: int
    content: bytes
    what: str
    place: str
    trace: str = ""


class Report(Struct, frozen=True):
    """What a run found. ``kept``: cases beyond the seeds that reached new lines."""

    cases: int
    refused: int
    lines: int
    kept: int
    slowest_s: float
    findings: tuple[Finding, ...]


class Shared:
    """The case that is being tried, as both processes see it."""

    def __init__(self) -> None:
        self._area = mmap.mmap(-1, SHARED_SIZE)

    def put(self, number: int, content: bytes) -> None:
        """Before it is tried."""
        self._area[_HEAD.size : _HEAD.size + len(content)] = content
        self._area[: _HEAD.size] = _HEAD.pack(number, len(content))

    def take(self) -> tuple[int, bytes]:
        """Number and content."""
        number, size = _HEAD.unpack(self._area[: _HEAD.size])
        return number, self._area[_HEAD.size : _HEAD.size + size]

    def close(self) -> None:
        """Let it go."""
        self._area.close()


def case(target: Target, plan: Plan, number: int, corpus: list[bytes]) -> bytes:
    """The case of that number: the same for the same seed and corpus."""
    dice = Random(f"{plan.seed} {target.name} {number}")
    return mutated(dice.choice(corpus), dice, target.form, corpus)


def run(target: Target, plan: Plan, shared: Shared) -> Report:
    """Try the cases. Call this in a process that has nothing else to do: its limits stay."""
    logging.disable()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    decoder = target.made()
    corpus, cases, refused, kept = list(decoder.seeds), 0, 0, 0
    slowest_s, reached = 0.0, Reached()
    found: dict[str, Finding] = {}
    for content in decoder.seeds:
        reached.call(decoder.call, content) if plan.follows else decoder.call(content)
    _limit_memory()
    limit_s = TRACED_CPU_S if plan.follows else CASE_CPU_S
    number = plan.first
    while not (plan.count and cases >= plan.count) and not (plan.until and time.monotonic() > plan.until):
        content = case(target, plan, number, corpus)
        shared.put(number, content)
        began_s, lines = time.thread_time(), reached.count
        try:
            _limit_time(limit_s)
            if plan.follows:
                reached.call(decoder.call, content)
            else:
                decoder.call(content)
        except decoder.refusals as error:
            refused += 1
            if not str(error).strip():
                _note(found, number, content, error)
        except Exception as error:  # noqa: BLE001  # what it is, is the finding
            _note(found, number, content, error)
        finally:
            _limit_time(0)
        slowest_s = max(slowest_s, time.thread_time() - began_s)
        if reached.count > lines and len(corpus) < CORPUS_MAX:
            corpus.append(content)
            kept += 1
        cases, number = cases + 1, number + 1
        if len(found) >= FINDINGS_MAX:
            break
    return Report(cases, refused, reached.count, kept, slowest_s, tuple(found.values()))


def outcome(decoder: Decoder, content: bytes) -> str:
    """What the decoder does with one content, in words; an exception that is no refusal passes through."""
    try:
        return f"taken: {decoder.call(content)!r:.500}"
    except decoder.refusals as error:
        return f"refused: {error}"


def limit() -> None:
    """The limits of one case, for the rest of this process."""
    _limit_memory()
    _limit_time(CASE_CPU_S)


def _limit_memory() -> None:
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[0])
    most = pages * mmap.PAGESIZE + MEMORY_MAX
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)


def _limit_time(cpu_s: float) -> None:
    signal.setitimer(signal.ITIMER_PROF, cpu_s)
    signal.setitimer(signal.ITIMER_REAL, HANG_S if cpu_s else 0)


def _note(found: dict[str, Finding], number: int, content: bytes, error: Exception) -> None:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if frame.filename.startswith(f"{ROOT}/") and "/tests/" not in frame.filename] or frames
    place = f"{type(error).__name__} at {os.path.relpath(ours[-1].filename, ROOT)}:{ours[-1].lineno}"
    if place not in found:
        trace = "".join(traceback.format_exception(error, limit=-12))[-6_000:]
        found[place] = Finding(number, content, f"{place}: {error!s:.300}", place, trace)


def packed(report: Report) -> bytes:
    """A report as it goes to the parent process."""
    return msgspec.msgpack.encode(report)


def unpacked(content: bytes) -> Report:
    """It, there."""
    return msgspec.msgpack.decode(content, type=Report)
