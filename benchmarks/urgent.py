"""How soon an urgent put of one robot is seen at another, beside a bare UDP datagram between the same two places.

Programs of their own put, send, watch and receive. They have real-time priority, below the main loops', where this user may: what
else runs on the machine is not to be measured.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from msgspec import Struct

from benchmarks.running import PATIENCE_S, POLL_S, BenchmarkError

SIZE: Final = 379
"""Bytes: the mean frame of a robot of CAMBADA's team."""

ITEM: Final = f'[board.items.alarm]\ntype = "bytes"\nsize = {SIZE}\nperiod = 60000\nurgent = true\n'

GAP_S: Final = (0.11, 0.17)
"""Between two urgent puts: an item may have ten frames a second, and no put meets the rounds always in the same place."""

PRIORITY: Final = 40
SEEN_SHARE: Final = 0.9
"""Of the puts: one that finds its item's bucket empty waits for its round."""

_BEGIN: Final = f"""
import contextlib, ipaddress, os, random, socket, sys, time
from failover.boards.board import board
with contextlib.suppress(OSError):
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))
def now_ns():
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
"""

PUTS: Final = f"""{_BEGIN}
place, mine, theirs, port, count = sys.argv[1:]
if ipaddress.ip_address(theirs).is_multicast:
    link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(mine))
with board(place) as here:
    item, rest = here.item("alarm", bytes), bytes({SIZE} - 8)
    for _ in range(int(count)):
        time.sleep(random.uniform{GAP_S} / 2)
        item.put(now_ns().to_bytes(8, "little") + rest)
        time.sleep(random.uniform{GAP_S} / 2)
        link.sendto(now_ns().to_bytes(8, "little") + rest, (theirs, int(port)))
"""

WATCHES: Final = f"""{_BEGIN}
with board(sys.argv[1]) as here:
    item, last = here.item("alarm", bytes), 0
    print("ready", flush=True)
    while True:
        try:
            reading = item.wait("robot1", after=last, timeout=60)
        except Exception:
            continue
        came_ns, last = now_ns(), reading.number
        print(came_ns - int.from_bytes(reading.value[:8], "little"), flush=True)
"""

RECEIVES: Final = f"""{_BEGIN}
mine, theirs, port = sys.argv[1:]
if ipaddress.ip_address(theirs).is_multicast:
    link.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(theirs) + socket.inet_aton(mine))
link.bind((theirs, int(port)))
print("ready", flush=True)
while True:
    content = link.recv(2048)
    print(now_ns() - int.from_bytes(content[:8], "little"), flush=True)
"""


class End(Struct, frozen=True):
    """One of the two robots.

    Attributes:
        board: its directory.
        address: IPv4.
        inside: a command that runs another one in its network namespace.
    """

    board: Path
    address: str
    inside: tuple[str, ...] = ()


def measured(first: End, second: End, to: tuple[str, int], count: int, directory: Path) -> tuple[list[float], list[float]]:
    """From a put at robot1 until a program that waits at robot2 has it, µs; from a datagram's send until it is received.

    Args:
        to: host and port of the datagrams: a group, or the second's address.

    Raises:
        BenchmarkError: puts or datagrams did not come.
    """
    host, port = to[0], str(to[1])
    with (
        _listening(WATCHES, second, [str(second.board)], directory / "seen") as seen,
        _listening(RECEIVES, second, [second.address, host, port], directory / "received") as received,
    ):
        puts = [str(first.board), first.address, host, port, str(count)]
        subprocess.run([*first.inside, sys.executable, "-c", PUTS, *puts], check=True)
        _until(lambda: len(_rows(received)) >= SEEN_SHARE * count, "datagrams")
        _until(lambda: len(_rows(seen)) >= SEEN_SHARE * count, "urgent puts")
        return _rows(seen), _rows(received)


@contextmanager
def _listening(program: str, where: End, arguments: Sequence[str], output: Path) -> Iterator[Path]:
    with output.open("wb") as file:
        command = [*where.inside, sys.executable, "-c", program, *arguments]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, start_new_session=True)
    try:
        _until(lambda: output.stat().st_size > 0 or process.poll() is not None, "a program that watches")
        yield output
    finally:
        process.kill()
        process.wait()


def _rows(output: Path) -> list[float]:
    whole, _, _ = output.read_text().rpartition("\n")
    return [int(line) / 1000 for line in whole.splitlines()[1:]]


def _until(holds: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        if time.monotonic() > deadline:
            raise BenchmarkError(f"waited {PATIENCE_S:.0f} s for {what}")
        time.sleep(POLL_S * 10)
