"""Steps of the demo, in order: build the robots, protect, watch, cut the power, watch, compare."""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from failover.cli.demo import programs, robots
from failover.cli.demo.interruption import Interruption
from failover.cli.demo.programs import Program
from failover.cli.demo.robots import RobotMachine, Stage
from failover.cli.demo.screen import LiveScreen, PlainScreen
from failover.cli.demo.waiting import Waiting, load_and_cure
from failover.cli.demo.watch import Watcher, whole_output
from failover.cli.output import render, team_tree
from failover.client.control import Control
from failover.errors import FailoverError

SNAPSHOTS_BEFORE: Final = 15
"""Snapshots of each program that have arrived at the standby before the power is cut."""

SECONDS_BEFORE: Final = 3.0
"""Time to look on before the power is cut."""

TAKEOVER_S: Final = 60.0
END_S: Final = 120.0
"""Bounds, far above the usual times, after which the demo says that it failed."""

LENGTHS: Final = (1, 4, 16)
"""How many times the usual time the programs take: the first; the next where one came to its end before it could be protected."""

DEGRADED_S: Final = 20.0
"""How long a program may be degraded: on a busy machine its snapshots are late for a while."""

PLACE_LIMIT: Final = 45
"""Characters: a unix socket's path has at most 107 (unix(7)), and the longest of ours adds some 55."""

DRAW_S: Final = 0.1
RESULT_COLUMNS: Final = ("program", "outage", "lag at the cut", "freeze median", "freeze max", "output", "equal")


class Act(Struct):
    """One program in the play, and the observations of it.

    Attributes:
        freezes_us: freeze time of each snapshot, by sequence.
        lag_ms: age of the newest checkpoint when last seen before the cut.
        degraded_s: since when it has been seen degraded, on our clock; None while it is well.
        running_ns: when the standby was first seen to run it, on our clock.
        outage_ms: from the cut to the first output after that.
    """

    program: Program
    reference: subprocess.Popen[bytes]
    before: Watcher
    after: Watcher
    freezes_us: dict[int, int] = field(default_factory=dict)
    lag_ms: float | None = None
    snapshots: int = 0
    degraded_s: float | None = None
    running_ns: int | None = None
    outage_ms: float | None = None
    equal: bool = False
    size: int = 0
    exit_status: int | None = None


def demo(arguments: argparse.Namespace) -> int:
    """Show a program outliving its robot; 0 only if its whole output equals an undisturbed run, byte for byte."""
    live = render.is_terminal() and not arguments.json
    screen = LiveScreen() if live else PlainScreen(quiet=arguments.json)
    interruption = Interruption()
    with interruption.noted(), screen:
        for length in LENGTHS:
            try:
                play = _performed(screen, interruption, length)
                break
            except EndedEarlyError as error:
                if length == LENGTHS[-1]:
                    raise FailoverError(f"the demo gave up: {error}. {load_and_cure()}") from error
                screen.say(f"{error}; trying again, with programs that take longer")
    return _conclude(arguments, play, screen)


def _performed(screen: PlainScreen, interruption: Interruption, length: int) -> Play:
    directory = Path(tempfile.mkdtemp(prefix="failover-demo-", dir=short_place()))
    with Stage(directory, robots.means(), interruption=interruption, tell=screen.say) as stage:
        play = Play(stage, screen, length)
        try:
            with interruption.allowed():
                play.perform()
        finally:
            play.end_references()
    return play


class EndedEarlyError(FailoverError):
    """A program came to its end, in peace, before there was anything to show: the machine is too busy for its length."""


def short_place() -> str:
    """Where the demo makes its directory: the usual place, unless the robots' sockets would have too long a name there."""
    usual = tempfile.gettempdir()
    return usual if len(usual) <= PLACE_LIMIT else "/tmp"


# --- The play --------------------------------------------------------------------------------------------------------


class Play:
    """The acts on one stage. `perform` is the whole; afterwards ``acts`` holds the observations."""

    def __init__(self, stage: Stage, screen: PlainScreen, length: int = 1) -> None:
        self._length = length
        self._stage = stage
        self._screen = screen
        self._caption = ""
        self._told: dict[str, int] = {}
        self.acts: list[Act] = []

    def perform(self) -> None:
        """All of it, in order.

        Raises:
            EndedEarlyError: a program ended before the standby could go on with it.
            FailoverError: something did not come about; says what, how busy the machine is, and where the agents' logs are.
        """
        try:
            self._perform()
        except EndedEarlyError:
            raise
        except FailoverError as error:
            logs = self._stage.keep_logs()
            where = f" The agents' logs are in {logs}." if logs else ""
            raise FailoverError(f"the demo gave up: {error}. {load_and_cure()}{where}") from error

    def _perform(self) -> None:
        self._stage.start()
        self._screen.say(f"{self._primary.name} and {self._standby.name} are up: {self._stage.means.sentence()}")
        self._protect()
        self._look_on()
        cut_ns = self._cut()
        self._await_takeover(cut_ns)
        self._await_end()
        self._compare()

    @property
    def _primary(self) -> RobotMachine:
        return self._stage.robots[0]

    @property
    def _standby(self) -> RobotMachine:
        return self._stage.robots[1]

    def _protect(self) -> None:
        self._await("the robots to see each other", self._see_each_other)
        environment = {"PATH": os.environ.get("PATH", os.defpath), "LANG": "C.UTF-8", "HOME": str(self._stage.directory)}
        work = self._stage.directory / "work"
        work.mkdir()
        for program in programs.write(work, self._length):
            wanted: dict[str, Any] = {"argv": program.argv, "name": program.name, "cwd": str(program.directory)}
            with Control.open(self._primary.socket) as link:
                answer = link.ask("run", **wanted, env=environment, umask=0o022, isolate=True, wait=False)
            started = answer.get("started", answer)
            before, after = (Watcher(program.name, robot.socket) for robot in self._stage.robots)
            with self._stage.interruption.held():
                self.acts.append(Act(program, program.undisturbed(environment), before, after))
            before.start()
            after.start()
            command = " ".join([Path(program.argv[0]).name, *program.argv[1:]])
            self._screen.say(f"{command} runs on {self._primary.name} as pid {started.get('inner_pid') or started.get('pid')}")

    def _see_each_other(self) -> bool:
        return all(peer["state"] == "live" for robot in self._stage.robots for peer in robot.status()["peers"])

    def _look_on(self) -> None:
        self._caption = "protected; snapshots arrive at the standby"
        until = time.monotonic() + SECONDS_BEFORE
        self._await(
            f"{SNAPSHOTS_BEFORE} snapshots of each program to arrive at {self._standby.name}",
            lambda: self._sample() and time.monotonic() > until and all(act.snapshots >= SNAPSHOTS_BEFORE for act in self.acts),
            how_far=lambda: ", ".join(f"{act.program.title}: {act.snapshots}" for act in self.acts),
        )

    def _sample(self) -> bool:
        """Note the facts that the primary's agent has of each program; return whether all are well."""
        found = {component["name"]: component for component in self._primary.status()["components"]}
        for act in self.acts:
            component = found.get(act.program.name)
            if component is None:
                continue
            _bear(act, component)
            _still_runs(act, component, f"at {self._primary.name}, before the power was cut")
            act.lag_ms = component.get("lag_ms")
            act.snapshots = component.get("standby_sequence") or 0
            if component.get("freeze_us") is not None:
                act.freezes_us[component.get("sequence") or 0] = component["freeze_us"]
            self._tell_arrival(act, component)
        self._draw(found, self._primary.name)
        return all(act.degraded_s is None for act in self.acts)

    def _tell_arrival(self, act: Act, component: dict[str, Any]) -> None:
        """Every tenth snapshot is worth a line; the table shows them all."""
        if act.snapshots and act.snapshots >= self._told.get(act.program.name, 0):
            self._told[act.program.name] = act.snapshots - act.snapshots % 10 + 10
            size, freeze = team_tree.size(component.get("snapshot_size")), team_tree.microseconds(component.get("freeze_us"))
            lag = team_tree.milliseconds(component.get("lag_ms"))
            what = f"snapshot {act.snapshots} of {act.program.title} has arrived at {self._standby.name}"
            self._screen.say(f"{what}: {size}, freeze {freeze}, lag {lag}")

    def _cut(self) -> int:
        """The power cut; returns its instant on our clock."""
        cut_ns = time.monotonic_ns()
        count = self._primary.cut_power()
        self._screen.say(f"power cut: all {count} processes of {self._primary.name} frozen, then killed at once")
        for act in self.acts:
            act.before.stop()
        return cut_ns

    def _await_takeover(self, cut_ns: int) -> None:
        self._caption = "the power is cut"
        self._await(
            f"{self._standby.name} to resume every program", lambda: self._see_takeover(cut_ns), robots.POLL_S, TAKEOVER_S
        )

    def _see_takeover(self, cut_ns: int) -> bool:
        found = {component["name"]: component for component in self._standby.status()["components"]}
        for act in self.acts:
            component = found.get(act.program.name, {})
            if act.running_ns is None and component.get("role") == "primary" and component.get("state") in ("running", "ended"):
                act.running_ns = time.monotonic_ns()
            told_all = component.get("state") == "ended" and act.after.size >= self._size_at_standby(act)
            arrived = act.after.first_after(act.running_ns) if act.running_ns is not None else None
            if act.outage_ms is None and arrived is not None:
                act.outage_ms = (arrived - cut_ns) / 1e6
                self._screen.say(
                    f"{act.program.title} resumes at {self._standby.name}: next output {act.outage_ms:.0f} ms after the cut"
                )
            if act.outage_ms is None and told_all:
                _still_runs(act, component, f"before this demo saw it resume at {self._standby.name}")
        return all(act.outage_ms is not None for act in self.acts)

    def _size_at_standby(self, act: Act) -> int:
        return len(whole_output(self._standby.socket, act.program.name)[0])

    def _await_end(self) -> None:
        self._caption = f"resumed at {self._standby.name}"
        self._await("the programs to end", self._see_end, DRAW_S, END_S * self._length, self._written)

    def _written(self) -> str:
        """How much of its output each program has written."""
        return ", ".join(f"{act.program.title}: {100 * act.after.size // act.program.expected_size} %" for act in self.acts)

    def _see_end(self) -> bool:
        found = {component["name"]: component for component in self._standby.status()["components"]}
        self._draw(found, self._standby.name)
        for act in self.acts:
            component = found.get(act.program.name, {})
            if component.get("state") == "failed":
                raise FailoverError(f"{act.program.name} failed at {self._standby.name}: {_why(component)}")
        return all(found.get(act.program.name, {}).get("state") == "ended" for act in self.acts)

    def _compare(self) -> None:
        self._await(
            "the undisturbed runs to end",
            lambda: all(act.reference.poll() is not None for act in self.acts),
            DRAW_S,
            END_S * self._length,
        )
        for act in self.acts:
            expected = act.program.reference.read_bytes()
            output, act.exit_status = whole_output(self._standby.socket, act.program.name)
            act.size = len(output)
            act.equal = output == expected and act.exit_status == act.reference.returncode == 0
            verdict = "equal, byte for byte, to an undisturbed run" if act.equal else difference(output, expected, act)
            ending = "–" if act.exit_status is None else team_tree.ending(act.exit_status)
            self._screen.say(f"{act.program.title} has ended ({ending}); its {act.size} bytes of output are {verdict}")

    def end_references(self) -> None:
        """Stop the watchers, and end the undisturbed runs, however the demo ends: none goes on without us."""
        for act in self.acts:
            act.before.stop()
            act.after.stop()
            if act.reference.poll() is None:
                act.reference.kill()
            act.reference.wait()

    def _await(
        self,
        what: str,
        condition: Callable[[], bool],
        every_s: float = DRAW_S / 2,
        limit_s: float = TAKEOVER_S,
        how_far: Callable[[], str] = lambda: "",
    ) -> None:
        waiting = Waiting(what, limit_s, self._screen.say)
        while not condition():
            if waiting.is_over(how_far):
                far = f" ({words})" if (words := how_far()) else ""
                raise FailoverError(f"it waited {limit_s:.0f} s for {what}{far}")
            time.sleep(every_s)

    def _draw(self, components: dict[str, dict[str, Any]], robot: str) -> None:
        lines, done = [], []
        for act in self.acts:
            component = components.get(act.program.name, {})
            watcher = act.after if act.running_ns is not None else act.before
            done.append(watcher.size / act.program.expected_size)
            lines.append(
                (
                    act.program.title,
                    robot,
                    str(component.get("state") or ""),
                    str(act.snapshots),
                    team_tree.milliseconds(component.get("lag_ms")),
                    team_tree.microseconds(component.get("freeze_us")),
                    team_tree.size(watcher.size),
                    watcher.last[:48],
                )
            )
        self._screen.draw(lines, min(done, default=0.0), self._caption)


def _bear(act: Act, component: dict[str, Any]) -> None:
    """Note whether a program is degraded.

    Raises:
        FailoverError: it has failed, or has been degraded for longer than `DEGRADED_S`.
    """
    if component["state"] not in team_tree.BAD_STATES:
        act.degraded_s = None
        return
    now = time.monotonic()
    act.degraded_s = now if act.degraded_s is None else act.degraded_s
    if component["state"] == "failed" or now - act.degraded_s > DEGRADED_S:
        raise FailoverError(f"{act.program.name} is {component['state']}: {_why(component)}")


def _still_runs(act: Act, component: dict[str, Any], when: str) -> None:
    """
    Raises:
        EndedEarlyError: it has come to its end, as it should, but too early.
        FailoverError: it has come to another end.
    """
    if component["state"] != "ended":
        return
    status = component.get("exit_status")
    if status:
        raise FailoverError(f"{act.program.name} ended {when}: {team_tree.ending(status)}")
    raise EndedEarlyError(f"{act.program.title} ended {when}: {act.snapshots} of its snapshots had arrived")


def _why(component: dict[str, Any]) -> str:
    return "; ".join(component.get("reasons") or component.get("notes") or ["?"])


def difference(output: bytes, expected: bytes, act: Act) -> str:
    """Where two outputs differ, in words."""
    at = next((index for index, (one, other) in enumerate(zip(output, expected, strict=False)) if one != other), None)
    if at is not None:
        return f"DIFFERENT from byte {at} on: {output[at : at + 40]!r} instead of {expected[at : at + 40]!r}"
    if len(output) != len(expected):
        return f"NOT ALL: an undisturbed run writes {len(expected)}"
    return f"equal, but the exit status is {act.exit_status}, that of an undisturbed run {act.reference.returncode}"


# --- What came of it -------------------------------------------------------------------------------------------------


def _conclude(arguments: argparse.Namespace, play: Play, screen: PlainScreen) -> int:
    equal = bool(play.acts) and all(act.equal for act in play.acts)
    lines = [result_line(act) for act in play.acts]
    if arguments.json:
        render.as_json({"equal": equal, "programs": [as_record(act) for act in play.acts]})
    else:
        print()
        render.table(RESULT_COLUMNS, lines)
        print("every program resumed, and its output is complete" if equal else "this went wrong: the output differs, see above")
    if arguments.picture:
        render.save_picture(arguments.picture, "./run demo", screen.transcript, RESULT_COLUMNS, lines)
    return 0 if equal else 1


def result_line(act: Act) -> tuple[str, ...]:
    """One program's row of the closing table."""
    freezes = list(act.freezes_us.values())
    return (
        act.program.title,
        team_tree.milliseconds(act.outage_ms),
        team_tree.milliseconds(act.lag_ms),
        team_tree.microseconds(statistics.median(freezes) if freezes else None),
        team_tree.microseconds(max(freezes, default=None)),
        f"{act.size} bytes",
        "yes" if act.equal else "NO",
    )


def as_record(act: Act) -> dict[str, Any]:
    """The same for machines."""
    freezes = list(act.freezes_us.values())
    return {
        "name": act.program.name,
        "command": list(act.program.argv),
        "outage_ms": act.outage_ms,
        "lag_ms": act.lag_ms,
        "freeze_us_median": statistics.median(freezes) if freezes else None,
        "freeze_us_max": max(freezes, default=None),
        "output_size": act.size,
        "exit_status": act.exit_status,
        "equal": act.equal,
    }
