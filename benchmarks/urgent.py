"""How soon an urgent put of one robot is seen at another, beside other ways between the same two places.

Beside it: a bare UDP datagram; a bare datagram by way of two processes that only pass it on, as a put goes by way of two main
loops; and zenoh by way of its router, where it is installed. Programs of their own put, send, watch and receive. They have
real-time priority, below the main loops', where this user may: what else runs on the machine is not to be measured.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
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
def session(mode, way, address):
    import json, zenoh
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{{way}}/endpoints", json.dumps([address]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)
"""

PUTS: Final = f"""{_BEGIN}
board_place, mine, direct_host, direct, relayed, router, count = sys.argv[1:]
if ipaddress.ip_address(direct_host).is_multicast:
    link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(mine))
def send(port, host):
    return lambda content: link.sendto(content, (host, int(port)))
with board(board_place) as here:
    ways = [here.item("alarm", bytes).put, send(direct, direct_host), send(relayed, mine)]
    if router:
        link_to_router = session("client", "connect", router)
        publisher = link_to_router.declare_publisher("alarm")
        ways.append(publisher.put)
        deadline = time.monotonic() + {PATIENCE_S}
        while not publisher.matching_status.matching:
            if time.monotonic() > deadline:
                sys.exit("zenoh's publisher did not find its subscriber")
            time.sleep(0.01)
    for _ in range(int(count)):
        for way in ways:
            time.sleep(random.uniform{GAP_S} / len(ways))
            way(now_ns().to_bytes(8, "little") + bytes({SIZE} - 8))
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


RELAYS: Final = f"""{_BEGIN}
mine, port, theirs, next_port = sys.argv[1:]
link.bind((mine, int(port)))
print("ready", flush=True)
while True:
    link.sendto(link.recv(2048), (theirs, int(next_port)))
"""

ROUTES: Final = f"""{_BEGIN}
router = session("router", "listen", sys.argv[1])
print("ready", flush=True)
time.sleep(3600)
"""

SUBSCRIBES: Final = f"""{_BEGIN}
def came(sample):
    print(now_ns() - int.from_bytes(sample.payload.to_bytes()[:8], "little"), flush=True)
here = session("client", "connect", sys.argv[1])
subscriber = here.declare_subscriber("alarm", came)
print("ready", flush=True)
time.sleep(3600)
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


class Seen(Struct, frozen=True):
    """From a put or send until a program at the other robot has it, µs. ``zenoh`` is empty where it is not installed."""

    put: list[float]
    datagram: list[float]
    relayed: list[float]
    zenoh: list[float]


def measured(first: End, second: End, group: str, ports: Sequence[int], count: int, directory: Path) -> Seen:
    """Puts and sends at robot1, each by itself, one way after the other.

    Args:
        group: host of the bare datagrams: a multicast group, or the second's address.
        ports: five that are free at both.

    Raises:
        BenchmarkError: puts or datagrams did not come.
    """
    direct, arrival, relay, far_relay, router = map(str, ports)
    address = f"tcp/{first.address}:{router}" if importlib.util.find_spec("zenoh") is not None else ""

    with ExitStack() as stack:

        def start(program: str, where: End, *arguments: str, name: str) -> Path:
            return stack.enter_context(_listening(program, where, arguments, directory / name))

        outputs = {
            "put": start(WATCHES, second, str(second.board), name="seen"),
            "datagram": start(RECEIVES, second, second.address, group, direct, name="received"),
            "relayed": start(RECEIVES, second, second.address, second.address, arrival, name="relayed"),
        }
        start(RELAYS, first, first.address, relay, second.address, far_relay, name="relay")
        start(RELAYS, second, second.address, far_relay, second.address, arrival, name="far relay")
        if address:
            start(ROUTES, first, address, name="router")
            outputs["zenoh"] = start(SUBSCRIBES, second, address, name="subscribed")
        puts = [str(first.board), first.address, group, direct, relay, address, str(count)]
        subprocess.run([*first.inside, sys.executable, "-c", PUTS, *puts], check=True)
        for way, output in outputs.items():
            _until(partial(_has_rows, output, SEEN_SHARE * count), f"what was sent to be seen ({way})")
        return Seen(**{"zenoh": [], **{way: _rows(output) for way, output in outputs.items()}})


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


def _has_rows(output: Path, count: float) -> bool:
    return len(_rows(output)) >= count


def _until(holds: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        if time.monotonic() > deadline:
            raise BenchmarkError(f"waited {PATIENCE_S:.0f} s for {what}")
        time.sleep(POLL_S * 10)
