"""Command line of the daemon ``failover-agent``."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from agent import config as configuration
from agent.errors import AgentError, ConfigError, LaneError
from agent.system import syscalls
from agent.system.log_setup import set_up_log
from agent.system.sd_notify import notifier
from checkpoint.runtime import slim_imports
from failover.config import team as team_directory
from failover.errors import FailoverError

if TYPE_CHECKING:
    import argparse

DEFAULT_CONFIG: Final = Path("/etc/failover/agent.toml")
FAILED: Final = 1
INSECURE: Final = "INSECURE: running without keys: every machine on the network can read programs' memory and start programs here"

DESCRIPTION: Final = """
Protect the programs of this robot and of its neighbours. Runs in the foreground, logs to standard error, ends on SIGTERM;
components run on, and the next agent finds them again. Where systemd restarts it, or on SIGUSR1, the other robots are asked to
wait for the next one (restart_grace_s), and move nothing. The command `failover` gives it orders.

  failover-agent --config /etc/failover/agent.toml           run
  failover-agent check --config /etc/failover/agent.toml     read configuration, team file and key, and say what is wrong
  failover-agent keypair                                     a new pair as JSON; the secret half stays on this robot, in
                                                             /etc/failover/team/keys/ROBOT.secret, mode 600
  failover-agent mend /lab/robot1/mapper --epoch 12          a record whose epoch leaves none above it (failover status says so)
                                                             gets a lower one; says what that costs, and asks
  failover-agent recover /lab/robot1/mapper                  fetch a component that no robot holds any more from the archive into
                                                             this robot's store
"""

EPILOG: Final = """
Every key of the configuration stands with its default in systemd/agent.toml, and in docs/configuration.md.
Exit status: 0 it was asked to end, 1 it could not run; the reason is the last line on standard error.
"""

log = logging.getLogger("failover.agent")


def main(arguments: list[str] | None = None) -> int:
    """Run the agent until SIGTERM, or print a key pair, or check a configuration."""
    arguments = sys.argv[1:] if arguments is None else arguments
    command, config = _wanted(arguments)
    try:
        if command == "keypair":
            return _print_keys()
        settings = configuration.load(config)
        if command == "mend":
            return _mend(settings, arguments)
        if command == "recover":
            return _recover(settings, arguments)
        if command == "check":
            from agent.worker import known_sites

            known_sites.check(settings)
            _check_pair(settings)
            _check_rights(Path(settings.config.team_directory))
            peers, far = ", ".join(settings.peers) or "none", ", ".join(settings.far)
            other_sites = f"; at other sites: {far}" if far else ""
            print(f"{config}: robot {settings.config.robot} of team {settings.team.team}; peers: {peers}{other_sites}")
            return 0
        return _run(settings)
    except (AgentError, FailoverError) as error:
        print(f"failover-agent: {error}", file=sys.stderr)
        return FAILED


def _wanted(arguments: list[str]) -> tuple[str, Path]:
    """The command and the configuration file. A service is started without argparse, which would cost half a megabyte."""
    match arguments:
        case ["--config", path] if not path.startswith("-"):
            return "run", Path(path)
    found = command_line().parse_args(arguments)
    return found.command, found.config


def _mend(settings: configuration.Settings, arguments: list[str]) -> int:
    from agent.mend import mend

    wanted = command_line().parse_args(arguments)
    if not wanted.component or wanted.epoch is None:
        raise AgentError("mend needs a component and the epoch that its record is to have: failover-agent mend NAME --epoch N")
    return mend(settings, wanted.component, wanted.epoch, agreed=wanted.yes)


def _recover(settings: configuration.Settings, arguments: list[str]) -> int:
    from agent.recover import recover

    wanted = command_line().parse_args(arguments)
    if not wanted.component:
        raise AgentError("recover needs a component: failover-agent recover NAME; failover archive list shows those there are")
    return recover(settings, wanted.component)


def _check_pair(settings: configuration.Settings) -> None:
    """Refuse a secret key by which no other robot would know this one. An agent runs all the same, and says so in its status.

    Raises:
        ConfigError: it is no key, or does not belong to this robot's public key in the team file.
    """
    if settings.config.insecure:
        return
    from agent.worker.network.replication_link import public_key_of

    robot, directory = settings.config.robot, Path(settings.config.team_directory)
    key = team_directory.secret_key_path(directory, robot)
    try:
        public = public_key_of(settings.secret_key)
    except LaneError as error:
        raise ConfigError(f"{key}: {error}") from error
    if public not in settings.me.keys:
        enrolled = settings.me.public_key
        raise ConfigError(
            f"{key} does not belong to the public key of {robot} in {directory / team_directory.TEAM_FILE}: its public half is "
            f"{public[:8]}…, the team has {enrolled[:8]}…, so no other robot would accept this one; bring the right key or the "
            f"newest team.toml here, or make a new pair by failover team enrol {robot} HOST --replace"
        )


def _check_rights(directory: Path) -> None:
    """Raises FileMistakeError: rights.toml has a mistake, so that root alone has rights here. An agent runs all the same."""
    from failover.config import rights

    rights.read(directory)


def _run(settings: configuration.Settings) -> int:
    from agent.main_loop.loop import beat
    from agent.worker import known_sites

    known_sites.check(settings)
    known_sites.note(settings)
    set_up_log(settings.config.log_level, settings.config.robot)
    syscalls.small_stacks()
    if settings.config.insecure:
        log.warning("%s", INSECURE)
    beat(settings, notifier())
    return 0


def _print_keys() -> int:
    import json

    from agent.worker.network.replication_link import new_keys

    public, secret = new_keys()
    print(json.dumps({"public": public, "secret": secret}))
    return 0


def command_line() -> argparse.ArgumentParser:
    """What can be typed."""
    import argparse

    from failover.cli.arguments.shared import Parser

    parser = Parser(
        prog="failover-agent",
        description=DESCRIPTION.strip(),
        epilog=EPILOG.strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "command",
        nargs="?",
        default="run",
        choices=("run", "check", "keypair", "mend", "recover"),
        help="run (the default); check reads the configuration and says what it found; keypair prints a new pair as JSON; mend "
        "lowers the epoch that is on record here for COMPONENT, recover fetches COMPONENT from the archive, both while the agent "
        "is stopped",
    )
    parser.add_argument("component", nargs="?", default="", metavar="COMPONENT", help="of mend and recover: its name")
    parser.add_argument("--epoch", type=int, metavar="N", help="of mend: the epoch that its record is to have")
    parser.add_argument("--yes", action="store_true", help="of mend: do not ask for confirmation")
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, metavar="FILE", help=f"default {DEFAULT_CONFIG}")
    return parser


if __name__ == "__main__":
    slim_imports.begin()
    sys.exit(main())
