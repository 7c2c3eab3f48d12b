"""Sealed copies: what they cost snapshots while they are made, at a witness and in S3; and how long until one is durable.

The server of S3 is moto, of requirements-s3-servers.txt, which keeps all in its memory: only figures of one server compare.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from agent.archive.messages import Done, KeepCheckpoint, Look, Request
from agent.archive.process import NICE
from benchmarks.costs import used_s
from benchmarks.figures import OURS, Absent, Figure, Findings, percentile
from benchmarks.running import PROGRAMS, BenchmarkError, Running, running
from checkpoint.keeper import messages
from checkpoint.keeper.messages import Channel, pair
from failover.archive import keys, signature
from failover.archive.archive import object_store
from failover.cli.demo.robots import RobotMachine
from failover.cli.keeper_client import Keeper
from failover.config.team import Role
from tests import s3_servers
from tests.e2e.teams import TeamStage

MEGABYTES: Final = 100
CHANGED_KB: Final = 1000
PERIOD_MS: Final = 100
PLACES: Final = 8
"""In which the program changes its megabyte, all over its memory."""
SCATTERED: Final = 256
"""Single pages: as many as a megabyte has."""

WARM_SNAPSHOTS: Final = 60
"""Then the program has its memory, the standby a ready copy, and the stores fold as they always will."""
TURNS: Final = 5
QUICK_TURNS: Final = 2
WINDOW_S: Final = 8.0
POLL_S: Final = 0.04
"""Less than half a period: each snapshot is seen."""
PATIENCE_S: Final = 60.0
ROUNDS: Final = 3
QUICK_ROUNDS: Final = 2

ROLES: Final[dict[str, Role]] = {"robot1": "robot", "robot2": "robot", "gate": "witness"}
WITNESS: Final = "witness"
IN_S3: Final = "S3"
KIND: Final = "moto"
COPYING: Final = "copies on their way"
RESTIC: Final = "restic"
PASSWORD: Final = {"RESTIC_PASSWORD": "measured"}
NO_KEY: Final = "cannot read the archive key"
MADE: Final = re.compile(r" is in the archive: ")
STORE: Final = "[store]\ns3_every_s = 1\ns3_keep = 2\n"
"""One copy after the other, a second between two: sixty times as often as by default."""


class _Seen(Struct):
    """What windows showed; times in ms.

    Attributes:
        took, freezes, ages: until a delta was acknowledged, of each one; how old the newest checkpoint was, at each look.
        copies: that were made; ``sealing``: processor time of the archive's process, % of a core. One of each a window.
    """

    took: list[float] = field(default_factory=list)
    freezes: list[float] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    copies: list[float] = field(default_factory=list)
    sealing: list[float] = field(default_factory=list)

    def add(self, more: _Seen) -> None:
        self.took += more.took
        self.freezes += more.freezes
        self.ages += more.ages
        self.copies += more.copies
        self.sealing += more.sealing


def sealed(quick: bool, directory: Path) -> Findings:
    """The witness, S3, and restic on the same server of S3."""
    turns, figures, absent = QUICK_TURNS if quick else TURNS, list[Figure](), list[Absent]()
    figures += _cost(WITNESS, turns, 'witness = "gate"\n', directory / WITNESS)
    try:
        with _server(directory) as url:
            s3 = f's3 = "s3://{s3_servers.BUCKET}/robots"\ns3_endpoint = "{url}"\n'
            found = _cost(IN_S3, turns, s3, directory / IN_S3, lambda config: _beside(config, url, quick, directory, absent))
            figures += found
    except BenchmarkError as error:
        absent.append(Absent(IN_S3, str(error)))
    return Findings(
        "Sealed copies",
        "Two robots and a witness on this machine, which have PIDs of their own where that is allowed; a program with the map "
        f"and the points of a robot, {MEGABYTES} MB, that writes 1 MB anew each {PERIOD_MS} ms; ten snapshots a second. In turn, "
        f"{WINDOW_S:g} s each: without sealed copies, and with one copy of all of it after the other on its way, with a second "
        "between two (by default it is a minute). Until a delta is acknowledged: from the order to capture it until the robot "
        "has the standby's word. Ratios are of one turn. Then, by itself: a base of such a program, and this base with a delta, "
        f"until the archive's process says that the server of S3 ({KIND}) has them, folded and sealed; beside it restic's "
        f"command, with its start, for a file of the same memory. Both have niceness {NICE}. The server takes what the robots "
        "leave of the processors. Until its bytes are a file: ours by a capture, which compresses them, "
        "restic's by reading /proc/PID/mem.",
        tuple(figures),
        tuple(absent),
    )


@contextlib.contextmanager
def _server(directory: Path) -> Iterator[str]:
    """A server of S3; keys of its bucket are in the environment."""
    if not s3_servers.PROGRAMS.is_dir():
        raise BenchmarkError("there is no server of S3: ./run test installs one (requirements-s3-servers.txt)")
    os.environ.update(s3_servers.environment())
    if is_root := os.geteuid() == 0:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # for the server, which has no machine of its own here
    with s3_servers.server(KIND, directory / "server") as url:
        if is_root:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        yield url


# --- What a copy on its way costs ------------------------------------------------------------------------------------------


def _cost(
    place: str, turns: int, store: str, directory: Path, afterwards: Callable[[Path], list[Figure]] = lambda _: []
) -> list[Figure]:
    """Windows without copies and with them, in turn.

    Args:
        afterwards: called with robot1's configuration when the robots have gone, before their directories go.
    """
    directory.mkdir()
    argv = ["/usr/bin/python3", str(PROGRAMS / "mapping.py"), *map(str, (MEGABYTES, CHANGED_KB, PLACES, PERIOD_MS))]
    own = dict.fromkeys(("robot1", "robot2"), STORE + store) | {"gate": '[store]\nsealed_size = "2GB"\n'}
    period = f'log_level = "debug"\nboot_patience_s = 1\nsnapshot_period_ms = {PERIOD_MS}\n'
    by_arm: dict[bool, list[_Seen]] = {False: [], True: []}
    with TeamStage(directory / "robots", ROLES, period, own) as stage:
        stage.directory.mkdir()
        stage.start()
        primary, gate = stage.members["robot1"], stage.members["gate"]
        with primary.control() as link:
            link.ask("run", argv=argv, name="mapping", cwd="/", wait=False)
        key = _new_key(primary, gate)
        _until(lambda: _component(primary).get("snapshots", 0) >= WARM_SNAPSHOTS, "the first snapshots, which are larger")
        _until(lambda: NO_KEY in _behind(primary), "the archive's key to be missed")
        for turn in range(turns):
            for is_copying in (True, False) if turn % 2 else (False, True):
                _switch(primary, key, is_copying)
                by_arm[is_copying].append(_window(primary))
        for robot in stage.robots:
            robot.end()
        if key.exists():
            key.replace(keys.key_path(primary.directory / "team"))
        return _figures(place, by_arm) + afterwards(primary.directory / "agent.toml")


def _new_key(primary: RobotMachine, gate: RobotMachine) -> Path:
    """Make the archive key and give the witness its half; the key lies aside until copies are to be made."""
    path = keys.new_key(primary.directory / "team")
    signature.write_public(gate.directory / "team", keys.read_key(primary.directory / "team"))
    return path.replace(path.with_suffix(".aside"))


def _switch(primary: RobotMachine, key: Path, is_copying: bool) -> None:
    """Have copies made, or no more of them; returns when one has been, or when the last one is over."""
    path = keys.key_path(primary.directory / "team")
    if is_copying and key.exists():
        copies = _copies(primary)
        key.replace(path)
        _until(lambda: _copies(primary) > copies, "a copy to be made", lambda: _behind(primary))
    elif not is_copying and path.exists():
        path.replace(key)
        _until(lambda: NO_KEY in _behind(primary), "the last copy to be over")


def _window(primary: RobotMachine) -> _Seen:
    """Look at it for a while."""
    seen, newest, snapshots = _Seen(), None, None
    copies, began, before = _copies(primary), time.monotonic(), _sealing_s(primary)
    while time.monotonic() < began + WINDOW_S:
        one = _component(primary)
        if one.get("took_ms") and newest != one["standby_sequence"]:
            seen.took += [one["took_ms"]] if newest is not None else []
            newest = one["standby_sequence"]
        if one.get("freeze_us") and snapshots != one["snapshots"]:
            seen.freezes += [one["freeze_us"] / 1000] if snapshots is not None else []
            snapshots = one["snapshots"]
        seen.ages += [one["lag_ms"]] if one.get("lag_ms") is not None else []
        time.sleep(POLL_S)
    span = time.monotonic() - began
    seen.copies.append(_copies(primary) - copies)
    seen.sealing.append((_sealing_s(primary) - before) / span * 100)
    if not seen.took:
        raise BenchmarkError(f"no snapshot was acknowledged in {WINDOW_S:g} s: {primary.last_words()}")
    return seen


def _figures(place: str, by_arm: dict[bool, list[_Seen]]) -> list[Figure]:
    figures, pooled = [], {is_copying: _Seen() for is_copying in by_arm}
    for is_copying, windows in by_arm.items():
        for seen in windows:
            pooled[is_copying].add(seen)
    for what, name in (
        ("until a delta is acknowledged", "took"),
        ("freeze", "freezes"),
        ("age of the newest checkpoint", "ages"),
    ):
        for is_copying, who in ((False, OURS), (True, COPYING)):
            figures.append(Figure(what, place, "ms", tuple(getattr(pooled[is_copying], name)), who))
        for share in (0.5, 0.99):
            ratios = [
                percentile(getattr(copying, name), share) / percentile(getattr(without, name), share)
                for without, copying in zip(by_arm[False], by_arm[True], strict=True)
            ]
            figures.append(Figure(f"… p{share * 100:.0f} with copies by that without them", place, "×", tuple(ratios), COPYING))
    figures.append(Figure(f"copies made in {WINDOW_S:g} s", place, "", tuple(pooled[True].copies), COPYING))
    figures.append(Figure("processor time of the archive's process", place, "% of a core", tuple(pooled[True].sealing), COPYING))
    return figures


def _component(robot: RobotMachine) -> dict[str, Any]:
    found: list[dict[str, Any]] = robot.status()["components"]
    return next((one for one in found if one["name"].endswith("/mapping")), {})


def _behind(robot: RobotMachine) -> str:
    return " ".join(note for note in robot.status()["notes"] if "ARCHIVE BEHIND" in note)


def _copies(robot: RobotMachine) -> int:
    """How many its log tells of."""
    return len(MADE.findall(robot.log.read_text(errors="replace")))


def _sealing_s(robot: RobotMachine) -> float:
    """Processor time of the process that seals."""
    spent = 0.0
    for pid in robot.processes():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if b"agent.archive.process" in Path(f"/proc/{pid}/cmdline").read_bytes():
                spent += used_s(pid)
    return spent


def _until(condition: Callable[[], bool], what: str, said: Callable[[], str] = str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise BenchmarkError(f"waited {PATIENCE_S:.0f} s in vain for {what}; {said() or 'nothing was said'}")
        time.sleep(POLL_S)


# --- Beside restic ---------------------------------------------------------------------------------------------------------


class _Spent(Struct):
    """Of one copy: seconds until its bytes are a file, and until that is durable; processor seconds; bytes at the server."""

    before_s: float
    wall_s: float
    processor_s: float
    size: int


def _beside(config: Path, url: str, quick: bool, directory: Path, absent: list[Absent]) -> list[Figure]:
    """A first copy, and another one when 1 MB of it has changed: in one place, and in single pages."""
    makers = [OURS]
    if shutil.which(RESTIC):
        makers.append(RESTIC)
    else:
        absent.append(Absent(RESTIC, "it is not installed: apt-get install restic"))
    figures = []
    for pieces, how in ((1, "in one place"), (SCATTERED, f"in {SCATTERED} single pages")):
        spent: dict[tuple[str, str], list[_Spent]] = {}
        for number in range(QUICK_ROUNDS if quick else ROUNDS):
            place = directory / f"beside-{pieces}-{number}"
            place.mkdir()
            for maker in makers if number % 2 else makers[::-1]:
                copy = _by_us if maker == OURS else _by_restic
                with running("mapping", MEGABYTES, CHANGED_KB, pieces, 0, directory=place) as program:
                    first, second = copy(program, config, url, place)
                spent.setdefault((maker, "first copy"), []).append(first)
                spent.setdefault((maker, f"1 MB of it changed {how}"), []).append(second)
            shutil.rmtree(place)
        for (maker, case), found in spent.items():
            if case != "first copy" or pieces == 1:
                figures += [
                    Figure("until its bytes are a file", case, "s", tuple(one.before_s for one in found), maker),
                    Figure("until a copy is durable", case, "s", tuple(one.wall_s for one in found), maker),
                    Figure("processor time of a copy", case, "s", tuple(one.processor_s for one in found), maker),
                    Figure("bytes that the server has more", case, "MB", tuple(one.size / 1e6 for one in found), maker),
                ]
    return sorted(figures, key=lambda figure: (figure.case != "first copy", figure.case))


def _change(program: Running) -> None:
    """Have it change its megabyte; returns when it has."""
    lines = program.output.read_bytes().count(b"\n")
    os.kill(program.pid, signal.SIGUSR1)
    _until(lambda: program.output.read_bytes().count(b"\n") > lines, "the program to change its memory")


def _by_us(program: Running, config: Path, url: str, place: Path) -> tuple[_Spent, _Spent]:
    """By the archive's process, which runs already, as an agent's does."""
    name, spent = f"/benchmark/{place.name}", []
    ours, theirs = pair()
    with theirs:
        command = [sys.executable, "-P", "-m", "agent.archive.process", str(config), str(theirs.fileno())]
        process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
    channel: Channel[Done] = Channel(ours, Done)
    chain: list[int] = []
    try:
        with Keeper.spawn() as keeper:
            keeper.ask(messages.Protect(program.pid, name), messages.Protected)
            _answer(channel, Look(()), ())  # it has loaded what it needs
            for is_base in (True, False):
                order = messages.Capture(base=is_base, generation=1, sequence=1 + len(chain))
                asked = time.monotonic()
                captured, (content,) = keeper.ask(order, messages.Captured)
                keeper.tell(messages.Acknowledge(captured.position))
                chain.append(content)
                before_s = time.monotonic() - asked
                there, used, began = _there(url, "robots"), used_s(process.pid), time.monotonic()
                done = _answer(channel, KeepCheckpoint(name), tuple(chain))
                wall_s = time.monotonic() - began
                if done.refusal:
                    raise BenchmarkError(f"the archive refused: {done.refusal}")
                spent.append(_Spent(before_s, wall_s, used_s(process.pid) - used, _there(url, "robots") - there))
                if is_base:
                    _change(program)
            keeper.ask(messages.Release(), messages.Released)
    finally:
        process.kill()
        process.wait()
        ours.close()
        for one in chain:
            os.close(one)
    return spent[0], spent[1]


def _answer(channel: Channel[Done], request: Request, descriptors: tuple[int, ...]) -> Done:
    channel.send(request, descriptors)
    return channel.receive()[0]


def _by_restic(program: Running, config: Path, url: str, place: Path) -> tuple[_Spent, _Spent]:
    """By its command, of a file of the same memory."""
    prefix = f"restic/{place.name}"
    command = ["nice", "-n", str(NICE), RESTIC, "--quiet", "--no-cache", "-r", f"s3:{url}/{s3_servers.BUCKET}/{prefix}"]
    memory, spent = place / "memory", []
    _run([*command, "init"])
    for is_first in (True, False):
        asked = time.monotonic()
        _dump(program.pid, memory)
        before_s = time.monotonic() - asked
        there, used, began = _there(url, prefix), resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        _run([*command, "backup", str(memory)])
        wall_s, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
        processor_s = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
        spent.append(_Spent(before_s, wall_s, processor_s, _there(url, prefix) - there))
        if is_first:
            _change(program)
    return spent[0], spent[1]


def _run(command: list[str]) -> None:
    ran = subprocess.run(command, env=os.environ | PASSWORD, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise BenchmarkError(f"{RESTIC} failed: {ran.stderr.strip()}")


def _dump(pid: int, file: Path) -> None:
    """Write the program's own memory: what is mapped for writing, and for it alone. It waits for a signal meanwhile."""
    with open(f"/proc/{pid}/mem", "rb", buffering=0) as memory, file.open("wb") as out:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            words = line.split()
            if words[1] == "rw-p":
                first, last = (int(word, 16) for word in words[0].split("-"))
                memory.seek(first)
                while first < last and (part := memory.read(min(1 << 20, last - first))):
                    out.write(part)
                    first += len(part)


def _there(url: str, prefix: str) -> int:
    """Bytes of all objects below a prefix."""
    return sum(one.size for one in object_store(f"s3://{s3_servers.BUCKET}/{prefix}", url).listed(""))
