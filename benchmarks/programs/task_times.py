"""How late an activation begins: TASK PERIOD_NS COUNT [EARLY_S], or "-" for a bare clock_nanosleep. A line an activation: ns."""

import ctypes
import sys
import time

import failover

CLOCK_MONOTONIC, TIMER_ABSTIME, PR_SET_TIMERSLACK = 1, 1, 29


class Timespec(ctypes.Structure):
    """As clock_nanosleep(2) takes it."""

    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def bare(period_ns: int, count: int) -> list[int]:
    """A loop with nothing in it but the call and the clock."""
    libc = ctypes.CDLL(None)
    libc.prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    due, late = time.monotonic_ns() // period_ns * period_ns, []
    for _ in range(count):
        due += period_ns
        limit = Timespec(*divmod(due, 1_000_000_000))
        libc.clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, ctypes.byref(limit), None)
        late.append(time.monotonic_ns() - due)
    return late


def scheduled(name: str, period_ns: int, count: int, early: float) -> list[int]:
    """Activations of a task."""
    late = []
    with failover.scheduled(name, period=period_ns / 1e9, early=early) as task:
        for tick in task:
            late.append(time.monotonic_ns() - tick.due_ns)
            if len(late) == count:
                return late
    raise AssertionError


def main(name: str, period_ns: int, count: int, early: float = 0) -> None:
    """Print the lateness of each."""
    for late_ns in bare(period_ns, count) if name == "-" else scheduled(name, period_ns, count, early):
        print(late_ns)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *map(float, sys.argv[4:]))
