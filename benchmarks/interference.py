"""The cost of protection for the protected program, and of a large snapshot for the beats."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from benchmarks.figures import OURS, Absent, Figure, Findings
from benchmarks.running import BenchmarkError, Running, running
from failover.cli.demo.robots import Means as Allowed
from failover.cli.demo.robots import RobotMachine, Stage
from failover.config import team

NAME: Final = "/demo/robot1/measured"
RESIDENT_MB: Final = 100
DIRTY_KB: Final = (0, 400, 2000)
WINDOW_S: Final = 3.0
WARM_SNAPSHOTS: Final = 5
SETTLED_S: Final = 2.5
"""Afterwards: keepers that start, and a first snapshot on its way, come once in a program's life."""

SHIPPED_MB: Final = 500
QUIET_S: Final = 5.0
PATIENCE_S: Final = 90.0
POLL_S: Final = 0.02

UNPROTECTED: Final = "unprotected"
IDLE: Final = "nothing on its way"

ON_LOOPBACK: Final = Allowed(own_pids=False, own_network=False)
"""The measured program is started by us, so the robots must see our processes."""
NO_COPY: Final = f'[components."{NAME}"]\nready_copy = false\n'
"""Where robots share PIDs the program's own is not free for a copy, which would be begun again and again."""


def throughput(quick: bool, directory: Path) -> Findings:
    """The same process, protected and released in turns: the steps that it does in a second."""
    figures: list[Figure] = []
    for dirty_kb in DIRTY_KB[1:2] if quick else DIRTY_KB:
        place = directory / f"throughput-{dirty_kb}"
        with (
            Stage(place, ON_LOOPBACK, NO_COPY) as stage,
            running("working", RESIDENT_MB, dirty_kb, directory=directory) as program,
        ):
            place.mkdir()
            stage.start()
            figures += _in_turns(stage, program, dirty_kb, 2 if quick else 3)
    return Findings(
        "What protection costs the program",
        f"A Python program with {RESIDENT_MB} MB resident that calculates without a pause, on a machine that plays both robots "
        "(both agents, guard, keeper, the standby's store; no ready copy). It is protected (ten snapshots a second) and released "
        f"in turns, {WINDOW_S:g} s each, when what comes at the beginning only is over. The last column is the "
        "speed-up of being unprotected.",
        tuple(figures),
    )


def _in_turns(stage: Stage, program: Running, dirty_kb: int, turns: int) -> list[Figure]:
    primary = stage.robots[0]
    protected: list[float] = []
    released: list[float] = []
    for _ in range(turns):
        released.append(rate(program))
        with primary.control() as link:
            link.ask("protect", pid=program.pid, name=NAME)
        until_protected(primary)
        protected.append(rate(program))
        with primary.control() as link:
            link.ask("release", name=NAME)
    case = f"{dirty_kb} KB written each 50 ms"
    return [
        Figure("work done a second", case, "steps", tuple(protected)),
        Figure("work done a second", case, "steps", tuple(released), UNPROTECTED),
    ]


def rate(program: Running) -> float:
    """Steps a second over the next `WINDOW_S`."""
    began = time.monotonic_ns()
    time.sleep(WINDOW_S)
    found = [record for record in program.records_until(time.monotonic_ns()) if record[0] > began]
    (first, before), (last, after) = found[0], found[-1]
    return (after - before) / ((last - first) / 1e9)


def until_protected(robot: RobotMachine) -> None:
    """Wait until the first snapshots have been acknowledged, which are whole ones, and all is as it will stay."""
    until(robot, lambda one: one["protection"] == "protected" and one["snapshots"] >= WARM_SNAPSHOTS)
    time.sleep(SETTLED_S)


def until(robot: RobotMachine, condition: Any) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if any(condition(one) for one in robot.status()["components"] if one["name"] == NAME):
            return
        time.sleep(POLL_S)
    raise BenchmarkError(f"{NAME} was not protected in {PATIENCE_S:.0f} s: {robot.last_words()}")


# --- Beats -----------------------------------------------------------------------------------------------------------------


def beats(quick: bool, directory: Path) -> Findings:
    """The times between two beats of the shipping robot as they arrive, before and while a large snapshot is shipped."""
    megabytes = 100 if quick else SHIPPED_MB
    title = f"Beats while {megabytes} MB are shipped"
    story = (
        f"A program with {megabytes} MB that do not compress is put under protection: its first snapshot is shipped whole, "
        "encrypted, over the loopback. The beats of the robot that ships it are taken from the wire with the kernel's own time "
        "stamps; their period is 20 ms."
    )
    try:
        listener = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP)
    except PermissionError:
        return Findings(title, story, (), (Absent(OURS, "counting datagrams on the wire needs root (a raw socket)"),))
    place = directory / "beats"
    with listener, Stage(place, ON_LOOPBACK) as stage, running("working", megabytes, 0, directory=directory) as program:
        place.mkdir()
        stage.start()
        with arrivals(listener, _beat_port(stage)) as instants:
            time.sleep(2.0 if quick else QUIET_S)
            shipping = time.time()
            with stage.robots[0].control() as link:
                link.ask("protect", pid=program.pid, name=NAME)
            until(stage.robots[1], lambda one: (one["snapshots"] or 0) >= 1)
            ended = time.time()
    figures = [
        Figure("between two beats", f"{megabytes} MB on their way", "ms", gaps(instants, shipping, ended)),
        Figure("between two beats", f"{megabytes} MB on their way", "ms", gaps(instants, 0.0, shipping), IDLE),
        Figure("until the standby has it all", f"{megabytes} MB", "s", (ended - shipping,)),
    ]
    return Findings(title, story, tuple(figures))


def _beat_port(stage: Stage) -> int:
    """Where the standby hears beats."""
    members = team.read(stage.directory / "robot2" / "team")
    return team.split_address(members.robots["robot2"].beats[0], "team")[1]


def gaps(instants: list[float], began: float, ended: float) -> tuple[float, ...]:
    """Milliseconds between neighbours of those instants (s) that lie in a span."""
    inside = [instant for instant in instants if began <= instant <= ended]
    return tuple((after - before) * 1000 for before, after in pairwise(inside))


SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h
TIMESPEC: Final = struct.Struct("@qq")


@contextmanager
def arrivals(listener: socket.socket, port: int) -> Iterator[list[float]]:
    """The instants (s since 1970, by the kernel) at which datagrams for a port arrived; the list grows during the body."""
    found: list[float] = []
    over = threading.Event()
    listener.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    listener.settimeout(POLL_S)
    thread = threading.Thread(target=_listen, args=(listener, port, found, over), name="arrivals")
    thread.start()
    try:
        yield found
    finally:
        over.set()
        thread.join()


def _listen(listener: socket.socket, port: int, found: list[float], over: threading.Event) -> None:
    while not over.is_set():
        try:
            packet, ancillary, _, _ = listener.recvmsg(128, 64)
        except TimeoutError:
            continue
        header = (packet[0] & 0x0F) * 4
        if int.from_bytes(packet[header + 2 : header + 4], "big") == port:
            seconds, nanoseconds = TIMESPEC.unpack_from(ancillary[0][2])
            found.append(seconds + nanoseconds / 1e9)
