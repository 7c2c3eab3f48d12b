"""run, protect, release, stop, handover, failback, promote, prefer: the verbs that act on one component."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

from checkpoint.sentences import visible
from failover.cli.arguments.components import HOOKS
from failover.cli.connection import connect
from failover.cli.output import progress, render, team_tree
from failover.cli.systemd_note import notes_of_service
from failover.client.control import Control, Output, Update
from failover.client.health import OVER_STATES
from failover.errors import AgentRefusedError, FailoverError, LostAgentError, NoAgentError

RECONNECT_S: Final = 30.0
"""How long ``failover run`` waits for its agent to come back: a restart takes a second, an upgrade some more."""

RECONNECT_EVERY_S: Final = 0.2

LOOK_EVERY_S: Final = 0.2
"""Between two looks whether a component is protected."""

IN_THE_ARCHIVE: Final = "a copy of it is in the archive: a robot that has the archive key, and that etcd votes for, can resume it"

ENDED: Final = OVER_STATES | {"failed"}


# --- run -------------------------------------------------------------------------------------------------------------


def run(arguments: argparse.Namespace) -> int:
    """Start a program under protection; its output and exit status become ours."""
    wanted: dict[str, Any] = {"argv": arguments.command, "env": dict(os.environ), "cwd": os.getcwd(), "umask": _umask()}
    wanted |= {"engine": arguments.engine, "isolate": arguments.isolate, "wait": not arguments.detach}
    wanted |= {"output": arguments.output, "hooks": {kind: getattr(arguments, kind) for kind in HOOKS}}
    wanted["portable"] = arguments.portable
    wanted |= {"carry": [os.path.realpath(path) for path in arguments.carry], "devices": dict(arguments.devices)}
    wanted |= {"connections": arguments.connections, "shared": [os.path.realpath(path) for path in arguments.shared]}
    wanted["shared_memory"] = arguments.shared_memory
    if arguments.name:
        wanted["name"] = arguments.name
    if arguments.user:
        wanted["user"] = arguments.user
    if arguments.wait and not arguments.detach:
        raise FailoverError("--wait goes with --detach: without it, run shows the program's output until its end")
    follower = _Follower(arguments)
    with connect(arguments) as agent:
        if arguments.detach:
            answer = agent.ask("run", **wanted)
            if arguments.wait:
                name = str(answer.get("started", answer)["name"])
                standby = until_protected(agent, name, is_quiet=arguments.json)
                if not arguments.json:
                    told = f"{standby} holds a checkpoint of it: it is protected" if standby else IN_THE_ARCHIVE
                    print(visible(told), file=sys.stderr)
            return _started(answer, arguments)
        with follower.passing_signals_on():
            return exit_like(follower.follow(agent, wanted))


def _started(answer: dict[str, Any], arguments: argparse.Namespace) -> int:
    started = answer.get("started", answer)
    if arguments.json:
        render.as_json(started)
    else:
        print(started["name"])
        _notes(started)
    return 0


class _Follower:
    """Shows one component's output until it ends, through restarts of the agent.

    The component lives outside the agent, so an agent that goes away is waited for, and the output goes on where it stopped.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._offsets = [0, 0]
        self._name = ""

    def follow(self, agent: Control, wanted: dict[str, Any]) -> int | None:
        """Run and show; returns the wait status, None when it is not known."""
        try:
            return self._show(agent, "run", wanted)
        except LostAgentError:
            if not self._name:
                raise
        while True:
            with reconnect(self._arguments, self._name) as agent:
                try:
                    return self._show(agent, "logs", {"name": self._name, "follow": True, "offsets": self._offsets})
                except LostAgentError:
                    continue

    def _show(self, agent: Control, verb: str, wanted: dict[str, Any]) -> int | None:
        for reply in agent.stream(verb, **wanted):
            if isinstance(reply, Output):
                write_output(reply)
                self._offsets[reply.stream - 1] = reply.offset + len(reply.content)
            elif isinstance(reply, Update):
                self._begin(reply.value.get("started", {}))
            else:
                if reply.value.get("reason"):
                    print(visible(f"failover: {self._name}: {reply.value['reason']}"), file=sys.stderr)
                status: int | None = reply.value.get("exit_status")
                return status
        return None

    def _begin(self, started: dict[str, Any]) -> None:
        self._name = str(started.get("name", self._name))
        if self._arguments.json:
            print(render.json_text({"started": started}), file=sys.stderr, flush=True)
        else:
            _notes(started)

    @contextmanager
    def passing_signals_on(self) -> Iterator[None]:
        """Ctrl-C and termination are the program's business: pass them on instead of leaving it behind."""
        before = {number: signal.signal(number, self._pass_on) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        try:
            yield
        finally:
            for number, action in before.items():
                signal.signal(number, action)

    def _pass_on(self, number: int, _frame: FrameType | None) -> None:
        if not self._name:  # nothing runs yet
            raise KeyboardInterrupt
        # A thread of its own: the agent answers when the program has ended, and we are in the middle of showing its output.
        threading.Thread(target=self._ask_to_stop, args=(number,), daemon=True).start()

    def _ask_to_stop(self, number: int) -> None:
        try:
            with connect(self._arguments) as agent:
                agent.ask("stop", name=self._name, signal=number)
        except FailoverError as error:
            print(visible(f"failover: {error}"), file=sys.stderr)


def until_protected(agent: Control, name: str, *, is_quiet: bool = False) -> str:
    """Return when a robot ("": the archive) holds a checkpoint of a component, and which; tell meanwhile how far that is.

    Raises:
        FailoverError: the component has ended, or cannot be protected.
    """
    with progress.Progress(is_quiet=is_quiet) as shown:
        while True:
            status = agent.ask("status")
            one = next((one for one in status["components"] if one["name"] == name), None)
            if one is None:
                raise FailoverError(f"{name} is not seen: it was released, or you may not see it; see failover rights why")
            if one["state"] in ENDED:
                raise FailoverError(f"{name} is {one['state']}: it will not be protected; see failover why {name}")
            if one["protection"] == "protected":
                return str(one["standby"])
            if one["protection"] == "stopped":
                why = "; ".join(one["reasons"]) or "on_unsupported = stop_protecting"
                raise FailoverError(f"{name} runs and stays unprotected: {why}")
            if all(peer["role"] == "witness" for peer in status["peers"]):
                raise FailoverError(f"{name} runs and stays unprotected: no other member of the team keeps checkpoints")
            shown.tell(f"{name}: {_how_far(one)}; Ctrl-C: it runs on")
            time.sleep(LOOK_EVERY_S)


def _how_far(one: dict[str, Any]) -> str:
    """What of a component is on its way to its standby, or what it waits for."""
    if going := one.get("arriving", ()):
        (first, *_) = sorted(going, key=lambda each: each["what"])
        what = {"checkpoint": "first checkpoint", "files": "program files"}[first["what"]]
        return f"{what} to {first['to']}: {progress.share(first['arrived'], first['size'])}"
    return str(one["reasons"][0]) if one["reasons"] else f"waits for the first checkpoint ({one['state']})"


def reconnect(arguments: argparse.Namespace, name: str) -> Control:
    """Wait for an agent that went away in the middle of a component's output.

    Raises:
        NoAgentError: it did not come back.
    """
    deadline = time.monotonic() + RECONNECT_S
    while True:
        try:
            return connect(arguments)
        except NoAgentError as error:
            if time.monotonic() > deadline:
                raise NoAgentError(
                    f"lost the agent, and none answered within {RECONNECT_S:.0f} s; {name} runs on without it: "
                    f"start failover-agent, then follow with: failover logs --follow {name}"
                ) from error
            time.sleep(RECONNECT_EVERY_S)


def write_output(piece: Output) -> None:
    """Pass a component's bytes on, unchanged, at once."""
    stream = sys.stdout.buffer if piece.stream == 1 else sys.stderr.buffer
    stream.write(piece.content)
    stream.flush()


def exit_like(wait_status: int | None) -> int:
    """Our exit status for a program's wait status: its own, or 128 + the signal that ended it, as shells say it."""
    if wait_status is None:
        print("failover: the program has ended; its exit status is not known", file=sys.stderr)
        return 1
    number = wait_status & 0x7F
    return 128 + number if number else (wait_status >> 8) & 0xFF


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _notes(answer: dict[str, Any]) -> None:
    for note in answer.get("notes") or ():
        print(visible(f"failover: note: {note}"), file=sys.stderr)


# --- The others: ask, and say what came of it ------------------------------------------------------------------------


def protect(arguments: argparse.Namespace) -> int:
    """Protect a process that runs already."""
    name = arguments.name or f"pid-{arguments.pid}"
    with connect(arguments) as agent:
        carry = [os.path.realpath(path) for path in arguments.carry]
        shared = [os.path.realpath(path) for path in arguments.shared]
        rules = {"devices": dict(arguments.devices), "connections": arguments.connections, "shared": shared}
        rules["shared_memory"] = arguments.shared_memory
        answer = agent.ask("protect", pid=arguments.pid, name=name, carry=carry, **rules)
        if arguments.wait:
            until_protected(agent, str(answer["name"]), is_quiet=arguments.json)
    answer = {**answer, "notes": [*answer.get("notes", ()), *notes_of_service(arguments.pid)]}
    return _tell(arguments, answer, f"pid {answer['pid']} is protected as {answer['name']}")


def release(arguments: argparse.Namespace) -> int:
    """Let a component go; its program runs on, unprotected."""
    with connect(arguments) as agent:
        answer = agent.ask("release", name=arguments.name)
    what = "is forgotten" if answer["pid"] is None else f"runs on as pid {answer['pid']}, unprotected"
    return _tell(arguments, answer, f"{answer['name']} {what}")


def start(arguments: argparse.Namespace) -> int:
    """Start a declared component after its end."""
    with connect(arguments) as agent:
        answer = agent.ask("start", name=arguments.name)
    if not arguments.json:
        _notes(answer)
    return _tell(arguments, answer, f"{answer['name']} runs at {answer['robot']}")


def stop(arguments: argparse.Namespace) -> int:
    """End a component's program; no robot runs it again."""
    with connect(arguments) as agent:
        answer = agent.ask("stop", name=arguments.name, signal=arguments.signal)
    status = answer.get("exit_status")
    return _tell(arguments, answer, f"{answer['name']} has ended" + ("" if status is None else f": {team_tree.ending(status)}"))


def handover(arguments: argparse.Namespace) -> int:
    """Move a component to another robot, planned: nothing is lost."""
    with connect(arguments) as agent:
        answer = agent.ask("handover", name=arguments.name, to=arguments.to or "")
    return _tell(arguments, answer, _moved(answer))


def failback(arguments: argparse.Namespace) -> int:
    """Move a component back to where it belongs."""
    with connect(arguments) as agent:
        answer = agent.ask("failback", name=arguments.name)
    return _tell(arguments, answer, _moved(answer))


def _moved(answer: dict[str, Any]) -> str:
    if not answer.get("moved", True):
        return str(answer["sentence"])
    return f"{answer['name']} runs on {answer['to']} now; the move took {answer['took_ms']:.0f} ms"


def promote(arguments: argparse.Namespace) -> int:
    """Have a robot run a component that no robot is heard to run, once the operator knows the risks."""
    wanted = {"name": arguments.name, "robot": arguments.robot or ""}
    with connect(arguments) as agent:
        would = agent.ask("promote", **wanted)
        wanted["robot"] = would["to"]
        if not arguments.json:
            print(*map(visible, (f"failover: {would['sentence']}", *would["risks"])), sep="\n  - ", file=sys.stderr)
        if would["risks"] and not (arguments.yes or agreed(f"promote {would['to']} all the same?")):
            told = tuple(would["risks"]) if arguments.json else ()
            raise AgentRefusedError(f"{would['name']} is left as it is; --yes promotes {would['to']} all the same", "Risk", told)
        answer = agent.ask("promote", **wanted, sure=True)
    answer["risks"] = would["risks"]
    return _tell(arguments, answer, f"{answer['name']} runs on {answer['to']} now, epoch {answer['epoch']}")


def agreed(question: str) -> bool:
    """Whether the person at the terminal says yes; False without a terminal."""
    if not sys.stdin.isatty():
        return False
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def prefer(arguments: argparse.Namespace) -> int:
    """Say which robot should run a component."""
    with connect(arguments) as agent:
        answer = agent.ask("prefer", name=arguments.name, robot=arguments.robot)
    return _tell(arguments, answer, f"{answer['name']} prefers {answer['robot']}")


def reserve(arguments: argparse.Namespace) -> int:
    """Let no other user give orders about it for a time."""
    with connect(arguments) as agent:
        answer = agent.ask("reserve", name=arguments.name, span_ms=arguments.span_ms, why=arguments.why)
    return _tell(arguments, answer, answer["sentence"] + _untold(answer))


def unreserve(arguments: argparse.Namespace) -> int:
    """End a reservation."""
    with connect(arguments) as agent:
        answer = agent.ask("unreserve", name=arguments.name, breaks=arguments.breaks)
    return _tell(arguments, answer, answer["sentence"] + _untold(answer))


def _untold(answer: dict[str, Any]) -> str:
    return f"; {', '.join(answer['untold'])} will hear of it later" if answer["untold"] else ""


def _tell(arguments: argparse.Namespace, answer: dict[str, Any], sentence: str) -> int:
    if arguments.json:
        render.as_json(answer)
    else:
        print(visible(sentence))
        _notes(answer)
    return 0
