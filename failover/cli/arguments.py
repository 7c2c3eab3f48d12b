"""Arguments of each verb: one function per verb adds them to the verb's parser.

Only this file and `failover.cli.parser`, which has the verbs' names, help and examples, know argparse.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from textwrap import dedent
from typing import Any, Final

from checkpoint.device_rules import rule_from
from checkpoint.program import cpu_baseline
from checkpoint.sentences import near
from failover.config.choices import none_of
from failover.config.quantities import span_ms

EXIT_STATUSES: Final = "Exit status: 0 healthy, 1 failed or degraded, 2 usage, 3 no agent."


class Parser(argparse.ArgumentParser):
    """One that names the choices for a value that is none of them, and the one that was probably meant."""

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, none_of(value, action.choices))


# --- Arguments that several verbs share ------------------------------------------------------------------------------


def _json(room: argparse.ArgumentParser) -> None:
    room.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def _agent(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--socket",
        metavar="PATH",
        help="the agent's control socket (default: $FAILOVER_SOCKET, else your own, else the system's)",
    )
    _json(room)


def _name(room: argparse.ArgumentParser) -> None:
    room.add_argument("name", metavar="NAME", help="the component's name, as failover status shows it")


HOOKS: Final = {
    "before_capture": "before the agent takes a whole snapshot of it, and before the last one of a handover",
    "before_resume": "on a robot, before it resumes there",
    "after_resume": "on a robot, after it resumed there; FAILOVER_* variables tell robot, epoch, generation and reason",
}
"""Occasions for a command that comes with a program, and when they are."""

NUMBER_MAX: Final = (1 << 31) - 1
"""What a PID can be at most."""


def ago(text: str) -> int:
    """A span of time such as 90s or 10min, in milliseconds."""
    try:
        return span_ms(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def positive(text: str) -> int:
    """A whole number above zero, as a PID or a period is."""
    number = int(text) if text.isdecimal() and len(text) <= len(str(NUMBER_MAX)) else 0
    if not 0 < number <= NUMBER_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a whole number above zero, or too large a one")
    return number


def _pid(room: argparse._ActionsContainer, optional: bool = False) -> None:
    room.add_argument("pid", metavar="PID", type=positive, nargs="?" if optional else None, help="the process")


# --- Under an agent --------------------------------------------------------------------------------------------------


def run(room: argparse.ArgumentParser) -> None:
    """Of ``failover run``."""
    room.add_argument(
        "--name", metavar="NAME", help="its name, a path such as /lab/robot1/mapper (default: made from the command)"
    )
    room.add_argument("--detach", action="store_true", help="print the name and return; see failover logs")
    room.add_argument(
        "--no-isolate", dest="isolate", action="store_false", help="keep it in this machine's PIDs and clocks (default: its own)"
    )
    room.add_argument(
        "--engine",
        choices=("auto", "ptrace", "cooperative"),
        default="auto",
        help="ptrace: the agent captures the program from outside; cooperative: the program itself says what "
        "must survive (failover.resume, failover.component), and starts again from that (default: auto: the agent detects it)",
    )
    room.add_argument(
        "--portable",
        nargs="?",
        choices=("no", *cpu_baseline.LEVELS),
        const=cpu_baseline.DEFAULT,
        default="",
        metavar="LEVEL",
        help="have libraries choose code that every processor of a level can run, so that it can resume at lesser processors: "
        f"{', '.join(cpu_baseline.LEVELS)}, or no (default: as agent.toml says; without LEVEL: {cpu_baseline.DEFAULT})",
    )
    room.add_argument(
        "--output",
        choices=("immediate", "committed"),
        default="immediate",
        help="committed: show output only once another robot holds a checkpoint that contains it; then no takeover takes back or "
        "repeats output that you saw (default: immediate: show it as the program writes it)",
    )
    for hook, when in HOOKS.items():
        option = f"--{hook.replace('_', '-')}"
        room.add_argument(option, metavar="CMD", type=shlex.split, default=[], help=f"run this, as you, {when}")
    _carry(room)
    _shared(room)
    _devices(room)
    _connections(room, f"{RESETS}; carry: a handover takes those of TCP along; {REFUSES} (default: as agent.toml says: reset)")
    _shared_memory(room, "as agent.toml says: refuse")
    room.add_argument("--user", metavar="USER", help="run it as this user, by name or number (only root may; default: as you)")
    room.add_argument("command", metavar="CMD", nargs="+", help="the program and its arguments, after --")
    _agent(room)


def _carry(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--carry",
        metavar="PATH",
        action="append",
        default=[],
        help="send this file, or this folder with all its content, with the program, as it was at each checkpoint; may be "
        "given again (see docs/files.md)",
    )


def _shared(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--shared",
        metavar="PATH",
        action="append",
        default=[],
        help="other programs write to this file, or to files in this folder, too: where the program resumes, the file keeps "
        "its content there, and the restore sets only the program's offset; may be given again (see docs/files.md)",
    )


def _devices(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--device",
        metavar="PATH=RULE",
        dest="devices",
        action="append",
        type=device,
        default=[],
        help="the rule for a device that it has open: reopen, hook, optional, or the path of the device to open in its place; "
        "may be given again (see docs/devices.md)",
    )


RESETS: Final = "reset: its connections with others, of TCP and unix sockets, end where it resumes"
REFUSES: Final = "refuse: do not capture it while it has one"


def _connections(
    room: argparse.ArgumentParser, what: str, default: str = "", choices: Sequence[str] = ("reset", "carry", "refuse")
) -> None:
    room.add_argument("--connections", choices=choices, default=default, help=f"{what} (see docs/connections.md)")


def _shared_memory(room: argparse.ArgumentParser, default: str) -> None:
    room.add_argument(
        "--shared-memory",
        choices=("refuse", "detach"),
        default="",
        help="detach: shared memory that other processes have mapped too becomes a copy of its own where it resumes; the others "
        f"no longer see what it writes there (default: {default}; see docs/shared-memory.md)",
    )


def device(text: str) -> tuple[str, str]:
    """A path and its rule, which the agent reads."""
    path, is_there, rule = text.rpartition("=")
    if not is_there or not path.startswith("/"):
        raise argparse.ArgumentTypeError(f"{text!r}: name the device and its rule: /dev/ttyUSB0=reopen")
    try:
        rule_from(path, rule)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return path, rule


def protect(room: argparse.ArgumentParser) -> None:
    """Of ``failover protect``."""
    _pid(room)
    room.add_argument("--name", metavar="NAME", help="its name (default: /TEAM/ROBOT/pid-PID)")
    _carry(room)
    _shared(room)
    _devices(room)
    _connections(room, f"{RESETS}; carry: a handover takes those of TCP along; {REFUSES} (default: as agent.toml says: reset)")
    _shared_memory(room, "as agent.toml says: refuse")
    _agent(room)


def named(room: argparse.ArgumentParser) -> None:
    """Of a verb about one component that takes no more."""
    _name(room)
    _agent(room)


def stop(room: argparse.ArgumentParser) -> None:
    """Of ``failover stop``."""
    _name(room)
    room.add_argument("--signal", metavar="N", type=signal_number, default=15, help="number or name (default: TERM)")
    _agent(room)


def logs(room: argparse.ArgumentParser) -> None:
    """Of ``failover logs``."""
    _name(room)
    room.add_argument("-f", "--follow", action="store_true", help="follow until the program ends, or Ctrl-C")
    room.add_argument("--stream", type=int, choices=(1, 2), help="standard output (1) or standard error (2) alone")
    _agent(room)


def status(room: argparse.ArgumentParser) -> None:
    """Of ``failover status``."""
    room.add_argument("-w", "--watch", action="store_true", help="show it again and again, until Ctrl-C")
    room.add_argument("--every-ms", metavar="MS", type=positive, default=500, help="with --watch (default: 500)")
    _agent(room)


def why(room: argparse.ArgumentParser) -> None:
    """Of ``failover why``."""
    room.add_argument("name", metavar="NAME", nargs="?", help="only this component, and how its robots saw each other")
    room.add_argument("--robot", metavar="ROBOT", help="only the entries of that robot")
    room.add_argument("--since", metavar="AGO", type=ago, help="only younger entries: 90s, 10min, 2h, 3d")
    room.add_argument("-b", "--brief", action="store_true", help="one line each, without the facts below it")
    _agent(room)


def handover(room: argparse.ArgumentParser) -> None:
    """Of ``failover handover``."""
    _name(room)
    room.add_argument("--to", metavar="ROBOT", help="the target robot (default: its standby)")
    _agent(room)


def promote(room: argparse.ArgumentParser) -> None:
    """Of ``failover promote``."""
    _name(room)
    room.add_argument(
        "--robot", metavar="ROBOT", help="the robot that shall run it (default: the one with the newest checkpoint)"
    )
    room.add_argument("-y", "--yes", action="store_true", help="do not ask for confirmation, at any risk")
    _agent(room)


def prefer(room: argparse.ArgumentParser) -> None:
    """Of ``failover prefer``."""
    _name(room)
    room.add_argument("robot", metavar="ROBOT", help="the robot that should run it whenever it can")
    _agent(room)


def signal_number(text: str) -> int:
    """A signal's number, from a number or a name with or without SIG."""
    import signal

    try:
        return signal.Signals(int(text)) if text.isdecimal() else signal.Signals["SIG" + text.upper().removeprefix("SIG")]
    except (ValueError, KeyError):
        meant = near(text.upper(), (one.name.removeprefix("SIG") for one in signal.Signals))
        raise argparse.ArgumentTypeError(f"{text!r} is no signal; give a number or a name such as TERM{meant}") from None


# --- One shot: no agent needed ---------------------------------------------------------------------------------------


def capture(room: argparse.ArgumentParser) -> None:
    """Of ``failover capture``."""
    _pid(room)
    room.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        required=True,
        help="the snapshot's file; written whole or not at all, readable by you alone",
    )
    room.add_argument(
        "--leave-running", action="store_true", help="leave the program running (default: end it once the snapshot is safe)"
    )
    room.add_argument("--force", action="store_true", help="replace FILE if it exists")
    _shared(room)
    _devices(room)
    carries = "carry: take those of TCP along, or refuse the capture; not with --leave-running"
    _connections(room, f"{RESETS}; {carries}; {REFUSES} (default: reset)", "reset")
    _shared_memory(room, "refuse")
    _json(room)


def restore(room: argparse.ArgumentParser) -> None:
    """Of ``failover restore``."""
    room.add_argument("file", metavar="FILE", help="a snapshot made by failover capture")
    room.add_argument("--wait", action="store_true", help="stay until the program ends, and pass on its exit status")
    room.add_argument(
        "--trust",
        action="store_true",
        help="give the program all rights that FILE asks for, also if FILE is not root's (default: its owner's at most)",
    )
    _shared(room)
    _devices(room)
    what = (
        "carry: take up all TCP connections with others, or refuse the restore; reset: take up none "
        "(default: take up those that the capture took along, where that is possible)"
    )
    _connections(room, what, choices=("reset", "carry"))
    _json(room)


def inspect(room: argparse.ArgumentParser) -> None:
    """Of ``failover inspect``."""
    room.add_argument("file", metavar="FILE", help="a snapshot's file")
    room.add_argument("--vmas", action="store_true", help="list every mapping as well")
    _json(room)


def check(room: argparse.ArgumentParser) -> None:
    """Of ``failover check``."""
    either = room.add_mutually_exclusive_group()
    _pid(either, optional=True)
    either.add_argument("--table", action="store_true", help="show what failover preserves of any program, and what it refuses")
    _agent(room)


def team(room: argparse.ArgumentParser) -> None:
    """Of ``failover team`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--directory", metavar="DIR", default="/etc/failover/team", help="the team directory (default: %(default)s)"
    )
    _json(shared)
    create = _act(acts, "create", shared, "begin a team", CREATE_DESCRIPTION)
    create.add_argument("name", metavar="TEAM", help="the team's name")
    create.set_defaults(function="failover.cli.verbs.team:create")
    enrol = _act(acts, "enrol", shared, "add a robot, a server or a witness and make its key", ENROL_DESCRIPTION)
    enrol.add_argument("name", metavar="ROBOT", help="the robot's name")
    enrol.add_argument(
        "address",
        metavar="HOST[:PORT]",
        nargs="+",
        help="where it receives heartbeats: one address for each of its links (port 7420)",
    )
    enrol.add_argument(
        "--bulk", metavar="HOST[:PORT]", help="where it receives snapshots, on the wired link (default: first HOST, port 7421)"
    )
    enrol.add_argument(
        "--role",
        choices=("robot", "server", "witness"),
        help="robot: runs components; server: keeps checkpoints of all and votes; witness: votes only (default: robot)",
    )
    enrol.add_argument("--public-key", metavar="KEY", help="the public half of a key made on the robot itself")
    enrol.add_argument("--replace", action="store_true", help="give a known robot new addresses and a new key")
    enrol.set_defaults(function="failover.cli.verbs.team:enrol")
    show = _act(acts, "show", shared, "list the team", "Show every robot with its addresses and its public key.")
    show.set_defaults(function="failover.cli.verbs.team:show")


CREATE_DESCRIPTION: Final = """
    Make the team directory with an empty team file. Do this once, anywhere; failover team enrol adds the robots.

      failover team create lab
    """

ENROL_DESCRIPTION: Final = """
    Add a robot to the team file and make its key pair. The team file then goes to every robot. The secret key (keys/ROBOT.secret)
    belongs to that robot alone: enrolled on another machine, copy it to the robot and remove it here. Or make the pair on the
    robot (failover-agent keypair), so that the secret never travels, and enrol its public half. Agents read the team file when
    they start.

      failover team enrol robot1 192.168.7.11
      failover team enrol robot2 192.168.7.12 10.0.0.12 --bulk 192.168.7.12
      failover team enrol hall 192.168.7.2 --role server
      failover team enrol robot3 192.168.7.13 --public-key 'lU^njTi%j-s0Um6-=T!3XtpbYKc@&EDt>F+fX01f'
    """


# --- Rights ----------------------------------------------------------------------------------------------------------


def rights(room: argparse.ArgumentParser) -> None:
    """Of ``failover rights`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--directory", metavar="DIR", default="/etc/failover/team", help="the team directory (default: %(default)s)"
    )
    _agent(shared)
    listed = _act(
        acts, "list", shared, "the rules, each with its line", "Show every rule of rights.toml with the line where it stands."
    )
    listed.set_defaults(function="failover.cli.verbs.rights:show")
    why = _act(acts, "why", shared, "may this user do this there, and by which rule", WHY_DESCRIPTION)
    why.add_argument("user", metavar="USER", help="who asks")
    why.add_argument("right", metavar="VERB", help="see, read, call, put, operate, start, program or grant")
    why.add_argument("path", metavar="PATH", help="a component, a driver, a robot")
    why.add_argument("--groups", metavar="GROUP,...", help="take these groups (default: by the source of groups in rights.toml)")
    why.set_defaults(function="failover.cli.verbs.rights:why")


WHY_DESCRIPTION: Final = """
    Ask the rules one question. The answer names the rule that decides, its line, the group and the pattern of paths. Exit status
    1: it is denied. Where groups come from a directory server, the agent asks it: about yourself, as root about every user.

      failover rights why user1 call University/Lab/Robotino/Engines/3/PWM
      failover rights why user1 operate /lab/robot1/mapper --groups operators,staff
    """


# --- Drivers ---------------------------------------------------------------------------------------------------------

SECONDS_MAX: Final = 86_400.0


def names(room: argparse.ArgumentParser) -> None:
    """Of ``failover names``."""
    room.add_argument("prefix", metavar="PATH", nargs="?", default="", help="only what is registered there or below")
    _json(room)


def call(room: argparse.ArgumentParser) -> None:
    """Of ``failover call``."""
    _name_of_driver(room)
    room.add_argument("call_verb", metavar="ACT", help="what it is to do: a verb that failover names shows")
    room.add_argument("body", metavar="JSON", nargs="?", help="with what: a table of its arguments, or the only one")
    _timeout(room)
    _json(room)


def send(room: argparse.ArgumentParser) -> None:
    """Of ``failover send``."""
    _name_of_driver(room)
    room.add_argument("message", metavar="JSON", help="a message, as ENVELOPE.md says; - reads it from standard input")
    _timeout(room)
    _json(room)


def graph(room: argparse.ArgumentParser) -> None:
    """Of ``failover graph``."""
    room.add_argument("-w", "--watch", action="store_true", help="show it again and again, until Ctrl-C")
    room.add_argument("--every-ms", metavar="MS", type=positive, default=2_000, help="with --watch (default: 2000)")
    room.add_argument("--dot", action="store_true", help="print a graph for Graphviz")
    _json(room)


def path(room: argparse.ArgumentParser) -> None:
    """Of ``failover path``."""
    room.add_argument("id", metavar="ID", help="of the message, as failover call --json prints it")
    _json(room)


def _name_of_driver(room: argparse.ArgumentParser) -> None:
    room.add_argument("name", metavar="NAME", help="a driver: its path, an alias, or an address")


def _timeout(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--timeout-s", metavar="S", type=_seconds, default=5.0, help="seconds to wait for the answer (default: %(default)s)"
    )


def _seconds(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number <= SECONDS_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no number of seconds above 0")
    return number


# --- The board -------------------------------------------------------------------------------------------------------


def board(room: argparse.ArgumentParser) -> None:
    """Of ``failover board`` and its acts."""
    shared = argparse.ArgumentParser(add_help=False)
    _json(shared)
    _place_of_board(room)
    _repeated(room, 500)
    _json(room)
    acts = room.add_subparsers(dest="act", metavar="ACT", title="acts")
    of_board = argparse.ArgumentParser(add_help=False, parents=[shared])
    _place_of_board(of_board)
    get = _act(acts, "get", of_board, "one item's value, how old it is, and how old it can be at most", GET_DESCRIPTION)
    get.add_argument("path", metavar="ROBOT/ITEM", help="an item of a robot; ITEM alone: of this robot")
    get.add_argument("--watch", action="store_true", help="print each new value until Ctrl-C")
    get.set_defaults(function="failover.cli.verbs.board:get")
    put = _act(acts, "put", of_board, "put a value of this robot", PUT_DESCRIPTION)
    put.add_argument("path", metavar="ITEM", help="an item of this robot")
    put.add_argument("value", metavar="JSON", help="the value; bytes in hexadecimal; - reads it from standard input")
    put.set_defaults(function="failover.cli.verbs.board:put")
    top = _act(acts, "top", of_board, "rates, sizes, ages and losses of every item", TOP_DESCRIPTION)
    _repeated(top, 1000)
    top.set_defaults(function="failover.cli.verbs.board:top")
    users = _act(acts, "users", of_board, "the programs that have the board open", USERS_DESCRIPTION)
    users.set_defaults(function="failover.cli.verbs.board:users")
    of_team = argparse.ArgumentParser(add_help=False, parents=[shared])
    of_team.add_argument(
        "--directory", metavar="DIR", default="/etc/failover/team", help="the team directory (default: %(default)s)"
    )
    header = _act(acts, "header", of_team, "the items as a C header", HEADER_DESCRIPTION)
    header.add_argument(
        "--rtdb", action="store_true", help="also numbers of items and agents under their own names, for failover_rtdb.h"
    )
    header.set_defaults(function="failover.cli.verbs.board_files:header")
    imported = _act(acts, "import", shared, "an rtdb.conf as a table of team.toml", IMPORT_DESCRIPTION)
    imported.add_argument("file", metavar="FILE", help="CAMBADA's rtdb.conf, or RTDB2's rtdb2_configuration.xml")
    imported.add_argument(
        "-I", dest="include", metavar="DIR", action="append", default=[], help="a folder with headers; may be given again"
    )
    imported.add_argument("--cc", metavar="COMMAND", help="the C++ compiler (default: $CXX, else g++, c++ or clang++)")
    imported.add_argument(
        "--robot", metavar="AGENT=ROBOT", type=_pair, action="append", default=[], help="the robot that is this agent of the file"
    )
    imported.add_argument(
        "--size", metavar="BYTES", type=_whole, default=1024, help="the most bytes of a key of an XML file (default: %(default)s)"
    )
    imported.set_defaults(function="failover.cli.verbs.board_files:import_file")


def ps(room: argparse.ArgumentParser) -> None:
    """Of ``failover ps``."""
    _place_of_board(room)
    _repeated(room, 500)
    _json(room)


SET_DESCRIPTION: Final = """
    Change a task that is declared. Its terms come into force between two of its activations: at once while it waits, or with
    --next when its next activation begins. A changed period goes on from the last instant that was due.

      failover task set mapper period_ms=100
      failover task set mapper mode=eco --next
    """

ADD_DESCRIPTION: Final = """
    Declare a task. A process runs it when one of that name begins. Without period_ms it runs once, or, with distance_ms, whenever
    its program triggers it.

      failover task add logger period_ms=1000 after=mapper
    """

REMOVE_DESCRIPTION: Final = """
    Take tasks off the schedule. The loops of their programs come to an end, and tasks that run after them wait for them no more.

      failover task remove logger
    """

RUN_TASK_DESCRIPTION: Final = """
    Run a task whose program knows nothing of the schedule. CMD is run at each activation, which ends when CMD does. With --loop
    CMD is started once, and calls failover wait-activation for each. Without settings the task is one that is declared already.

      failover task run logger period_ms=1000 -- sh -c 'df / >> disk.log'
      failover task run --loop logger period_ms=1000 -- sh -c 'while failover wait-activation -q; do df / >> disk.log; done'
    """

RUN_ONCE_DESCRIPTION: Final = """
    Run CMD once, after the activations of its predecessors that are due by then. The exit status is that of CMD.

      failover task run-once calibrate after=odometry -- ./calibrate
      failover task run-once calibrate --in-ms 500 -- ./calibrate
    """


IMPORT_TASKS_DESCRIPTION: Final = """
    Declare the tasks of a file, all of them or none. A tick of CAMBADA's process manager is a frame of its camera: 33 ms at 30
    frames a second. A deadline longer than the period makes the task wait for itself (overrun=queue).

      failover task import pman.conf --tick-ms 33
    """


def trace(room: argparse.ArgumentParser) -> None:
    """Of ``failover trace``."""
    room.add_argument("-o", "--output", metavar="FILE", required=True, help="where to write it")
    room.add_argument("--for", dest="span", metavar="TIME", default="10s", help="how long to look (default: 10s)")
    _place_of_board(room)
    _json(room)


def wait_activation(room: argparse.ArgumentParser) -> None:
    """Of ``failover wait-activation``."""
    room.add_argument("-q", "--quiet", action="store_true", help="say nothing")
    _json(room)


HISTOGRAM_DESCRIPTION: Final = """
    How late the activations of a task began, and how long they took: how many were below each bound.

      failover task histogram mapper
    """


def task(room: argparse.ArgumentParser) -> None:
    """Of ``failover task`` and its acts."""
    shared = argparse.ArgumentParser(add_help=False)
    _json(shared)
    _place_of_board(shared)
    acts = room.add_subparsers(dest="act", metavar="ACT", title="acts", required=True)
    for name, summary, description, function in (
        ("add", "declare a task", ADD_DESCRIPTION, "add"),
        ("set", "change a task while it runs", SET_DESCRIPTION, "change"),
    ):
        act = _act(acts, name, shared, summary, description)
        act.add_argument("task", metavar="TASK", help="the task's name")
        act.add_argument(
            "settings",
            metavar="KEY=VALUE",
            nargs="+",
            help="period_ms, phase_ms, deadline_ms, budget_ms, distance_ms, priority, cpus, after, overrun, strict, mode",
        )
        act.add_argument("--force", action="store_true", help="also if not all tasks would meet their deadlines then")
        if name == "set":
            act.add_argument("--next", action="store_true", help="in force from the task's next activation on")
        act.set_defaults(function=f"failover.cli.verbs.tasks:{function}")
    act = _act(acts, "remove", shared, "take tasks off the schedule", REMOVE_DESCRIPTION)
    act.add_argument("tasks", metavar="TASK", nargs="+", help="a task's name")
    act.set_defaults(function="failover.cli.verbs.tasks:remove")
    for name, summary, description, function in (
        ("run", "run a command at each activation", RUN_TASK_DESCRIPTION, "run"),
        ("run-once", "run a command once, after other tasks", RUN_ONCE_DESCRIPTION, "run_once"),
    ):
        act = _act(acts, name, shared, summary, description)
        act.add_argument("task", metavar="TASK", help="the task's name")
        act.add_argument("words", metavar="KEY=VALUE … -- CMD", nargs="+", help="settings as of add; then the command, after --")
        if name == "run":
            act.add_argument("--loop", action="store_true", help="start CMD once; it calls failover wait-activation")
        else:
            act.add_argument("--in-ms", metavar="MS", type=float, default=0, help="not before so many milliseconds (default: 0)")
        act.set_defaults(function=f"failover.cli.verbs.task_programs:{function}")
    act = _act(acts, "import", shared, "declare the tasks of CAMBADA's pman.conf", IMPORT_TASKS_DESCRIPTION)
    act.add_argument("file", metavar="FILE", help="the file; a line: name, period, phase, deadline, priority")
    act.add_argument("--tick-ms", metavar="MS", type=float, required=True, help="how long a tick of its process manager lasts")
    act.add_argument("--force", action="store_true", help="also if not all tasks would meet their deadlines then")
    act.set_defaults(function="failover.cli.verbs.task_files:import_file")
    act = _act(acts, "histogram", shared, "how late it began, how long it took", HISTOGRAM_DESCRIPTION)
    act.add_argument("task", metavar="TASK", help="the task's name")
    act.set_defaults(function="failover.cli.verbs.tasks:histogram")


def _place_of_board(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--board", metavar="DIR", help="the board's directory (default: $FAILOVER_BOARD, else the agent's, else this user's)"
    )


def _repeated(room: argparse.ArgumentParser, every_ms: int) -> None:
    room.add_argument("--watch", action="store_true", help="again and again until Ctrl-C")
    room.add_argument(
        "--every-ms",
        metavar="MS",
        type=_whole,
        default=every_ms,
        help="the span over which rates are taken (default: %(default)s)",
    )


def _pair(text: str) -> tuple[str, str]:
    agent, separator, robot = text.partition("=")
    if not separator or not agent or not robot:
        raise argparse.ArgumentTypeError(f"{text!r} is no AGENT=ROBOT")
    return agent, robot


def _whole(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 0 < int(text[:10]) <= NUMBER_MAX:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 1 to {NUMBER_MAX}")
    return int(text)


GET_DESCRIPTION: Final = """
    Print the newest value of an item as JSON, its age, and the age that it can have at most. Exit status 1: the value may be
    older than its bound.

      failover board get ball
      failover board get robot2/ball --json | jq .value.x
      failover board get robot2/ball --watch
    """

PUT_DESCRIPTION: Final = """
    Put a value by hand, for a test or from a shell script. One process at a time writes an item: while a program writes it, this
    command is refused and names the program.

      failover board put ball '{"x": 1.0, "y": 2.5, "v": [0, 0], "seen": 1}'
      failover board put goal '"00ff"'
    """

TOP_DESCRIPTION: Final = """
    Show, over a span, how often each item is put, how old its newest value was at half and at 99 of 100 looks, and how many
    frames carried it or were lost.

      failover board top
      failover board top --every-ms 5000 --json
    """

USERS_DESCRIPTION: Final = """
    List the programs that have this robot's board open. The kernel tells: a program that was killed is not in the list.

      failover board users
    """

HEADER_DESCRIPTION: Final = """
    Print the items of team.toml as a C header: a struct for each, its number, size and digest, and assertions that the compiler
    lays the structs out as the board does. It compiles as C11 and as C++11.

      failover board header > items.h
      failover board header --directory ~/team --rtdb > items.h
    """

IMPORT_DESCRIPTION: Final = """
    Read CAMBADA's rtdb.conf and print its items as the table [board] of team.toml, with the sizes of their C types. This command
    compiles a file that only names the types, and reads the sizes from the object file: it runs nothing of yours, and works with
    a compiler for the robots' processor. An agent needs no compiler. A mistake in the file is told with line and column.

    RTDB2's XML has no types: its keys become msgpack items of 1024 bytes.

      failover board import rtdb.conf -I include >> team.toml
      failover board import rtdb.conf -I include --cc "aarch64-linux-gnu-g++" --robot BASE_STATION=base
      failover board import rtdb2_configuration.xml >> team.toml
    """


def _act(acts: Any, name: str, shared: argparse.ArgumentParser, summary: str, description: str) -> argparse.ArgumentParser:
    """One act of ``failover team``."""
    room: argparse.ArgumentParser = acts.add_parser(
        name,
        parents=[shared],
        help=summary,
        description=dedent(description).strip(),
        epilog=EXIT_STATUSES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    return room


def demo(room: argparse.ArgumentParser) -> None:
    """Of ``failover demo``."""
    room.add_argument("--picture", metavar="FILE", help="write what was shown to FILE as an SVG picture too")
    _json(room)


def completion(room: argparse.ArgumentParser) -> None:
    """Of ``failover completion``."""
    room.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="the shell to complete for")
