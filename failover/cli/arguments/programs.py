"""program key, pack, sign, verify, send, receive, run, list, switch, rollback, log: programs that are sent to running robots."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_json, add_team_directory


def program(room: argparse.ArgumentParser) -> None:
    """Of ``failover program`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="ACT", required=True, title="acts")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--store", metavar="DIR", help="where programs are kept (default: $FAILOVER_PROGRAMS, else docs/programs.md)"
    )
    add_team_directory(shared)
    add_json(shared)
    key = add_act(acts, "key", shared, "make a key pair", PROGRAM_KEY_DESCRIPTION)
    key.add_argument("file", metavar="FILE", help="where the secret key goes, 0600; never overwritten")
    key.add_argument("--owner", metavar="USER", default="USER", help="whose it is, for the lines that are printed")
    key.set_defaults(function="failover.cli.verbs.programs:key")
    pack = add_act(acts, "pack", shared, "make a bundle of a directory", PROGRAM_PACK_DESCRIPTION)
    pack.add_argument("source", metavar="DIR", help="with program.toml and the program's files")
    pack.add_argument("-o", "--output", metavar="FILE", required=True, help="the bundle")
    pack.add_argument("--key", metavar="KEY", help="sign it too")
    pack.add_argument(
        "--until", metavar="DAY", help="the signature counts until the end of that day, as 2027-12-31 (default: for ever)"
    )
    pack.set_defaults(function="failover.cli.verbs.programs:pack")
    sign = add_act(acts, "sign", shared, "sign a bundle", "Put your signature on a bundle, in place of one that it may have.")
    sign.add_argument("file", metavar="FILE", help="a bundle")
    sign.add_argument("--key", metavar="KEY", required=True, help="your secret key")
    sign.add_argument("--until", metavar="DAY", help="the signature counts until the end of that day (default: for ever)")
    sign.set_defaults(function="failover.cli.verbs.programs:sign")
    verify = add_act(acts, "verify", shared, "would this robot take a bundle; changes nothing", PROGRAM_VERIFY_DESCRIPTION)
    verify.add_argument("file", metavar="FILE", help="a bundle")
    verify.set_defaults(function="failover.cli.verbs.programs:verify")
    send = add_act(acts, "send", shared, "check a bundle and keep it on this robot", PROGRAM_VERIFY_DESCRIPTION)
    send.add_argument("file", metavar="FILE", help="a signed bundle")
    send.add_argument("--to", metavar="ROBOT", help="another robot, where failover program receive runs (default: this one)")
    send.set_defaults(function="failover.cli.verbs.programs:send")
    receive = add_act(acts, "receive", shared, "take bundles from other robots", PROGRAM_RECEIVE_DESCRIPTION)
    receive.set_defaults(function="failover.cli.verbs.programs:receive")
    run = add_act(acts, "run", shared, "hold a program's name, and run its version", PROGRAM_RUN_DESCRIPTION)
    run.add_argument("program", metavar="NAME|DIR", help="a program that was sent here; or a directory of your own, unsigned")
    run.add_argument("version", metavar="VERSION", nargs="?", help="of NAME (default: the active one, else the newest)")
    run.add_argument("--beside", action="store_true", help="under PATH@VERSION, with a state of its own, beside the active one")
    run.set_defaults(function="failover.cli.verbs.programs:run")
    listed = add_act(
        acts, "list", shared, "programs, versions, states", "Show what is kept here, and what is enforced for what runs."
    )
    listed.set_defaults(function="failover.cli.verbs.programs:show")
    switch = add_act(acts, "switch", shared, "have another version take over, under load", PROGRAM_SWITCH_DESCRIPTION)
    switch.add_argument("name", metavar="NAME", help="a program, or the path or alias of its driver")
    switch.add_argument("version", metavar="VERSION|DIR", help="which one; a directory for a program that runs from one")
    switch.add_argument("--wait", action="store_true", help="until its trial is over")
    switch.set_defaults(function="failover.cli.verbs.programs:switch")
    back = add_act(acts, "rollback", shared, "back to the version before", PROGRAM_ROLLBACK_DESCRIPTION)
    back.add_argument("name", metavar="NAME", help="a program, or the path or alias of its driver")
    back.add_argument("--old-state", action="store_true", help="with its state at the switch, if it cannot read the newest one")
    back.set_defaults(function="failover.cli.verbs.programs:rollback")
    log = add_act(
        acts, "log", shared, "what was done with a program, and why", "Show what was done with a program on this robot."
    )
    log.add_argument("name", metavar="NAME", help="a program")
    log.set_defaults(function="failover.cli.verbs.programs:lines")


PROGRAM_KEY_DESCRIPTION: Final = """
    Make an Ed25519 key pair. The secret half stays in FILE. The public half is printed as lines for programs.toml of the team
    directory, which says whose signature counts.

      failover program key anna.key --owner anna
    """

PROGRAM_PACK_DESCRIPTION: Final = """
    Make a bundle of DIR/program.toml and every plain file below DIR. Files that begin with a dot and __pycache__ are left out;
    links are refused. The same files give the same bundle.

      failover program pack engine-2 -o engine.bundle --key anna.key
    """

PROGRAM_VERIFY_DESCRIPTION: Final = """
    A bundle is taken if its key is in programs.toml and has not expired, its signature is right, each byte of it is as failover
    packs it, what it needs is here, it is no downgrade, and its author has the right "program" on its path. Nothing is unpacked
    before.

      failover program verify engine.bundle
      failover program send engine.bundle
    """

PROGRAM_RECEIVE_DESCRIPTION: Final = """
    Take bundles that failover program send --to ROBOT brings from robots of the team, until SIGTERM or Ctrl-C. Each is checked as
    if it was sent here. It needs the team's keys, as a driver that other robots call.

      failover program receive
    """

PROGRAM_RUN_DESCRIPTION: Final = """
    Hold the path and the mailbox of a program, and run a version of it in a process of its own, until SIGTERM or Ctrl-C. State
    and mailbox outlive this command. A directory of your own runs unsigned and unconfined, as you.

      failover program run engine
      failover program run ./engine-1
    """

PROGRAM_SWITCH_DESCRIPTION: Final = """
    The new version is started beside the old one, and takes over between two messages with the state of the old one. It is on
    trial as its manifest says (health). If it fails, the old version goes on, and this command says so.

      failover program switch engine 2.0
      failover program switch engine ./engine-2 --wait
    """

PROGRAM_ROLLBACK_DESCRIPTION: Final = """
    The version before goes on with the newest state, if it can read it. Its process is kept for 300 s after a switch.

      failover program rollback engine
    """
