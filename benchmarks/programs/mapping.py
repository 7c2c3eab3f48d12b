"""A robot's map and points, a part of which changes: they compress as such a state does.

``python3 mapping.py MEGABYTES CHANGED_KILOBYTES PIECES PERIOD_MS``: three fifths are cells of a map, which are alike over some
length; two fifths are coordinates of points, whose last digits are noise. Prints "ready". Then it writes so many kilobytes anew,
in PIECES places of whole pages, each PERIOD_MS; with a period of 0 at each SIGUSR1, and says "changed" then.
"""

import random
import signal
import sys
import time
from array import array
from itertools import accumulate

PAGE = 4096
POOL_MB = 8
CELLS_LONG = 60
POINT_STEP = 0.05


def cells(size: int) -> bytes:
    """Of a map: free, unknown or occupied for some length, each with a certainty of its own."""
    runs = bytearray()
    while len(runs) < size:
        runs += bytes((random.randrange(256),)) * random.randrange(1, CELLS_LONG)
    return bytes(runs[:size])


def points(size: int) -> bytes:
    """Coordinates of a surface as a sensor sees it: each near the one before, as 8 bytes."""
    return array("d", accumulate(random.uniform(-POINT_STEP, POINT_STEP) for _ in range(size // 8))).tobytes()


def state(size: int) -> bytearray:
    """Cells first, then points."""
    return bytearray(cells(size * 3 // 5 // PAGE * PAGE) + points(size * 2 // 5 // PAGE * PAGE))


signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
random.seed(7)
held = state(int(sys.argv[1]) * 1_000_000)
fresh = state(POOL_MB * 1_000_000)
there, taken = memoryview(held), memoryview(fresh)  # copied without a third place
changed, pieces, period_s = int(sys.argv[2]) * 1000, int(sys.argv[3]), int(sys.argv[4]) / 1000
size = max(changed // pieces // PAGE, 1) * PAGE
stride = len(held) // pieces // PAGE * PAGE
print("ready", flush=True)
while True:
    if period_s:
        time.sleep(period_s)
    else:
        signal.sigwait({signal.SIGUSR1})
    at = random.randrange(0, max(stride - size, 1), PAGE)
    for piece in range(pieces):
        begin = piece * stride + at
        kind = 0 if begin < len(held) * 3 // 5 else len(fresh) * 3 // 5
        source = kind + random.randrange(0, len(fresh) // 3, 8)
        there[begin : begin + size] = taken[source : source + size]
    if not period_s:
        print("changed", flush=True)
