"""``failover-agent``: the daemon's command line."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from agent import config as configuration
from agent import kernel
from agent.errors import AgentError
from agent.journal import set_up_log
from agent.systemd import notifier
from checkpoint import lean
from failover.errors import FailoverError

if TYPE_CHECKING:
    import argparse

DEFAULT_CONFIG: Final = Path("/etc/failover/agent.toml")
FAILED: Final = 1
INSECURE: Final = "INSECURE: running without keys: anybody on the network can read programs' memory and start programs here"

DESCRIPTION: Final = """
Protect the programs of this robot and of its neighbours. Runs in the foreground, logs to standard error, leaves on SIGTERM;
components outlive it, and the next agent finds them again. People talk to it by `failover`.

  failover-agent --config /etc/failover/agent.toml           run
  failover-agent check --config /etc/failover/agent.toml     read configuration, team file and key, and say what is wrong
  failover-agent keypair                                     a new pair as JSON; the secret half stays on this robot, in
                                                             /etc/failover/team/keys/ROBOT.secret, mode 600
"""

EPILOG: Final = """
Every key of the configuration stands with its default in systemd/agent.toml, and in docs/configuration.md.
Exit status: 0 it was asked to end, 1 it could not run; the reason is the last line on standard error.
"""

log = logging.getLogger("failover.agent")


def main(arguments: list[str] | None = None) -> int:
    """Run the agent until SIGTERM, or print a key pair, or check a configuration."""
    command, config = _wanted(sys.argv[1:] if arguments is None else arguments)
    try:
        if command == "keypair":
            return _print_keys()
        settings = configuration.load(config)
        if command == "check":
            peers = ", ".join(settings.peers) or "none"
            print(f"{config}: robot {settings.config.robot} of team {settings.team.team}; peers: {peers}")
            return 0
        return _run(settings)
    except (AgentError, FailoverError) as error:
        print(f"failover-agent: {error}", file=sys.stderr)
        return FAILED


def _wanted(arguments: list[str]) -> tuple[str, Path]:
    """The command and the configuration file; as services are started without argparse: the heart would keep half a megabyte."""
    match arguments:
        case ["--config", path] if not path.startswith("-"):
            return "run", Path(path)
    found = command_line().parse_args(arguments)
    return found.command, found.config


def _run(settings: configuration.Settings) -> int:
    from agent.loop import beat

    set_up_log(settings.config.log_level)
    kernel.small_stacks()
    if settings.config.insecure:
        log.warning("%s", INSECURE)
    beat(settings, notifier())
    return 0


def _print_keys() -> int:
    import json

    from agent.transport import new_keys

    public, secret = new_keys()
    print(json.dumps({"public": public, "secret": secret}))
    return 0


def command_line() -> argparse.ArgumentParser:
    """What can be typed."""
    import argparse

    parser = argparse.ArgumentParser(
        prog="failover-agent",
        description=DESCRIPTION.strip(),
        epilog=EPILOG.strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "command",
        nargs="?",
        default="run",
        choices=("run", "check", "keypair"),
        help="run (the default); check reads the configuration and says what it found; keypair prints a new pair as JSON",
    )
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, metavar="FILE", help=f"default {DEFAULT_CONFIG}")
    return parser


if __name__ == "__main__":
    lean.begin()
    sys.exit(main())
