"""A driver's call and its answer beside ZeroMQ's REQ/REP with JSON, and zenoh's queryable where it is installed.

On one robot, and between two robots: as root in network namespaces of their own with a cable between them. Each way has a server
in a process of its own, and one process calls all of them.

All say the same: set a duty cycle of 0.42, get an answer. Batches of all ways follow one another, so that a busy minute of the
machine hits all of them. Ours looks the verb up, checks the argument, keeps the order of each sender, notes each hop, and would
send again; the others do none of that. Between robots ours is encrypted and authenticated by CURVE, so ZeroMQ is measured with
CURVE, too.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, get_args

import msgspec
import zmq
from msgspec import Struct

import failover
from benchmarks.figures import OURS, Absent, Figure, Findings
from benchmarks.running import PATIENCE_S, BenchmarkError
from failover.cli import key_pairs
from failover.cli.demo import robots
from failover.cli.demo.robots import RobotMachine
from failover.config import team
from failover.config.team import Robot, Team
from failover.core.messaging.envelope import Encoding, Envelope, Hop, decode, encode
from failover.drivers.here import DIRECTORY, ROBOT, TEAM

CALLS: Final = 4_000
QUICK_CALLS: Final = 1_000
BATCH: Final = 50
ROOT: Final = Path(__file__).parents[1]

ZEROMQ: Final = "ZeroMQ REQ/REP, JSON"
CURVE: Final = "ZeroMQ REQ/REP, JSON, CURVE"
ZENOH: Final = "zenoh queryable, JSON"

ONE_ROBOT: Final = "one robot, a unix socket"
TWO_ROBOTS: Final = "two robots"

PORT: Final = 7_430
"""The first port of the servers; those of drivers are above 7420."""

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
import json, pathlib, sys, zmq

address, secret, sign = sys.argv[1:]
socket = zmq.Context().socket(zmq.REP)
if secret:
    socket.curve_server, socket.curve_secretkey = True, secret.encode()
socket.bind(address)
pathlib.Path(sign).touch()
duty = 0.0
while True:
    message = json.loads(socket.recv())
    if message["verb"] == "set":
        duty = message["body"]["duty"]
    socket.send(json.dumps({"re": message["id"], "ok": None}).encode())
"""

QUERYABLE: Final = """
import json, pathlib, sys, time, zenoh

address, sign = sys.argv[1:]
duty = 0.0
config = zenoh.Config()
config.insert_json5("listen/endpoints", json.dumps([address]))
config.insert_json5("scouting/multicast/enabled", "false")

def asked(query):
    global duty
    message = json.loads(query.payload.to_bytes())
    if message["verb"] == "set":
        duty = message["body"]["duty"]
    query.reply(query.key_expr, json.dumps({"re": message["id"], "ok": None}))

session = zenoh.open(config)
queryable = session.declare_queryable("engine", asked)
pathlib.Path(sign).touch()
time.sleep(3600)
"""

MESSAGE: Final = {"to": "engine", "verb": "set", "body": {"duty": 0.42}, "id": "robot1-7f3a-1042"}


class Order(Struct, frozen=True):
    """What the calling process is to measure; "" leaves a way out.

    Attributes:
        keys: of CURVE: the server's public key, then the caller's public and secret one.
    """

    calls: int
    zeromq: str
    curve: str = ""
    keys: tuple[str, ...] = ()
    zenoh: str = ""


class Site(Struct, frozen=True):
    """Where servers and the caller are.

    Attributes:
        server, caller: how a command is begun there, and its environment.
        address: of a server, from the scheme and its name or number.
    """

    directory: Path
    server: tuple[list[str], dict[str, str]]
    caller: tuple[list[str], dict[str, str]]
    hosts: tuple[str, str] | None = None

    def address(self, scheme: str, local: str, number: int) -> str:
        """Of a server: a unix socket on one robot, else TCP."""
        separator = "/" if local == "unixsock-stream" else "://"
        if self.hosts is None:
            return f"{local}{separator}{self.directory / str(number)}"
        return f"{scheme}{separator}{self.hosts[0]}:{PORT + number}"


def driver_call(quick: bool, directory: Path) -> Findings:
    """One call and its answer, by each way."""
    calls = QUICK_CALLS if quick else CALLS
    has_zenoh = importlib.util.find_spec("zenoh") is not None
    figures: list[Figure] = []
    with ExitStack() as stack:
        for case, site in ((ONE_ROBOT, _one_robot), (TWO_ROBOTS, _two_robots)):
            place = directory / site.__name__
            place.mkdir()
            at = stack.enter_context(site(place))
            for who, found in _measured(at, calls, has_zenoh).items():
                figures.append(Figure("call and answer", f"{case}{_where(at)}", "µs", tuple(found), who))
    return Findings(
        "A driver's call",
        "A command with one number and its answer, from one process to another, in Python; each call by itself. Ours is "
        "failover.proxy(…).call; beside it a bare REQ socket and a zenoh queryable, with the standard library's JSON. Between "
        "robots ours is encrypted and authenticated by CURVE.",
        tuple(figures),
        () if has_zenoh else (Absent(ZENOH, "not installed: the extra *recipes*"),),
    )


HOPS: Final = (Hop("robot1/mission", 7_123_456_789, 7_123_466_789), Hop("robot2/PWM", 99_123_456_789, 99_123_466_789))
COMMAND: Final = Envelope(
    to="University/Lab/Robotino/Engines/3/PWM",
    verb="set",
    body={"duty": 0.42},
    id="robot1/mission-7f3a-1042",
    sender="robot1/mission",
    boot=32_570,
    seq=1_042,
    after=1_041,
    had=1_040,
    reliable=True,
    deadline_ms=200.0,
    hops=HOPS,
)


def messages(quick: bool, directory: Path) -> Findings:
    """One command as bytes, in each encoding that can be had here."""
    figures: list[Figure] = []
    encodings = [one for one in get_args(Encoding) if one != "avro" or importlib.util.find_spec("fastavro") is not None]
    takes: dict[tuple[str, str], list[float]] = {(what, one): [] for one in encodings for what in ("encode", "decode")}
    written = {one: encode(COMMAND, one) for one in encodings}
    for _ in range(QUICK_CALLS if quick else CALLS):
        for one in encodings:
            begun = time.perf_counter_ns()
            encode(COMMAND, one)
            encoded = time.perf_counter_ns()
            decode(written[one])
            takes["encode", one].append((encoded - begun) / 1_000)
            takes["decode", one].append((time.perf_counter_ns() - encoded) / 1_000)
    for one in encodings:
        figures.append(Figure("size", one, "B", (float(len(written[one])),)))
        figures += [Figure(what, one, "µs", tuple(takes[what, one])) for what in ("encode", "decode")]
    absent = () if "avro" in encodings else (Absent("avro", "fastavro is not installed: the extra *avro*"),)
    return Findings(
        "A message's encoding", "A command with one number and two hops; decode checks it, too.", tuple(figures), absent
    )


def _where(site: Site) -> str:
    if site.hosts is None:
        return ""
    return ", a cable" if site.server[0] else ", one network"


def _measured(site: Site, calls: int, has_zenoh: bool) -> dict[str, list[float]]:
    """Start all servers, and one process that calls them in turn."""
    with ExitStack() as stack:
        order = Order(calls, site.address("tcp", "ipc", 1))
        stack.enter_context(_server(site, DRIVER, (), site.directory / "robot1" / "Benchmark.PWM.names"))
        stack.enter_context(_server(site, REPLIER, (order.zeromq, ""), site.directory / "replies"))
        if site.hosts is not None:
            order = msgspec.structs.replace(order, curve=site.address("tcp", "ipc", 2), keys=())
            (public, secret), caller = key_pairs.new_pair(), key_pairs.new_pair()
            order = msgspec.structs.replace(order, keys=(public, *caller))
            stack.enter_context(_server(site, REPLIER, (order.curve, secret), site.directory / "replies-curve"))
        if has_zenoh:
            order = msgspec.structs.replace(order, zenoh=site.address("tcp", "unixsock-stream", 3))
            stack.enter_context(_server(site, QUERYABLE, (order.zenoh,), site.directory / "queryable"))
        begun, environment = site.caller
        command = [*begun, sys.executable, "-m", "benchmarks.driver_call", msgspec.json.encode(order).decode()]
        ran = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
        if ran.returncode:
            raise BenchmarkError(f"the calling process failed: {ran.stderr.strip().splitlines()[-1:]}")
        return msgspec.json.decode(ran.stdout, type=dict[str, list[float]])


@contextmanager
def _server(site: Site, text: str, arguments: Sequence[str], sign: Path) -> Iterator[None]:
    """A program, from when the file ``sign`` is there; all but ours make it, and are told where."""
    begun, environment = site.server
    words = [*arguments, *([str(sign)] if arguments else [])]
    command = [*begun, sys.executable, "-c", text, *words]
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


# --- Where --------------------------------------------------------------------------------------------------------


@contextmanager
def _one_robot(directory: Path) -> Iterator[Site]:
    (directory / "robot1").mkdir(mode=0o700)
    environment = _environment(directory, "robot1", None)
    yield Site(directory, ([], environment), ([], environment))


@contextmanager
def _two_robots(directory: Path) -> Iterator[Site]:
    """Two robots of a team with keys: in namespaces with a cable, where this machine allows them, else on the loopback."""
    names = ("robot1", "robot2")
    with ExitStack() as stack:
        if robots.means().own_network:
            machines = [stack.enter_context(_network(name, directory)) for name in names]
            robots.lay(machines, *robots.CABLES[0])
            hosts = tuple(robots.ADDRESS.format(number) for number in (1, 2))
            begun = [["nsenter", "--net", f"--target={one.process.pid}", "--"] for one in machines]
        else:
            network = f"127.{random.randrange(1, 255)}.{random.randrange(255)}"
            hosts, begun = (f"{network}.1", f"{network}.2"), [[], []]
        members, secrets = Team("benchmark"), {}
        for name, host in zip(names, hosts, strict=True):
            public, secrets[name] = key_pairs.new_pair()
            members = team.enrol(members, name, Robot((f"{host}:7420",), f"{host}:7421", "robot", public))
        environments = []
        for name in names:
            (directory / name).mkdir(mode=0o700)
            place = directory / f"{name}-team"
            team.write(place, members)
            team.write_secret_key(place, name, secrets[name])
            environments.append(_environment(directory, name, place))
        server, caller = zip(begun, environments, strict=True)
        yield Site(directory, server, caller, (hosts[0], hosts[1]))


@contextmanager
def _network(name: str, directory: Path) -> Iterator[RobotMachine]:
    """A network namespace, as long as a process waits in it."""
    with subprocess.Popen(["unshare", "--net", "--", "sleep", "infinity"]) as process:
        try:
            machine = RobotMachine(name, directory, process)
            robots.wait_for_network(machine)
            robots.run(robots.ip_inside(machine, "link", "set", "lo", "up"))
            yield machine
        finally:
            process.kill()


def _environment(directory: Path, robot: str, place: Path | None) -> dict[str, str]:
    """Of a process on a robot; ``place``: the team's files, None: it has no team."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    own = {DIRECTORY: str(directory / robot), ROBOT: robot, "PYTHONPATH": paths}
    return {key: value for key, value in os.environ.items() if key != TEAM} | own | ({TEAM: str(place)} if place else {})


# --- The calling process ------------------------------------------------------------------------------------------


def main() -> None:
    """Measure as the order in the command line says; print each way's times in µs."""
    order = msgspec.json.decode(sys.argv[1], type=Order)
    with ExitStack() as stack:
        proxy = stack.enter_context(failover.proxy("engine"))
        ways: dict[str, Callable[[], object]] = {OURS: lambda: proxy.call("set", duty=0.42)}
        ways[ZEROMQ] = stack.enter_context(_zeromq(order.zeromq, ()))
        if order.curve:
            ways[CURVE] = stack.enter_context(_zeromq(order.curve, order.keys))
        if order.zenoh:
            ways[ZENOH] = stack.enter_context(_zenoh(order.zenoh))
        values: dict[str, list[float]] = {who: [] for who in ways}
        for call in ways.values():
            for _ in range(BATCH):
                call()
        for _ in range(order.calls // BATCH):
            for who, call in ways.items():
                for _ in range(BATCH):
                    begun = time.perf_counter_ns()
                    call()
                    values[who].append((time.perf_counter_ns() - begun) / 1_000)
    print(msgspec.json.encode(values).decode())


@contextmanager
def _zeromq(address: str, keys: Sequence[str]) -> Iterator[Callable[[], object]]:
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.REQ)
    if keys:
        socket.curve_serverkey, socket.curve_publickey, socket.curve_secretkey = (key.encode() for key in keys)
    socket.connect(address)

    def call() -> object:
        socket.send(json.dumps(MESSAGE).encode())
        return json.loads(socket.recv())["ok"]

    try:
        yield call
    finally:
        context.destroy(linger=0)


@contextmanager
def _zenoh(address: str) -> Iterator[Callable[[], object]]:
    zenoh = importlib.import_module("zenoh")
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([address]))
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


if __name__ == "__main__":
    main()
