"""A driver's call and its answer beside ZeroMQ's REQ/REP with JSON, and zenoh's queryable where it is installed, on one robot.

Each has a server in a process of its own.

Both say the same: set a duty cycle of 0.42, get an answer. Batches of all ways follow one another, so that a busy minute of the
machine hits all of them. Ours looks the verb up, checks the argument, keeps the order of each sender, notes each hop, and would
send again; the others do none of that.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import zmq

from benchmarks.figures import OURS, Figure, Findings
from benchmarks.running import PATIENCE_S, BenchmarkError
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy

CALLS: Final = 4_000
QUICK_CALLS: Final = 1_000
BATCH: Final = 50
ZEROMQ: Final = "ZeroMQ REQ/REP, JSON"

DRIVER: Final = """
import failover

@failover.driver("Benchmark/PWM", alias="engine")
class Pwm:
    duty = 0.0

    @failover.command
    def set(self, duty: float) -> None:
        self.duty = duty

failover.run(Pwm)
"""

REPLIER: Final = """
import json, sys, zmq

socket = zmq.Context().socket(zmq.REP)
socket.bind("ipc://" + sys.argv[1])
duty = 0.0
while True:
    message = json.loads(socket.recv())
    if message["verb"] == "set":
        duty = message["body"]["duty"]
    socket.send(json.dumps({"re": message["id"], "ok": None}).encode())
"""

ZENOH: Final = "zenoh queryable, JSON"

QUERYABLE: Final = """
import json, pathlib, sys, time, zenoh

duty = 0.0
config = zenoh.Config()
config.insert_json5("listen/endpoints", json.dumps(["unixsock-stream/" + sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")

def asked(query):
    global duty
    message = json.loads(query.payload.to_bytes())
    if message["verb"] == "set":
        duty = message["body"]["duty"]
    query.reply(query.key_expr, json.dumps({"re": message["id"], "ok": None}))

session = zenoh.open(config)
queryable = session.declare_queryable("engine", asked)
pathlib.Path(sys.argv[1] + ".ready").touch()
time.sleep(3600)
"""

MESSAGE: Final = {"to": "engine", "verb": "set", "body": {"duty": 0.42}, "id": "robot1-7f3a-1042"}


def driver_call(quick: bool, directory: Path) -> Findings:
    """One call and its answer, by each way."""
    with ExitStack() as stack:
        ways = {OURS: stack.enter_context(_ours(directory)), ZEROMQ: stack.enter_context(_zeromq(directory))}
        if importlib.util.find_spec("zenoh") is not None:
            ways[ZENOH] = stack.enter_context(_zenoh(directory))
        values = _measured(ways, QUICK_CALLS if quick else CALLS)
    return Findings(
        "A driver's call",
        "A command with one number and its answer, from one process to another by a unix socket, in Python; each call by itself. "
        "Ours is failover.proxy(…).call; beside it a bare REQ socket and a zenoh queryable, with the standard library's JSON.",
        tuple(Figure("call and answer", "one number", "µs", tuple(found), who) for who, found in values.items()),
    )


def _measured(ways: dict[str, Callable[[], object]], calls: int) -> dict[str, list[float]]:
    values: dict[str, list[float]] = {who: [] for who in ways}
    for call in ways.values():
        for _ in range(BATCH):
            call()
    for _ in range(calls // BATCH):
        for who, call in ways.items():
            for _ in range(BATCH):
                begun = time.perf_counter_ns()
                call()
                values[who].append((time.perf_counter_ns() - begun) / 1_000)
    return values


@contextmanager
def _ours(directory: Path) -> Iterator[Callable[[], object]]:
    place = directory / "drivers"
    place.mkdir(mode=0o700)
    environment = {**os.environ, "FAILOVER_DRIVERS": str(place), "FAILOVER_ROBOT": "robot1", "FAILOVER_TEAM": ""}
    with _server(DRIVER, "", environment, place / "Benchmark.PWM.names"):
        here = Here("robot1", place)
        with Proxy(here, lookup(here, "engine")) as proxy:
            yield lambda: proxy.call("set", duty=0.42)


@contextmanager
def _zeromq(directory: Path) -> Iterator[Callable[[], object]]:
    place = directory / "rep"
    with _server(REPLIER, str(place), dict(os.environ), place):
        context: zmq.Context[Any] = zmq.Context()
        socket = context.socket(zmq.REQ)
        socket.connect(f"ipc://{place}")

        def call() -> object:
            socket.send(json.dumps(MESSAGE).encode())
            return json.loads(socket.recv())["ok"]

        try:
            yield call
        finally:
            context.destroy(linger=0)


@contextmanager
def _zenoh(directory: Path) -> Iterator[Callable[[], object]]:
    zenoh = importlib.import_module("zenoh")
    place = directory / "zenoh"
    with _server(QUERYABLE, str(place), dict(os.environ), directory / "zenoh.ready"):
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps([f"unixsock-stream/{place}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        with zenoh.open(config) as session:
            querier = session.declare_querier("engine")

            def call() -> object:
                for reply in querier.get(payload=json.dumps(MESSAGE)):
                    return json.loads(reply.ok.payload.to_bytes())["ok"]
                raise BenchmarkError("zenoh's queryable did not answer")

            until = time.monotonic() + PATIENCE_S
            while not querier.matching_status.matching:
                if time.monotonic() > until:
                    raise BenchmarkError("zenoh did not find its queryable")
                time.sleep(0.01)
            yield call


@contextmanager
def _server(text: str, argument: str, environment: dict[str, str], sign: Path) -> Iterator[None]:
    """A program, from when the file ``sign`` is there."""
    command = [sys.executable, "-c", text, argument]
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as program:
        try:
            until = time.monotonic() + PATIENCE_S
            while not sign.exists():
                if program.poll() is not None or time.monotonic() > until:
                    raise BenchmarkError("a server of the benchmark did not start")
                time.sleep(0.01)
            yield
        finally:
            program.kill()
