"""Parser of the command line: every verb with its help and its examples; `failover.cli.arguments` has each verb's arguments.

A verb is a row of the table at the bottom. The row names the function that carries it out as ``module:function``; it is loaded
when the verb is used, so that ``failover status`` does not pay for ``failover demo``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from textwrap import dedent
from typing import Final

from msgspec import Struct

from failover import __version__
from failover.cli import arguments

DESCRIPTION: Final = """
A program outlives its robot: it goes on elsewhere, from where it stood a fraction of a second ago.

  failover demo                    see it happen on this machine, in half a minute
  failover check                   what this machine offers, and what is missing
  failover run -- CMD              start a program under protection (needs an agent)
  failover status                  how the team stands
  failover VERB --help             a verb with examples
"""

PLACES: Final = """
Files and environment:
  $FAILOVER_SOCKET                 the agent's control socket; without it $XDG_RUNTIME_DIR/failover/control.sock if that is
                                   there, else /run/failover/control.sock
  /etc/failover/agent.toml         the agent's configuration, every key with its default
  /etc/failover/team               who belongs (team.toml, the same on every robot) and this robot's secret key
  /var/lib/failover                snapshots and streams
  $NO_COLOR                        no colours
"""


class Verb(Struct, frozen=True):
    """One verb of the command line.

    Attributes:
        summary: one line, for the list of verbs.
        story: what it does, and examples; dedented before it is shown.
        arguments: adds the verb's own arguments to its parser.
        function: ``module:function``; takes the parsed arguments, returns the exit status.
    """

    name: str
    summary: str
    story: str
    arguments: Callable[[argparse.ArgumentParser], None]
    function: str


def build(verb: str = "") -> argparse.ArgumentParser:
    """The whole parser; of one verb's words the part that can read them, which takes a tenth of the time."""
    parser = argparse.ArgumentParser(
        prog="failover",
        description=DESCRIPTION.strip(),
        epilog=f"{PLACES.strip()}\n\n{arguments.EXIT_STATUSES} failover run and restore --wait: the program's own.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"failover {__version__}")
    rooms = parser.add_subparsers(dest="verb", metavar="VERB", required=True, title="verbs")
    for one in [one for one in VERBS if one.name == verb] or VERBS:
        room = rooms.add_parser(
            one.name,
            help=one.summary,
            description=dedent(one.story).strip(),
            epilog=arguments.EXIT_STATUSES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        room.set_defaults(function=one.function)
        one.arguments(room)
    return parser


VERBS: Final = (
    Verb(
        "demo",
        "two robots on this machine, real programs, a power cut: the programs go on",
        """
        Start two agents on this machine, run ordinary programs under protection on the first, cut its power, and see them go on
        at the second. Exit status 0 only if their whole output equals an undisturbed run, byte for byte. Takes under a minute
        and removes everything it made. Root gives each robot a network of its own.

          failover demo
          failover demo --json | jq .programs[0].outage_ms
        """,
        arguments.demo,
        "failover.cli.demo.play:demo",
    ),
    Verb(
        "run",
        "start a program under protection; its output and exit status become ours",
        """
        Start a program as a component of this robot. Snapshots of it go to its standby; when this robot dies, it goes on there.
        Ctrl-C is passed on to the program. Its exit status becomes ours (128 + N if signal N ended it). --json prints how it was
        started on standard error.

        While it waits, the agent may be restarted and the program may go to another robot and end there: it goes on waiting, and
        shows each byte once. An agent that does not come back within half a minute is status 3; the program runs on.

        A takeover goes on from the newest checkpoint: what was written after it is written again, and may differ from what you
        saw. With --output=committed nothing is shown before another robot holds it, here and by failover logs. While nobody
        stands by it waits, and failover status says so; when 8 MiB of a stream wait, the program waits in its next write.

        It runs as you, with your groups, limits, priorities, environment, directory and umask, as if your shell had started it.
        Besides root only you may read its output, stop, release or move it, on any robot that knows you by the same number.

        Its standard output and error are pipes that belong to it, not to this terminal, and its standard input is empty: it does
        not see a terminal even where you have one. Many programs then write by the block and not by the line; python3 -u, or
        stdbuf -oL before other commands, shows their output at once.

          failover run -- python3 mapper.py --map hall.yaml
          failover run --name /lab/robot1/mapper --detach -- ./mapper
          failover run -- sh -c 'python3 counter.py --from hall; true'

        A program that says what must survive (docs/decorator.md) is recognised, also below a shell or a launcher; until it says
        so it is captured from outside, like a program that never does.
        """,
        arguments.run,
        "failover.cli.verbs.components:run",
    ),
    Verb(
        "protect",
        "protect a process that runs already",
        """
        Take a running process under protection. It keeps its standard streams: where they are files, they go on at the other
        robot; what it writes to a terminal or a pipe is not kept, and its exit status will not be known. What cannot be preserved
        is refused by name, and the process is not touched then (failover check PID shows the whole list).

          failover protect 4711 --name /lab/robot1/mapper
        """,
        arguments.protect,
        "failover.cli.verbs.components:protect",
    ),
    Verb(
        "release",
        "let a component go: its program runs on, unprotected",
        """
        End protection. The program is not touched and runs on; its checkpoints are forgotten at every robot, so that nobody takes
        it over. A component that has ended or failed is forgotten, and status shows it no more. May be given at any robot.

          failover release /lab/robot1/mapper
        """,
        arguments.named,
        "failover.cli.verbs.components:release",
    ),
    Verb(
        "stop",
        "end a component's program; no robot runs it again",
        """
        Send the program a signal and wait for its end, which is recorded on its standby too; after 10 seconds it is killed.
        May be given at any robot.

          failover stop /lab/robot1/mapper
          failover stop /lab/robot1/mapper --signal INT
        """,
        arguments.stop,
        "failover.cli.verbs.components:stop",
    ),
    Verb(
        "status",
        "the team as a tree: role, epoch, lag, freeze, standby, links, and what is promised now",
        """
        Show every robot, its components, how old their newest checkpoint is (lag), how long a snapshot stops them (freeze), and
        in one sentence what holds if this robot dies now. Exit status 1 says that something is degraded: a program that cannot be
        captured, checkpoints that do not arrive, a component without protection, a robot that is silent. Each is named below the
        tree. Colours go with NO_COLOR=1; a narrow terminal gets a list instead of a table.

          failover status
          failover status --watch
          failover status --json | jq '.components[].lag_ms'
        """,
        arguments.status,
        "failover.cli.verbs.status:status",
    ),
    Verb(
        "logs",
        "what a component wrote, without gap or repetition, from any robot",
        """
        Show standard output and standard error of a component from its beginning (at most the last 256 MB of each), as far as no
        takeover can take it back; all of it once it has ended. May be given at any robot; --follow goes on through a takeover.

          failover logs /lab/robot1/mapper
          failover logs --follow --stream 2 /lab/robot1/mapper
        """,
        arguments.logs,
        "failover.cli.verbs.components:logs",
    ),
    Verb(
        "why",
        "the story of the last decisions",
        """
        Tell what was seen, by whom, when, and what was done about it: the stories of all robots that answer, in one, in the order
        in which it happened, whatever their clocks say. Below each decision stands what the robot knew: how long every peer had
        been silent on which link, and after how long it counts as dead; whether its own loop had been late; which checkpoint it
        could go on from, and how old that was. Kept on disk, so it goes back over restarts (about 4 MB a robot).

          failover why
          failover why /lab/robot1/mapper --since 10min
          failover why --robot robot2 --brief
        """,
        arguments.why,
        "failover.cli.verbs.why:why",
    ),
    Verb(
        "handover",
        "move a component to another robot, planned: nothing is lost",
        """
        The last changes are sent, then the other robot goes on where this one stopped; answered when it runs there. Only the
        standby can take it: it has the checkpoints. Whatever goes wrong, it stays where it is. May be given at any robot.

          failover handover /lab/robot1/mapper
          failover handover /lab/robot1/mapper --to robot2
        """,
        arguments.handover,
        "failover.cli.verbs.components:handover",
    ),
    Verb(
        "failback",
        "move a component back to where it belongs",
        """
        To the robot that is preferred, or else to the one that it was started on; planned, as a handover.
        May be given at any robot.

          failover failback /lab/robot1/mapper
        """,
        arguments.named,
        "failover.cli.verbs.components:failback",
    ),
    Verb(
        "promote",
        "run what is held still, without waiting for robots that are silent",
        """
        Have a robot run the component now, from the checkpoint that it holds, or on from where it stands still: after the loss of
        a robot under on_loss = "hold", or where when_alone = "freeze" holds it, or where a majority waits for a robot that may
        hold a newer checkpoint. What it would lose is told before, and what may go wrong: a silent robot may be alive, cut off,
        and run it too. Then it asks; without a terminal it does nothing unless --yes. It runs under a new epoch, above any that
        a silent robot can have opened. Refused while a robot that is heard has it, and without a majority where majority is the
        rule. May be given at any robot.

          failover promote /lab/robot1/mapper
          failover promote /lab/robot1/mapper --robot robot2 --yes
        """,
        arguments.promote,
        "failover.cli.verbs.components:promote",
    ),
    Verb(
        "prefer",
        "which robot should run a component",
        """
        The component goes there as soon as that robot holds its checkpoints, and again after each takeover, once it keeps up.
        An empty ROBOT ('') leaves it where it runs. May be given at any robot.

          failover prefer /lab/robot1/mapper robot1
        """,
        arguments.prefer,
        "failover.cli.verbs.components:prefer",
    ),
    Verb(
        "team",
        "who belongs to the team, and by which key",
        """
        Begin a team, enrol robots, list them. The team file is the same on every robot and holds nothing secret; a robot's secret
        key stays on that robot alone. failover team ACT --help explains an act.

          failover team create lab
          failover team enrol robot1 192.168.7.11
          failover team enrol robot2 192.168.7.12 10.0.0.12 --bulk 192.168.7.12
          failover team show
        """,
        arguments.team,
        "failover.cli.verbs.team:show",
    ),
    Verb(
        "check",
        "can this machine, or this process, be protected; and what to change",
        """
        Without PID: what this machine offers, and what is missing. With PID: whether that process can be captured now,
        what would come back otherwise than it was, and every reason why not. The process is not touched. With --table: each
        kind of thing that a program may hold, and whether it is preserved, preserved by a rule of the operator's, or refused.

          failover check
          failover check 4711
          failover check --table
        """,
        arguments.check,
        "failover.cli.verbs.one_shot:check",
    ),
    Verb(
        "capture",
        "one snapshot of a process into a file; no agent needed",
        """
        Write the whole state of a running process to FILE: memory, registers, open files, timers, signals. The process is
        ended afterwards, so that it cannot run twice; --leave-running lets it go on.

          failover capture 4711 -o mapper.snapshot
          failover capture 4711 -o before.snapshot --leave-running
        """,
        arguments.capture,
        "failover.cli.verbs.one_shot:capture",
    ),
    Verb(
        "restore",
        "a process goes on from a snapshot in a file; no agent needed",
        """
        Start the program of FILE where it stood. Prints its PID on a line of its own and returns while it runs on.
        The old PID is kept where this user may choose it and it is free.

        FILE says as which user it ran, and it is FILE's owner who wrote that. So root's restore gives the program the
        rights of FILE's owner at most, and says what FILE asks for beyond those. --trust gives it all that it asks for:
        for a file whose content you would run as root. failover inspect shows beforehand what comes back.

          failover restore mapper.snapshot
          failover restore --wait mapper.snapshot && echo it ended well
        """,
        arguments.restore,
        "failover.cli.verbs.one_shot:restore",
    ),
    Verb(
        "inspect",
        "what a snapshot's file holds",
        """
        Show the process, its memory, files and settings as a snapshot holds them, after verifying every byte of it.

          failover inspect mapper.snapshot
          failover inspect --json mapper.snapshot | jq .position
        """,
        arguments.inspect,
        "failover.cli.verbs.inspect_file:inspect",
    ),
    Verb(
        "completion",
        "completion of verbs and options for your shell",
        """
        Print a script that teaches a shell to complete this command.

          failover completion bash > ~/.local/share/bash-completion/completions/failover
        """,
        arguments.completion,
        "failover.cli.completion:completion",
    ),
)
