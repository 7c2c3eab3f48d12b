"""Entry points of the commands ``failover`` (see `failover.cli.main`) and ``failover-agent`` (see `agent.__main__`)."""

from __future__ import annotations

import gc
import sys
from importlib import import_module

from checkpoint.runtime import early_interrupt


def main() -> int:
    """Load and run the command line."""
    early_interrupt.begin()
    from failover.cli import keeper_prestart

    keeper_prestart.start_for(sys.argv[1:])
    gc.disable()  # until the verb is loaded: nothing of that is rubbish
    from checkpoint.runtime import slim_imports

    slim_imports.begin()
    from failover.cli.main import main as run

    return early_interrupt.left(run())


def agent() -> int:
    """Load and run the daemon's command line: a wheel has it elsewhere than a checkout, and both have this module."""
    return int(import_module("agent.__main__").main())


if __name__ == "__main__":
    sys.exit(main())
