"""``python -m page``: what ``failover page`` becomes, so that no part of failover imports this floor."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from failover.cli.arguments.page import config_of, page
from failover.cli.main import FAILED, tell
from failover.client.control import SOCKET_VARIABLE
from failover.errors import FailoverError


def main() -> int:
    """Serve; returns the exit status. Errors are told on standard error, never as a traceback."""
    room = argparse.ArgumentParser(prog="failover page")
    page(room)
    arguments = room.parse_args()
    if arguments.socket:
        os.environ[SOCKET_VARIABLE] = arguments.socket  # the board and the schedule lie beside it
    try:
        from page.serve import serve

        serve(config_of(arguments), Path(arguments.socket) if arguments.socket else None, as_json=arguments.json)
    except FailoverError as error:
        return tell(error, arguments, FAILED)
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
