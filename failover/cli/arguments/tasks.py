"""ps, task add, set, remove, run, run-once, import, histogram; trace, wait-activation: the schedule of a robot."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_json, add_place_of_board, add_repeated, wake_signal


def ps(room: argparse.ArgumentParser) -> None:
    """Of ``failover ps``."""
    add_place_of_board(room)
    add_repeated(room, 500)
    add_json(room)


def task(room: argparse.ArgumentParser) -> None:
    """Of ``failover task`` and its acts."""
    shared = argparse.ArgumentParser(add_help=False)
    add_json(shared)
    add_place_of_board(shared)
    acts = room.add_subparsers(dest="act", metavar="ACT", title="acts", required=True)
    for name, summary, description, function in (
        ("add", "declare a task", ADD_DESCRIPTION, "add"),
        ("set", "change a task while it runs", SET_DESCRIPTION, "change"),
    ):
        act = add_act(acts, name, shared, summary, description)
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
    act = add_act(acts, "remove", shared, "take tasks off the schedule", REMOVE_DESCRIPTION)
    act.add_argument("tasks", metavar="TASK", nargs="+", help="a task's name")
    act.set_defaults(function="failover.cli.verbs.tasks:remove")
    for name, summary, description, function in (
        ("run", "run a command at each activation", RUN_TASK_DESCRIPTION, "run"),
        ("run-once", "run a command once, after other tasks", RUN_ONCE_DESCRIPTION, "run_once"),
    ):
        act = add_act(acts, name, shared, summary, description)
        act.add_argument("task", metavar="TASK", help="the task's name")
        act.add_argument("words", metavar="KEY=VALUE … -- CMD", nargs="+", help="settings as of add; then the command, after --")
        if name == "run":
            how = act.add_mutually_exclusive_group()
            how.add_argument("--loop", action="store_true", help="start CMD once; it calls failover wait-activation")
            said = "start CMD once, and send it signal N at each activation (CONT: it stops itself to wait for the next one)"
            how.add_argument("--signal", metavar="N", type=wake_signal, default=0, help=said)
        else:
            act.add_argument("--in-ms", metavar="MS", type=float, default=0, help="not before so many milliseconds (default: 0)")
        act.set_defaults(function=f"failover.cli.verbs.task_programs:{function}")
    act = add_act(acts, "import", shared, "declare the tasks of CAMBADA's pman.conf", IMPORT_TASKS_DESCRIPTION)
    act.add_argument("file", metavar="FILE", help="the file; a line: name, period, phase, deadline, priority")
    act.add_argument("--tick-ms", metavar="MS", type=float, required=True, help="how long a tick of its process manager lasts")
    act.add_argument("--force", action="store_true", help="also if not all tasks would meet their deadlines then")
    act.set_defaults(function="failover.cli.verbs.task_files:import_file")
    act = add_act(acts, "histogram", shared, "how late it began, how long it took", HISTOGRAM_DESCRIPTION)
    act.add_argument("task", metavar="TASK", help="the task's name")
    act.set_defaults(function="failover.cli.verbs.tasks:histogram")


def trace(room: argparse.ArgumentParser) -> None:
    """Of ``failover trace``."""
    room.add_argument("-o", "--output", metavar="FILE", required=True, help="where to write it")
    room.add_argument("--for", dest="span", metavar="TIME", default="10s", help="how long to look (default: 10s)")
    add_place_of_board(room)
    add_json(room)


def wait_activation(room: argparse.ArgumentParser) -> None:
    """Of ``failover wait-activation``."""
    room.add_argument("-q", "--quiet", action="store_true", help="say nothing")
    add_json(room)


ADD_DESCRIPTION: Final = """
    Declare a task. A process runs it when one of that name begins. Without period_ms it runs once, or, with distance_ms, whenever
    its program triggers it.

      failover task add logger period_ms=1000 after=mapper
    """

SET_DESCRIPTION: Final = """
    Change a task that is declared. Its terms come into force between two of its activations: at once while it waits, or with
    --next when its next activation begins. A changed period goes on from the last instant that was due.

      failover task set mapper period_ms=100
      failover task set mapper mode=eco --next
    """

REMOVE_DESCRIPTION: Final = """
    Take tasks off the schedule. The loops of their programs come to an end, and tasks that run after them wait for them no more.

      failover task remove logger
    """

RUN_TASK_DESCRIPTION: Final = """
    Run a task whose program knows nothing of the schedule. CMD is run at each activation, which ends when CMD does. With --loop
    CMD is started once, and calls failover wait-activation for each. With --signal CONT it is started once, and stops itself
    (SIGSTOP) to wait; its activation ends when it stops again. With another signal, for which it must have a handler, the
    activation ends when it is sent. Without settings the task is one that is declared already.

      failover task run logger period_ms=1000 -- sh -c 'df / >> disk.log'
      failover task run --loop logger period_ms=1000 -- sh -c 'while failover wait-activation -q; do df / >> disk.log; done'
      failover task run --signal CONT logger period_ms=1000 -- sh -c 'while kill -STOP $$; do df / >> disk.log; done'
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

HISTOGRAM_DESCRIPTION: Final = """
    How late the activations of a task began, and how long they took: how many were below each bound.

      failover task histogram mapper
    """
