"""How late a loop turns that sleeps until an instant: by the agent's timer, and by the timeouts that are there without it."""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from agent.system import clock, timers
from benchmarks.figures import OURS, Figure, Findings

PERIOD_NS: Final = 10_300_000
"""Of no whole number of milliseconds, as the deadlines of the rules."""
TURNS: Final = 2_000
QUICK_TURNS: Final = 300


def lateness(quick: bool, directory: Path) -> Findings:
    """Each way in turns of its own, at the priority of this process."""
    turns = QUICK_TURNS if quick else TURNS
    case = f"a turn each {PERIOD_NS / 1e6:g} ms"
    poll, alarm = select.epoll(), timers.Alarm()
    poll.register(alarm.fileno(), select.EPOLLIN)

    def by_alarm(at_ns: int) -> None:
        alarm.set(at_ns)
        poll.poll(1.0)

    def by_timeout(at_ns: int) -> None:
        alarm.set(None)
        poll.poll(max(at_ns - clock.now_ns(), 0) / 1e9)

    def by_sleep(at_ns: int) -> None:
        time.sleep(max(at_ns - clock.now_ns(), 0) / 1e9)

    ways = {OURS: by_alarm, "a timeout of epoll": by_timeout, "clock_nanosleep": by_sleep}
    figures = tuple(Figure("lateness of a turn", case, "ms", _late(way, turns), who) for who, way in ways.items())
    alarm.close()
    poll.close()
    return Findings(
        "Lateness of the main loop",
        "A loop that does nothing but sleep until an instant, at ordinary priority: how much later it turns. The main loop "
        "sleeps by a timerfd in its epoll. A timeout of epoll_wait(2) is a whole number of milliseconds, rounded up.",
        figures,
    )


def _late(sleep: Callable[[int], None], turns: int) -> tuple[float, ...]:
    """Milliseconds, turn by turn."""
    found: list[float] = []
    at_ns = clock.now_ns()
    for _ in range(turns):
        at_ns += PERIOD_NS
        sleep(at_ns)
        found.append((clock.now_ns() - at_ns) / 1e6)
    return tuple(found)
