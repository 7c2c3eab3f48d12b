"""The agent's log: lines to standard error, where systemd's journal or a terminal takes them."""

from __future__ import annotations

import logging
import sys


def set_up_log(level: str) -> None:
    """Begin to write lines of that level and above."""
    logging.basicConfig(
        level=level.upper(), stream=sys.stderr, format="%(asctime)s %(levelname).1s %(name)s: %(message)s", datefmt="%H:%M:%S"
    )
