"""Two whole robots for a test: agents with keys, in PID and network namespaces of their own where this machine allows it.

They are the demo's own robots (`failover.cli.demo.robots`), so that people watch the same thing that tests prove.
"""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import replace

from failover.cli.demo import robots as demo
from failover.cli.demo.robots import CABLES, USUAL_PACE, Means, Pace, RobotMachine, Stage, agent_command, ip_inside
from failover.client.control import Output, Result
from failover.errors import LostAgentError, NoAgentError

PATIENCE_S = 60.0
"""A generous bound for whatever is waited for; the machine may be busy."""

POLL_S = 0.01

LOG_LINES = 80
"""Of each agent's log, shown with a test that fails."""

NO_ANSWER = (NoAgentError, LostAgentError)
"""What a robot whose agent is being replaced says."""

T = TypeVar("T")


@functools.cache
def means() -> Means:
    """What this machine allows, found out once: to ask costs an interpreter."""
    return demo.means()


@contextmanager
def two_robots(
    directory: Path,
    settings: str = "",
    prepare: Callable[[Path], None] = lambda _: None,
    *,
    own_network: bool = True,
    own_pids: bool = True,
    cables: Sequence[tuple[str, str]] = CABLES,
    pace: Pace = USUAL_PACE,
) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    """robot1 and robot2, beating and connected.

    Args:
        settings: lines added to their configurations.
        prepare: called with the directory in which each robot will have its own, before they start.
        own_network: of each robot, where that can be had; else they share the loopback, and outlive each other's cable.
        own_pids: the same; else no two of their programs can have one PID.
        cables: between the two; needs networks of their own.
        pace: of their heartbeats.
    """
    allowed = means()
    allowed = replace(allowed, own_network=allowed.own_network and own_network, own_pids=allowed.own_pids and own_pids)
    with Stage(directory / "stage", allowed, settings, cables=cables, pace=pace) as stage:
        stage.directory.mkdir()
        prepare(stage.directory)
        stage.start()
        first, second = stage.robots
        try:
            until(lambda: connected(first) and connected(second), "the robots to hear each other")
            yield first, second
            for robot in stage.robots:
                assert not mistake(robot), f"a mistake in the agent of {robot.name}:\n{mistake(robot)}"
        finally:
            for robot in stage.robots:  # shown by pytest where a test fails
                print(f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-LOG_LINES:], sep="\n")


def mistake(robot: RobotMachine) -> str:
    """The first traceback in its agent's log, and what follows; "" if there is none."""
    _, found, rest = robot.log.read_text(errors="replace").partition("Traceback")
    return "\n".join((found + rest).splitlines()[:LOG_LINES])


def until(condition: Callable[[], T], what: str, patience_s: float = PATIENCE_S) -> T:
    """The first true value of the condition; fails after ``patience_s``."""
    deadline = time.monotonic() + patience_s
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < deadline, f"waited {patience_s:.0f} s in vain for {what}"
        time.sleep(POLL_S)


def until_protected(robot: RobotMachine, name: str = "count") -> None:
    """Until its standby holds a checkpoint of this component."""
    until(lambda: component(robot, name).get("protection") == "protected", "a checkpoint at the standby")


def until_taken_over(robot: RobotMachine, name: str = "count") -> None:
    """The robot has resumed the program: it is the primary a moment earlier, and the program may write before this is counted."""
    until(lambda: component(robot, name).get("role") == "primary", f"{robot.name} to take {name} over")
    until(lambda: component(robot, name).get("restores"), f"{robot.name} to resume {name}")


def counts_on_elsewhere(first: RobotMachine, second: RobotMachine, more: int, name: str = "count") -> None:
    """A component counts, the first robot's power is cut, and it goes on at the second: each number once."""
    until(lambda: len(numbers(first, name)) > more, "some numbers")
    first.cut_power()
    until_taken_over(second, name)
    before = len(numbers(second, name))
    until(lambda: len(numbers(second, name)) > before + more, "it to go on")
    counted = numbers(second, name)
    assert counted == list(range(len(counted))), "each number once, in order"


def until_status(robot: RobotMachine, returncode: int, *words: str) -> str:
    """What `failover status` shows there, once it ends with this exit status and says all the words."""
    shown: subprocess.CompletedProcess[str] | None = None

    def says() -> bool:
        nonlocal shown
        shown = failover(robot, "status")
        return shown.returncode == returncode and all(word in shown.stdout for word in words)

    try:
        until(says, f"status {returncode} and {words}")
    except AssertionError as error:
        raise AssertionError(f"{error}; it shows {shown}") from error
    assert shown is not None
    return shown.stdout


def numbers(robot: RobotMachine, name: str = "count") -> list[int]:
    """What a component that counts has written, as this robot has it."""
    return [int(line) for line in output(robot, name).split()]


def connected(robot: RobotMachine) -> bool:
    """Whether it hears its peer's beats and has a replication link to it."""
    (peer,) = robot.status()["peers"]
    return bool(peer["state"] == "live" and peer["hears_us"] and peer["lane"] == "connected")


def run(
    robot: RobotMachine, name: str, *argv: str, env: dict[str, str] | None = None, cwd: str = "/", engine: str = "ptrace"
) -> dict[str, Any]:
    """Start a program under protection; returns what `failover run` says at once."""
    with robot.control() as link:
        environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C", **(env or {})}
        return link.ask("run", argv=list(argv), name=name, env=environment, cwd=cwd, wait=False, engine=engine)


def failover(robot: RobotMachine, verb: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command as a person gives it at that robot."""
    command = [sys.executable, "-m", "failover.cli.main", verb, "--socket", str(robot.socket), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def component(robot: RobotMachine, name: str) -> dict[str, Any]:
    """The component as that robot shows it; empty where it is unknown."""
    return next((one for one in robot.status()["components"] if one["name"].endswith("/" + name)), {})


def checkpoints(robot: RobotMachine, name: str) -> int:
    """Snapshots of the component that came to, or were taken on, this robot."""
    return int(component(robot, name).get("snapshots") or 0)


def output(robot: RobotMachine, name: str, stream: int = 1) -> bytes:
    """What the component wrote to its standard output (1) or error (2), as far as no takeover takes it back."""
    collected = bytearray()
    with robot.control() as link:
        for reply in link.stream("logs", name=name):
            if isinstance(reply, Output) and reply.stream == stream:
                assert reply.offset == len(collected), "the stream has a gap or a repetition"
                collected += reply.content
            elif isinstance(reply, Result):
                break
    return bytes(collected)


def result(robot: RobotMachine, name: str) -> dict[str, Any]:
    """Wait for the component's end and return what `failover logs --follow` ends with."""
    with robot.control() as link:
        return link.ask("logs", name=name, follow=True)


def start_inside(robot: RobotMachine, *command: str) -> None:
    """Start a process of the robot that nobody there is the parent of; it ends with the robot at the latest."""
    script = f'"$@" </dev/null >>{robot.log} 2>&1 &'
    which = ["--all"] if os.geteuid() == 0 else ["--user", "--preserve-credentials", "--pid", "--mount"]
    inside = ["nsenter", f"--target={robot.processes()[0]}", *which] if means().own_pids else []
    subprocess.run([*inside, "setsid", "sh", "-c", script, "sh", *command], check=True)


def keep_on(robot: RobotMachine) -> None:
    """Let the robot live on when its agent has ended and there is no program: its host ends with its last process."""
    start_inside(robot, "sleep", "1000000")


def start_agent(robot: RobotMachine, **environment: str) -> None:
    """Start the robot's agent again, as its service would."""
    variables = [f"{name}={value}" for name, value in environment.items()]
    start_inside(robot, "env", *variables, *agent_command(robot.directory / "agent.toml"))


def stop_agent(robot: RobotMachine) -> None:
    """End the robot's agent in order, as its service would; call `keep_on` first where nothing else keeps the robot alive."""
    agent = host_pid(robot, robot.status()["pid"])
    os.kill(agent, signal.SIGTERM)
    until(lambda: has_ended(agent), f"the agent of {robot.name} to end")


def has_ended(pid: int) -> bool:
    """Whether a process has given everything back: an agent answers no more some time before that."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


def answers(robot: RobotMachine) -> bool:
    """Whether its agent answers now."""
    try:
        robot.status()
    except NO_ANSWER:
        return False
    return True


def cable(robot: RobotMachine, state: str, name: str = "wire") -> None:
    """Plug a network cable "up" or "down"; needs robots with networks of their own."""
    subprocess.run(ip_inside(robot, "link", "set", name, state), check=True)


def has_cable() -> bool:
    """Whether the robots have networks of their own here."""
    return means().own_network


def host_pid(robot: RobotMachine, inner: int) -> int:
    """The process that the robot itself calls ``inner``."""
    own_pids = int(means().own_pids)
    for pid in robot.processes():
        try:
            lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended
        named = next(line for line in lines if line.startswith("NSpid:")).split()[1:]
        if len(named) > own_pids and int(named[own_pids]) == inner:
            return pid
    raise AssertionError(f"{robot.name} has no process {inner}")
