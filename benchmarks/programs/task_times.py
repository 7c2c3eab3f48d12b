"""How late an activation begins: TASK PERIOD_NS COUNT [EARLY_S], or "-" for a bare clock_nanosleep. A line an activation: ns.

The last line, after "#": nanoseconds of a processor that an activation took.
"""

import ctypes
import sys
import time

import failover

CLOCK_MONOTONIC, TIMER_ABSTIME, PR_SET_TIMERSLACK = 1, 1, 29


class Timespec(ctypes.Structure):
    """As clock_nanosleep(2) takes it."""

    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def bare(period_ns: int, count: int) -> tuple[list[int], int]:
    """A loop with nothing in it but the call and the clock; what a turn took of a processor."""
    libc = ctypes.CDLL(None)
    libc.prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    due, late = time.monotonic_ns() // period_ns * period_ns, []
    begin_ns = time.process_time_ns()
    for _ in range(count):
        due += period_ns
        limit = Timespec(*divmod(due, 1_000_000_000))
        libc.clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, ctypes.byref(limit), None)
        late.append(time.monotonic_ns() - due)
    return late, (time.process_time_ns() - begin_ns) // count


def scheduled(name: str, period_ns: int, count: int, early: float | None) -> tuple[list[int], int]:
    """Activations of a task, and what each took of a processor from the first one on."""
    late: list[int] = []
    begin_ns = 0
    with failover.scheduled(name, period=period_ns / 1e9, early=early) as task:
        for tick in task:
            late.append(time.monotonic_ns() - tick.due_ns)
            begin_ns = begin_ns or time.process_time_ns()
            if len(late) == count:
                return late, (time.process_time_ns() - begin_ns) // (count - 1)
    raise AssertionError


def main(name: str, period_ns: int, count: int, early: float | None = None) -> None:
    """Print the lateness of each."""
    late, took_ns = bare(period_ns, count) if name == "-" else scheduled(name, period_ns, count, early)
    print(*late, f"#{took_ns}", sep="\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *map(float, sys.argv[4:]))
