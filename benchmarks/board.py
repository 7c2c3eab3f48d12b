"""The board's put and get beside bare shared memory, Redis on a unix socket and iceoryx2's blackboard; 379 bytes a value.

379 bytes is the mean frame of a robot of CAMBADA's team. All is Python in one process, by what each offers for that: an item's
handle; a slice of a mapped file, which protects from nothing; RESP on a socket; iceoryx2's own binding. Batches of all ways
follow one another, so that a busy minute of the machine hits all of them.
"""

from __future__ import annotations

import ctypes
import importlib.util
import mmap
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.figures import OURS, Absent, Figure, Findings
from benchmarks.running import PATIENCE_S, BenchmarkError
from failover.boards.board import board as open_board
from failover.core.board.items import Item

SIZE: Final = 379
VALUE: Final = bytes(range(256))[:SIZE].ljust(SIZE, b"x")
BATCH: Final = 100
BATCHES: Final = 2000
QUICK_BATCHES: Final = 300


@dataclass(frozen=True, slots=True)
class Way:
    """One way to hand a value from a writer to a reader."""

    who: str
    put: Callable[[Any], object]
    get: Callable[[], object]
    read: Callable[[], bytes]
    value: Any = VALUE


def board(quick: bool, directory: Path) -> Findings:
    """One put and one get, by each way there is here."""
    absent: list[Absent] = []
    with ExitStack() as stack:
        ways = [stack.enter_context(_ours(directory)), stack.enter_context(_bare(directory))]
        for who, why, way in (("Redis", _why_no_redis(), _redis), ("iceoryx2", _why_no_iceoryx2(), _iceoryx2)):
            if why:
                absent.append(Absent(who, why))
            else:
                ways.append(stack.enter_context(way(directory)))
        for one in ways:
            one.put(one.value)
            if one.read() != VALUE:
                raise BenchmarkError(f"{one.who} gives back another value than was put")
        figures = _measured(ways, QUICK_BATCHES if quick else BATCHES)
    return Findings(
        "The board",
        f"A put and a get of {SIZE} bytes from Python, the mean of {BATCH} calls each. Ours says the age too, and never mixes "
        "two puts; a bare slice of shared memory says no age and mixes them; Redis runs as a process of its own, asked over a "
        "unix socket by a bare socket; iceoryx2 by its own binding.",
        tuple(figures),
        tuple(absent),
    )


def _measured(ways: list[Way], batches: int) -> list[Figure]:
    values: dict[tuple[str, str], list[float]] = {}
    for _ in range(batches):
        for way in ways:
            put, get, value = way.put, way.get, way.value
            begun = time.perf_counter_ns()
            for _ in range(BATCH):
                put(value)
            between = time.perf_counter_ns()
            for _ in range(BATCH):
                get()
            ended = time.perf_counter_ns()
            values.setdefault(("put", way.who), []).append((between - begun) / BATCH / 1000)
            values.setdefault(("get", way.who), []).append((ended - between) / BATCH / 1000)
    return [Figure(name, f"{SIZE} bytes", "µs", tuple(found), who) for (name, who), found in sorted(values.items())]


@contextmanager
def _ours(directory: Path) -> Iterator[Way]:
    with open_board(directory / "board") as writing, open_board(directory / "board") as reading:
        put = writing.add(Item("value", size=SIZE)).put
        item = reading.item("value", bytes)
        put(VALUE)
        item.get()  # from now on the fast ones
        writer, get = writing.item("value", bytes), item.get
        writer.put(VALUE)
        fast = writer.put
        yield Way(OURS, fast, get, lambda: bytes(get().value))


@contextmanager
def _bare(directory: Path) -> Iterator[Way]:
    path = directory / "bare"
    path.write_bytes(bytes(4096))
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 4096) as writing, mmap.mmap(file.fileno(), 4096) as reading:

        def put(value: bytes) -> None:
            writing[0:SIZE] = value

        def get() -> bytes:
            return reading[0:SIZE]

        yield Way("bare shared memory", put, get, get)


def _why_no_redis() -> str:
    return "" if shutil.which("redis-server") else "not installed (Debian package redis-server)"


@contextmanager
def _redis(directory: Path) -> Iterator[Way]:
    place = directory / "redis.sock"
    command = ["redis-server", "--port", "0", "--unixsocket", str(place), "--save", "", "--appendonly", "no"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=directory) as server:
        try:
            link = _connected(place, server)
            question = b"*2\r\n$3\r\nGET\r\n$4\r\nball\r\n"
            head = len(b"$%d\r\n" % SIZE)
            answer_size = head + SIZE + 2

            def put(value: bytes) -> None:
                link.sendall(b"*3\r\n$3\r\nSET\r\n$4\r\nball\r\n$%d\r\n%s\r\n" % (len(value), value))
                if link.recv(16) != b"+OK\r\n":
                    raise BenchmarkError("redis-server refuses SET")

            def get() -> bytes:
                link.sendall(question)
                answer = link.recv(answer_size, socket.MSG_WAITALL)
                return answer[head : head + SIZE]

            yield Way("Redis", put, get, get)
            link.close()
        finally:
            server.terminate()


def _connected(place: Path, server: subprocess.Popen[bytes]) -> socket.socket:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end and server.poll() is None:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            link.connect(str(place))
        except OSError:
            link.close()
            time.sleep(0.01)
        else:
            return link
    raise BenchmarkError("redis-server does not listen")


def _why_no_iceoryx2() -> str:
    return "" if importlib.util.find_spec("iceoryx2") else "not installed (pip install iceoryx2; x86-64 only)"


@contextmanager
def _iceoryx2(directory: Path) -> Iterator[Way]:
    iox2: Any = importlib.import_module("iceoryx2")

    class Value(ctypes.Structure):
        _fields_ = (("content", ctypes.c_uint8 * SIZE),)

    iox2.set_log_level(iox2.LogLevel.Error)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
    key, value = ctypes.c_uint32(0), Value.from_buffer_copy(VALUE)
    name = iox2.ServiceName.new(f"failover-benchmark-{directory.name}")
    service = node.service_builder(name).blackboard_creator(ctypes.c_uint32).add(key, Value()).create()
    writer, reader = service.writer_builder().create(), service.reader_builder().create()
    put, get = writer.entry(key, Value), reader.entry(key, Value)
    yield Way("iceoryx2", put.update_with_copy, get.get, lambda: bytes(get.get().data), value)
