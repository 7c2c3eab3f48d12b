"""A control loop with memory: SIZE_MB PERIOD_NS COUNT. It counts from the end of its input on; tells misses and lateness (ns)."""

import select
import sys
import time

import failover

PAGE, PAGES = 4096, 200
SETTLED = 20
"""Activations after its input has ended, before it counts."""


def main(size_mb: int, period_ns: int, count: int) -> None:
    """Print the missed deadlines, and the lateness of each activation, ns."""
    state = bytearray(size_mb << 20)
    for place in range(0, len(state), PAGE):
        state[place] = 1
    late: list[int] = []
    skipped, place, missed_before = 0, 0, 0
    with failover.scheduled("loop", period=period_ns / 1e9) as task:
        print("runs", flush=True)
        for tick in task:
            late_ns = time.monotonic_ns() - tick.due_ns
            for _ in range(PAGES):
                place = (place + 7919 * PAGE) % len(state)
                state[place] = tick.number & 0xFF
            if skipped < SETTLED:
                skipped += bool(select.select([sys.stdin], [], [], 0)[0])
                missed_before = task.live.counts.misses
                continue
            late.append(late_ns)
            if len(late) == count:
                break
        print(task.live.counts.misses - missed_before, *late)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
