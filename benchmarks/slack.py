"""What ten snapshots a second cost a loop of 100 Hz with much memory: taken between two activations, and at any instant."""

from __future__ import annotations

import itertools
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from benchmarks.figures import OURS, Figure, Findings, percentile
from benchmarks.running import BenchmarkError
from benchmarks.task_times import PRIORITY, may_be_fifo
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Acknowledge, Capture, Channel, Failed, Protect, Slack
from failover.boards import directory

HERE: Final = Path(__file__).parent
SIZE_MB: Final = 100
PERIOD_NS: Final = 10_000_000
CAPTURE_S: Final = 0.1
LAG_NS: Final = 500_000_000
COUNT: Final = 1_000
ENDED_S: Final = 20.0
ROUNDS: Final = 3
"""The three take turns, so that load beside them hits all alike."""

UNPROTECTED: Final = "unprotected"
AT_ANY_INSTANT: Final = "snapshots at any instant"
LAGS: Final = {UNPROTECTED: -1, OURS: LAG_NS, AT_ANY_INSTANT: 0}
"""By name: how long a capture waits for its moment; less than 0: there is none."""


def slack(quick: bool, directory_: Path) -> Findings:
    """Lateness and missed deadlines of one loop, three times."""
    late: dict[str, list[float]] = {who: [] for who in LAGS}
    missed = dict.fromkeys(LAGS, 0)
    count, squeezed, captures = 300 if quick else COUNT, 0, 0
    before, priority = (["chrt", "-f", str(PRIORITY)], f"SCHED_FIFO {PRIORITY}") if may_be_fifo() else ([], "normal priority")
    for _ in range(1 if quick else ROUNDS):
        for who, lag_ns in LAGS.items():
            values, misses, captured = _measured(before, count, lag_ns)
            squeezed += sum(one.is_squeezed for one in captured)
            captures += len(captured)
            late[who] += values
            missed[who] += misses
    case = f"{PERIOD_NS // 1_000_000} ms, {SIZE_MB} MB, {priority}"
    figures = [
        Figure(f"lateness p{share * 100:g}", case, "µs", (percentile(values, share) / 1000,), who)
        for share in (0.5, 0.99)
        for who, values in late.items()
    ]
    figures.append(Figure("captures that found no slack", case, "of 100", (100 * squeezed / max(captures, 1),)))
    figures += [Figure("missed deadlines", case, "of 1,000", (1000 * missed[who] / len(late[who]),), who) for who in LAGS]
    return Findings(
        "Snapshots of a control loop",
        f"A Python task of {PERIOD_NS // 1_000_000} ms with {SIZE_MB} MB; in each activation it writes 200 pages. A keeper "
        f"captures it each {CAPTURE_S * 1000:g} ms. The base is made before the measurement begins.",
        tuple(figures),
    )


def _measured(before: list[str], count: int, lag_ns: int) -> tuple[list[float], int, list[Slack]]:
    """Lateness of each activation, ns; how many deadlines were missed; and how captures met the activations."""
    captured: list[Slack] = []
    environment = {
        **os.environ,
        directory.VARIABLE: f"/dev/shm/failover-benchmark{secrets.token_hex(4)}-robot1",
        "PYTHONPATH": str(HERE.parent),
    }
    command = [*before, sys.executable, str(HERE / "programs" / "control_loop.py"), str(SIZE_MB), str(PERIOD_NS), str(count)]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdin is not None and program.stdout is not None
        program.stdout.readline()
        if lag_ns < 0:
            program.stdin.close()
            told = program.stdout.read()
        else:
            with _keeper() as keeper:
                told = _captured_meanwhile(program, keeper, lag_ns, captured)
    if program.returncode != 0:
        raise BenchmarkError(f"slack: the loop ended with status {program.returncode}")
    misses, *values = map(int, told.split())
    return [float(value) for value in values], misses, captured


def _captured_meanwhile(program: subprocess.Popen[str], keeper: Channel[Any], lag_ns: int, captured: list[Slack]) -> str:
    assert program.stdin is not None and program.stdout is not None
    _ask(keeper, Protect(program.pid, "/benchmark/robot1/loop"))
    _ask(keeper, Capture(True, 1, 1))
    program.stdin.close()  # from here on it counts
    told: list[str] = []
    listening = threading.Thread(target=lambda stream: told.append(stream.read()), args=(program.stdout,))
    listening.start()
    for sequence in itertools.count(2):
        began = time.monotonic()
        if program.poll() is not None:
            break
        try:
            met = _ask(keeper, Capture(False, 1, sequence, lag_ns=lag_ns))
            captured += [met] if met is not None else []
        except BenchmarkError as error:
            try:
                program.wait(ENDED_S)  # it has ended meanwhile
            except subprocess.TimeoutExpired:
                raise error from None
        time.sleep(max(0.0, began + CAPTURE_S - time.monotonic()))
    listening.join()
    return "".join(told)


def _ask(keeper: Channel[Any], request: Any) -> Slack | None:
    keeper.send(request)
    reply, descriptors = keeper.receive()
    messages.close_all(descriptors)
    if isinstance(reply, Failed):
        raise BenchmarkError(f"slack: {reply.message}")
    if isinstance(reply, messages.Captured):
        keeper.send(Acknowledge(reply.position))
        return reply.slack
    return None


@contextmanager
def _keeper() -> Iterator[Channel[Any]]:
    ours, theirs = messages.pair()
    with theirs:
        command = [sys.executable, "-m", "checkpoint", "keeper", str(theirs.fileno()), "agent.slack_gate"]
        child = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, cwd=HERE.parent)
    channel: Channel[Any] = Channel(ours, messages.Reply)
    try:
        yield channel
    finally:
        channel.close()
        child.wait()
