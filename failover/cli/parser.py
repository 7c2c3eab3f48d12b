"""Parser of the command line: every verb with its help and its examples; `failover.cli.arguments` has each verb's arguments.

A verb is a row of the table at the bottom. The row names two functions as ``module:function``: one adds the verb's arguments, one
carries it out. They are loaded when the verb is used, so that ``failover status`` does not pay for ``failover demo``.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from textwrap import dedent
from typing import Any, Final

from msgspec import Struct

from failover import __version__
from failover.cli.arguments.shared import EXIT_STATUSES, Parser

DESCRIPTION: Final = """
When a robot dies, its programs resume at another robot, from where they were a fraction of a second ago.

  failover demo                    see it happen on this machine, in half a minute
  failover check                   what this machine offers, and what it lacks
  failover run -- CMD              start a program under protection (needs an agent)
  failover status                  the robots, their components, and what is degraded
  failover VERB --help             a verb with examples
"""

PLACES: Final = """
Files and environment:
  $FAILOVER_SOCKET                 the agent's control socket; without it $XDG_RUNTIME_DIR/failover/control.sock if that is
                                   there, else /run/failover/control.sock
  $FAILOVER_WORLD                  Simulated: paths and robots' names mean those of failover simulate
  /etc/failover/agent.toml         the agent's configuration, every key with its default
  /etc/failover/team               who belongs (team.toml, the same on every robot) and this robot's secret key;
                                   $FAILOVER_TEAM names another place
  /var/lib/failover                snapshots and streams
  $NO_COLOR                        no colours
"""


class Verb(Struct, frozen=True):
    """One verb of the command line.

    Attributes:
        summary: one line, for the list of verbs.
        description: what it does, and examples; dedented before it is shown.
        arguments: ``module:function``; takes the verb's parser, adds the verb's own arguments to it.
        function: ``module:function``; takes the parsed arguments, returns the exit status.
    """

    name: str
    summary: str
    description: str
    arguments: str
    function: str


def build(verb: str = "") -> argparse.ArgumentParser:
    """The whole parser; of one verb's words the part that can read them, which takes a tenth of the time."""
    parser = Parser(
        prog="failover",
        description=DESCRIPTION.strip(),
        epilog=f"{PLACES.strip()}\n\n{EXIT_STATUSES} failover run and restore --wait: the program's own.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"failover {__version__}")
    rooms = parser.add_subparsers(dest="verb", metavar="VERB", required=True, title="verbs")
    for one in [one for one in VERBS if one.name == verb] or VERBS:
        room = rooms.add_parser(
            one.name,
            help=one.summary,
            description=dedent(one.description).strip(),
            epilog=EXIT_STATUSES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        room.set_defaults(function=one.function)
        load(one.arguments)(room)
    return parser


def load(name: str) -> Any:
    """The function that ``module:function`` names."""
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)


VERBS: Final = (
    Verb(
        "demo",
        "two robots on this machine, real programs, a power cut: the programs resume",
        """
        Start two agents on this machine, run ordinary programs under protection on the first, cut its power, and see them resume
        at the second. Exit status 0 only if their whole output equals an undisturbed run, byte for byte. Takes under a minute
        and removes everything it made. Run as root, it gives each robot a network of its own.

          failover demo
          failover demo --json | jq .programs[0].outage_ms
        """,
        "failover.cli.arguments.one_shot:demo",
        "failover.cli.demo.play:demo",
    ),
    Verb(
        "run",
        "start a program under protection; show its output, and end with its exit status",
        """
        Start a program as a component of this robot. The agent sends snapshots of it to its standby. When this robot dies, the
        program resumes there. This command passes Ctrl-C on to the program and ends with its exit status (128 + N if signal N
        ended it). With --json it prints on standard error how the program was started.

        This command keeps waiting, and shows each byte once, while the agent restarts, and while the program moves to another
        robot and ends there. If no agent answers for half a minute, the exit status is 3; the program runs on.

        After a takeover the program resumes from the newest checkpoint. It writes again what it wrote since then, and that may
        differ from what you saw. With --output=committed this command and failover logs show output only once another robot
        holds it. While the component has no standby, that output waits, and failover status says so. When 8 MiB of a stream
        wait, the program waits in its next write.

        The program runs as you, with your groups, limits, priorities, environment, directory and umask, as if your shell had
        started it. Only you and root may read its output, stop, release or move it, on any robot that knows you by the same
        number.

        Its standard output and error are pipes of its own, not this terminal, and its standard input is empty: it does not see a
        terminal even where you have one. Many programs then write by the block and not by the line; python3 -u, or stdbuf -oL
        before other commands, shows their output at once.

          failover run -- python3 mapper.py --map hall.yaml
          failover run --name /lab/robot1/mapper --detach -- ./mapper
          failover run -- sh -c 'python3 counter.py --from hall; true'

        The agent detects a program that says what must survive (docs/decorator.md), also below a shell or a launcher. Until the
        program says so, the agent captures it from outside, like any other program.
        """,
        "failover.cli.arguments.components:run",
        "failover.cli.verbs.components:run",
    ),
    Verb(
        "protect",
        "protect a process that already runs",
        """
        Protect a running process. It keeps its standard streams. Streams that are files continue at the other robot. failover
        does not keep output to a terminal or a pipe, and will not know the exit status. If the process holds something that
        failover cannot preserve, failover names it, refuses, and leaves the process untouched (failover check PID lists it all).

          failover protect 4711 --name /lab/robot1/mapper
        """,
        "failover.cli.arguments.components:protect",
        "failover.cli.verbs.components:protect",
    ),
    Verb(
        "release",
        "end protection; the program runs on, unprotected",
        """
        End protection. The program runs on, untouched. Every robot forgets its checkpoints, so no robot takes it over. The team
        also forgets a component that has ended or failed, and status no longer shows it. Give this order at any robot.

          failover release /lab/robot1/mapper
        """,
        "failover.cli.arguments.components:named",
        "failover.cli.verbs.components:release",
    ),
    Verb(
        "start",
        "start a component that agent.toml declares, after its end",
        """
        Start a component that agent.toml declares, [tasks."NAME"], from its beginning: after failover stop, or after it has
        failed or ended. Its starts are counted anew (restart_limit). Give this order at any robot; the robot that ran it last
        carries it out.

          failover start /lab/robot1/mapper
        """,
        "failover.cli.arguments.components:named",
        "failover.cli.verbs.components:start",
    ),
    Verb(
        "stop",
        "end a component's program; no robot runs it again",
        """
        Send the program a signal and wait for its end, which the standby records too. After 10 seconds the agent kills it.
        Give this order at any robot.

          failover stop /lab/robot1/mapper
          failover stop /lab/robot1/mapper --signal INT
        """,
        "failover.cli.arguments.components:stop",
        "failover.cli.verbs.components:stop",
    ),
    Verb(
        "status",
        "the team as a tree: role, epoch, lag, freeze, standby, links, and the promise that holds now",
        """
        Show every robot, its components, how old their newest checkpoint is (lag), how long a snapshot stops them (freeze), and
        in one sentence what holds if this robot dies now. Exit status 1 says that something is degraded: failover cannot capture
        a program, checkpoints do not arrive, a component has no protection, a robot is silent. Notes below the tree name each.
        NO_COLOR=1 switches colours off. A narrow terminal shows a list instead of a table. With NAME it is about one component.

          failover status
          failover status mapper
          failover status --brief
          failover status --watch
          failover status --json | jq '.components[].lag_ms'
        """,
        "failover.cli.arguments.status:status",
        "failover.cli.verbs.status:status",
    ),
    Verb(
        "top",
        "the team on one screen, live: robots, components, tasks, notes, orders",
        """
        Show robots with their links, components with state, age of the newest checkpoint, freeze, processor time and memory (of
        this robot), their tasks with misses, and the notes of failover status, as long as it runs. Keys: the arrows choose a
        line; Enter shows why a component is where it is; / filters, s sorts; h hands a component over, b moves it back, x ends
        it, each after a question; q leaves. It needs a terminal and the extra "tui".

          failover top
          failover top --every-ms 200
        """,
        "failover.cli.arguments.status:top",
        "failover.cli.verbs.top:top",
    ),
    Verb(
        "logs",
        "output of a component, without gap or repetition, from any robot",
        """
        Show standard output and standard error of a component from its beginning (at most the last 256 MB of each), as far as no
        takeover can take it back, and all of it once the component has ended. Give this order at any robot. --follow continues
        through a takeover. The times of --times and --since are those of the robot that answers, exact to a tenth of a second for
        the last minutes and coarser before: when the program wrote it, or, at a standby, when a checkpoint brought it there.

          failover logs /lab/robot1/mapper
          failover logs --follow --stream 2 /lab/robot1/mapper
          failover logs --tail 20 --times mapper
          failover logs --since 10min mapper
        """,
        "failover.cli.arguments.components:logs",
        "failover.cli.verbs.logs:logs",
    ),
    Verb(
        "why",
        "the event log: the last decisions and their reasons",
        """
        Show what each robot saw and decided, and when. This command merges the event logs of all robots that answer, in the order
        of events, even if a clock is wrong. Below each decision stands what the robot knew: how long every peer had been silent
        on which link, and after how long it counts as dead; whether the robot's own loop had been late; from which checkpoint it
        could resume the component, and how old that was. Each robot keeps its log on disk, over restarts (about 4 MB a robot).

          failover why
          failover why /lab/robot1/mapper --since 10min
          failover why --robot robot2 --brief
        """,
        "failover.cli.arguments.status:why",
        "failover.cli.verbs.why:why",
    ),
    Verb(
        "handover",
        "move a component to another robot, planned: nothing is lost",
        """
        This robot sends the last changes, then the other robot resumes the component; this command ends when it runs there. Only
        the standby can take it, because it has the checkpoints. If the move fails, the component stays where it is. Give this
        order at any robot.

          failover handover /lab/robot1/mapper
          failover handover /lab/robot1/mapper --to robot2
        """,
        "failover.cli.arguments.components:handover",
        "failover.cli.verbs.components:handover",
    ),
    Verb(
        "failback",
        "move a component back to its preferred robot",
        """
        Move the component to the robot that it prefers, or else to the one where it was started; planned, as a handover.
        Give this order at any robot.

          failover failback /lab/robot1/mapper
        """,
        "failover.cli.arguments.components:named",
        "failover.cli.verbs.components:failback",
    ),
    Verb(
        "drill",
        "try a takeover of one component: move it to its standby and back, measure both",
        """
        Move the component to its standby, wait until it is protected there, move it back, and report: for how long its program
        stood still each time (from the instant at which the robot before took the last state to the first act at the other one),
        whether its output went on, how soon it was protected again. Nothing is lost by it. First this command tells what it will
        do; then it asks for confirmation; without a terminal it does nothing unless you give --yes. It refuses a component that
        is not protected. If a step fails, the component stays where it is then, and this command says where that is.

        Exit status 1: something was not as promised, or took longer than --at-most-ms. A real loss takes longer, by the silence
        after which a robot is replaced, and loses what was done since the last checkpoint; the report says both figures.

          failover drill mapper
          failover drill mapper --yes --at-most-ms 500 --json
        """,
        "failover.cli.arguments.components:drill",
        "failover.cli.verbs.drill:drill",
    ),
    Verb(
        "promote",
        "run a component that is held, without waiting for silent robots",
        """
        Have a robot run the component now, from the checkpoint that the robot holds, or from where the frozen program is: after
        the loss of a robot under on_loss = "hold", or where when_alone = "freeze" freezes it, or where a majority waits for a
        robot that may hold a newer checkpoint. First this command tells what would be lost, and what may go wrong: a silent robot
        may be alive, cut off, and run the component too. Then it asks for confirmation; without a terminal it does nothing unless
        you give --yes. The component runs under a new epoch, above any that a silent robot can have opened. The team refuses
        while a robot that it hears has the component, and under rule = "majority" without a majority. Give this order at any
        robot.

          failover promote /lab/robot1/mapper
          failover promote /lab/robot1/mapper --robot robot2 --yes
        """,
        "failover.cli.arguments.components:promote",
        "failover.cli.verbs.components:promote",
    ),
    Verb(
        "prefer",
        "choose the robot that should run a component",
        """
        The component moves there as soon as that robot holds its checkpoints, and again after each takeover, once that robot
        keeps up. An empty ROBOT ('') leaves it where it runs. Give this order at any robot.

          failover prefer /lab/robot1/mapper robot1
        """,
        "failover.cli.arguments.components:prefer",
        "failover.cli.verbs.components:prefer",
    ),
    Verb(
        "reserve",
        "for a time, let no other user give orders about a component, or about all below a path",
        """
        Orders of other users are refused with one sentence, which says who has reserved it, until when and why: handover,
        failback, prefer, promote, release, start, stop; run and protect under such a name; drain of a robot that runs it. A
        takeover is no order, and asks nothing. A reservation ends by itself. To prolong it, reserve again. A user who may give
        orders about it, and about each component below it, may reserve it; without rights.toml its owner may, and only root
        all below a path. Give this order at any robot.

          failover reserve mapper --for 10min --why calibration
          failover reserve /lab/robot1 --for 2h --why "new wheels"
        """,
        "failover.cli.arguments.components:reserve",
        "failover.cli.verbs.components:reserve",
    ),
    Verb(
        "unreserve",
        "end a reservation before its time",
        """
        The user who has reserved it may. With --break root may, too, and each user to whom rights.toml gives grant there; that
        ends all at and below the path.

          failover unreserve mapper
          failover unreserve /lab/robot1 --break
        """,
        "failover.cli.arguments.components:unreserve",
        "failover.cli.verbs.components:unreserve",
    ),
    Verb(
        "drain",
        "before maintenance: move everything away from a robot, and let nothing new run there",
        """
        What the robot runs moves to its standbys, one planned move after the other: nothing is lost. Nothing new is started
        there, also after a restart of its agent or of the robot, until failover undrain. The robot goes on to vote and to keep
        checkpoints; it takes a component over only where no other robot could. This command waits until each component runs
        elsewhere, and says what cannot move, and why. Give this order at any robot, as root.

          failover drain robot1
          failover drain robot1 --timeout 0      # do not wait
        """,
        "failover.cli.arguments.components:drain",
        "failover.cli.verbs.drain:drain",
    ),
    Verb(
        "undrain",
        "after maintenance: let a robot run components again",
        """
        Components come back to it by the rules: those that prefer it (failover prefer), by failover failback, and whatever is
        started there. Give this order at any robot, as root.

          failover undrain robot1
        """,
        "failover.cli.arguments.components:undrain",
        "failover.cli.verbs.drain:undrain",
    ),
    Verb(
        "lost",
        "where two copies of a component ran: the state of the one that lost",
        """
        Two robots alone that were cut from each other may both have run a component. When they meet again one copy stays, and
        the state of the other one is kept at its robot. failover status tells of it until a person has looked. These acts need
        root, and no agent.

          failover lost list
          failover lost inspect mapper
          failover lost restore mapper
          failover lost remove mapper
        """,
        "failover.cli.arguments.lost:lost",
        "failover.cli.verbs.lost:listed",
    ),
    Verb(
        "archive",
        "copies of checkpoints in an object store, for the day on which no robot has them",
        """
        Robots and servers with [store] s3 in agent.toml send sealed copies of whole checkpoints to an object store. These acts
        make the key, list the copies, and bring one to a machine that has nothing but the team's keys (docs/archive.md).

          failover archive key
          failover archive list
          failover archive fetch mapper --output mapper.snapshot
        """,
        "failover.cli.arguments.archive:archive",
        "failover.cli.verbs.archive:listed",
    ),
    Verb(
        "team",
        "the robots of the team, and their keys",
        """
        Begin a team, bring robots into it, take them out, list them. No agent is restarted for that. The team file is the same on
        every robot and holds nothing secret; a robot's secret key stays on that robot alone. failover team ACT --help explains
        an act.

          failover team create lab                             # on the first robot
          failover team invite robot2                          # there: prints a line
          failover team join robot2@192.168.7.11:7423/3ljz     # on robot2: that line, whole
          failover team list
        """,
        "failover.cli.arguments.team:team",
        "failover.cli.verbs.team:show",
    ),
    Verb(
        "rights",
        "who may do what: the rules, and why one user may or may not",
        """
        rights.toml of the team directory says which groups may do what, where and when (docs/rights.md). Without it root, the
        agent's user and each component's owner have the rights. An agent is needed only for groups that a directory server tells.
        failover rights ACT --help explains an act.

          failover rights list
          failover rights why user1 call University/Lab/Robotino/Engines/3/PWM
        """,
        "failover.cli.arguments.rights:rights",
        "failover.cli.verbs.rights:show",
    ),
    Verb(
        "board",
        "the team's board: the robots' items with value, age and rate; get and put one",
        """
        The board holds named values, items, that each robot of the team writes for itself and every robot reads at its own.
        team.toml declares them (docs/configuration.md); a program adds others. This command shows those of all robots: the
        newest value, its age, how much of its bound the age has used, and the puts in a second. Exit status 1: an item is older
        than its bound, or its value cannot be read. No agent is needed. failover board ACT --help explains an act.

          failover board
          failover board --watch
          failover board get robot2/ball
          failover board put ball '{"x": 1.0, "y": 2.5}'
          failover board record team.mcap
          failover board replay team.mcap --board /dev/shm/yesterday
          failover board serve --foxglove 8765
          failover board header > items.h
          failover board import rtdb.conf -I include
        """,
        "failover.cli.arguments.board:board",
        "failover.cli.verbs.board:show",
    ),
    Verb(
        "ps",
        "robots, components and their tasks as a tree: state, period, phase, misses, lateness",
        """
        Shows the robots, below each its components, and below each component of this robot the tasks that its program runs at
        their times (docs/tasks.md), the most urgent first. Lateness is the span from the instant at which an activation was due
        to its beginning: half of the activations, and 99 of 100, were below the bound that is shown. Without an agent it shows
        the tasks alone. Exit status 1: no process runs a task, a task is past its deadline, or a component here has failed.

          failover ps
          failover ps --watch
          failover ps --json | jq '.tasks[] | {task, component, late_p99_ms}'
        """,
        "failover.cli.arguments.tasks:ps",
        "failover.cli.verbs.tasks:show",
    ),
    Verb(
        "task",
        "orders to tasks: add, set, remove, run, run-once, import; histogram shows how late one began",
        """
        Changes tasks while they run. A change comes into force between two activations of its task, never within one, and no
        other task notices. All of an order is done, or nothing. failover task ACT --help explains an act.

          failover task set mapper period_ms=100
          failover task set mapper after=odometry,vision --next
          failover task add logger period_ms=1000
          failover task remove logger
          failover task run logger period_ms=1000 -- ./log-disk
          failover task histogram mapper
        """,
        "failover.cli.arguments.tasks:task",
        "failover.cli.verbs.tasks:show",
    ),
    Verb(
        "trace",
        "what the tasks do in some seconds, as a file for Perfetto",
        """
        Looks at the tasks of this robot, and writes a file that https://ui.perfetto.dev and chrome://tracing open: a track for
        each task, a slice for each activation, missed deadlines, and arrows from predecessors to what waited for them. The tasks
        do not notice.

          failover trace -o robot.pftrace --for 10s
        """,
        "failover.cli.arguments.tasks:trace",
        "failover.cli.verbs.task_files:write_trace",
    ),
    Verb(
        "wait-activation",
        "in a script that failover task run --loop has started: wait for the next activation",
        """
        The activation before ends, and the next one begins when this returns. It says number, instant at which the activation was
        due, lateness (both in nanoseconds), and how many were missed before it. Exit status 1: there is no next one.

          failover wait-activation
          while failover wait-activation -q; do df / >> disk.log; done
        """,
        "failover.cli.arguments.tasks:wait_activation",
        "failover.cli.verbs.task_programs:wait_activation",
    ),
    Verb(
        "names",
        "the tree of names: which driver answers to which path and alias, on which robot, with which verbs",
        """
        Drivers register their names with one another; this command asks those of this robot, or of another one if there is none
        here. It shows drivers of this user. Exit status 1: a name is unreachable, is claimed twice, or belongs to another robot.

          failover names
          failover names University/Lab/Robotino
          failover names --json | jq .names[0].verbs
        """,
        "failover.cli.arguments.drivers:names",
        "failover.cli.verbs.drivers:names",
    ),
    Verb(
        "call",
        "have a driver carry out a verb, and print what it returns",
        """
        Find a driver by its path, an alias or an address, and have it carry out a verb. The answer is printed as JSON. The
        message is sent again until it is answered or the time is over; the driver carries it out once.

          failover call engine set '{"duty": 0.4}'
          failover call University/Lab/Robotino/Engines/3/PWM read
          failover call engine set 0.4 --timeout-s 0.5
        """,
        "failover.cli.arguments.drivers:call",
        "failover.cli.verbs.drivers:call",
    ),
    Verb(
        "send",
        "send a driver a message as it is written, and print the answer as it comes",
        """
        Send one JSON object. Fields may come in any order; "to" is added if it is not there. The answer is printed as it comes.
        Nothing is sent again. Exit status 1: the answer is an error.

          failover send engine '{"verb": "read"}'
          failover send engine '{"verb": "set", "body": {"duty": 0.4}, "id": "mine-1"}'
        """,
        "failover.cli.arguments.drivers:send",
        "failover.cli.verbs.drivers:send",
    ),
    Verb(
        "graph",
        "who talks to which driver: how often, how much, with how many errors, how slowly",
        """
        Ask each driver who has called it in the last hour. Messages that came again count again. The time is from the arrival of
        a message to its answer; p99 is at most half too high. --dot writes a graph for Graphviz. Exit status 1: a driver did not
        answer.

          failover graph
          failover graph --watch
          failover graph --dot | dot -Tsvg > team.svg
        """,
        "failover.cli.arguments.drivers:graph",
        "failover.cli.verbs.drivers:graph",
    ),
    Verb(
        "path",
        "where a message to a driver spent its time, hop by hop",
        """
        Ask the drivers which of them remembers a message, and print where that was and for how long, with bounds: clocks of
        different robots are compared by some messages to and fro. The way of the answer back is not remembered.

          failover path robot1/failover-4711-1-18f3a2b-1
        """,
        "failover.cli.arguments.drivers:path",
        "failover.cli.verbs.drivers:path",
    ),
    Verb(
        "program",
        "programs sent to running robots: pack, sign, send, run, switch, rollback",
        """
        A bundle is a driver with its manifest and a person's signature, in one file. It is checked before anything of it is
        unpacked, waits warm beside the version that runs, takes over between two messages with the state of the old one, and is
        rolled back if it fails its trial (docs/programs.md). No agent is needed. failover program ACT --help explains an act.

          failover program key anna.key
          failover program pack engine-2 -o engine.bundle --key anna.key
          failover program send engine.bundle
          failover program run engine
          failover program switch engine 2.0
        """,
        "failover.cli.arguments.programs:program",
        "failover.cli.verbs.programs:show",
    ),
    Verb(
        "bridge",
        "the board and the drivers for programs of another middleware: zenoh",
        """
        A process between the team and programs of another middleware, until Ctrl-C. failover bridge zenoh --help explains it.

          failover bridge zenoh
          failover bridge zenoh --connect tcp/10.0.0.5:7447 --calls
        """,
        "failover.cli.arguments.bridges:bridge",
        "failover.cli.verbs.bridges:zenoh",
    ),
    Verb(
        "simulate",
        "simulated robots: their devices as drivers, their items on the board, a controller each",
        """
        Simulate robots in labs: motors, wheels, ultrasonic sensors, batteries (docs/simulation.md). Their devices are drivers
        below Simulated/, their items are on this robot's board, and a program with FAILOVER_WORLD=Simulated takes them for the
        real ones. Controllers act 20 times a second, sensors measure 10 times. Without --for it runs until Ctrl-C, then tells
        lateness, processor time and memory. Exit status 1: a controller missed a deadline of 50 ms. No agent is needed.

          failover simulate
          failover simulate --robots 80 --labs 4 --for 10min --json
          failover simulate --world amur-7
          failover simulate --robots 8 --pace max --for 60
        """,
        "failover.cli.arguments.simulate:simulate",
        "failover.cli.verbs.simulate:simulate",
    ),
    Verb(
        "page",
        "the operators' page: the team live in a browser, orders, metrics for Prometheus",
        """
        Serve a page for browsers on this robot: the team as a tree, each component with its decisions, output and charts, the
        board, orders with their consequences, and /metrics. Without page.toml it listens at 127.0.0.1:7480, and the kernel tells
        which user has connected. Another address needs TLS and a login (docs/page.md). It runs until Ctrl-C, and starts without
        an agent, which it waits for.

          failover page
          failover page --listen 127.0.0.1:8080
          failover page --config /etc/failover/page.toml
          failover page --password
        """,
        "failover.cli.arguments.page:page",
        "failover.cli.verbs.page:page",
    ),
    Verb(
        "check",
        "can failover protect programs here, or this process; and what to change",
        """
        Without PID: what this machine offers, and what it lacks. With PID: whether failover can capture that process now, what a
        restore would change, and every reason why not; the process is not touched. With --table: each kind of thing that a
        program may hold, and whether failover preserves it, preserves it by a rule of the operator's, or refuses it.

          failover check
          failover check 4711
          failover check --table
        """,
        "failover.cli.arguments.one_shot:check",
        "failover.cli.verbs.one_shot:check",
    ),
    Verb(
        "capture",
        "one snapshot of a process into a file; no agent needed",
        """
        Write the whole state of a running process to FILE: memory, registers, open files, timers, signals. Then end the process,
        so that it cannot run twice; --leave-running leaves it running.

          failover capture 4711 -o mapper.snapshot
          failover capture 4711 -o before.snapshot --leave-running
        """,
        "failover.cli.arguments.one_shot:capture",
        "failover.cli.verbs.one_shot:capture",
    ),
    Verb(
        "restore",
        "resume a process from a snapshot in a file; no agent needed",
        """
        Resume the program of FILE from its snapshot. Print its PID on a line of its own and return while it runs on.
        The program keeps its old PID if that is free and this user may choose it.

        FILE says as which user the program ran, and FILE's owner wrote that. So root's restore gives the program the rights of
        FILE's owner at most, and says what FILE asks for beyond those. --trust gives it all that FILE asks for: use it for a
        file whose content you would run as root. failover inspect shows beforehand what a restore brings back.

          failover restore mapper.snapshot
          failover restore --wait mapper.snapshot && echo it ended well
        """,
        "failover.cli.arguments.one_shot:restore",
        "failover.cli.verbs.one_shot:restore",
    ),
    Verb(
        "inspect",
        "show the content of a snapshot's file",
        """
        Show the process, its memory, files and settings as a snapshot holds them, after verifying every byte of it.

          failover inspect mapper.snapshot
          failover inspect --json mapper.snapshot | jq .position
        """,
        "failover.cli.arguments.one_shot:inspect",
        "failover.cli.verbs.inspect_file:inspect",
    ),
    Verb(
        "completion",
        "completion of verbs and options for your shell",
        """
        Print a script that teaches a shell to complete this command.

          failover completion bash > ~/.local/share/bash-completion/completions/failover
        """,
        "failover.cli.arguments.one_shot:completion",
        "failover.cli.completion:completion",
    ),
)
