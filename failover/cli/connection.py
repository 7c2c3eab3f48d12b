"""The connection over which a verb talks to its agent."""

from __future__ import annotations

import argparse
from pathlib import Path

from failover.client.control import Control


def connect(arguments: argparse.Namespace) -> Control:
    """Open the agent's control socket: the one on the command line, else the usual places.

    Raises:
        NoAgentError: no agent listens there, or not for this user.
    """
    return Control.open(Path(arguments.socket) if arguments.socket else None)
