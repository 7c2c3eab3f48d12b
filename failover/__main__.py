"""Entry point of the command ``failover``, see `failover.cli.main`."""

from __future__ import annotations

import gc
import sys

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


if __name__ == "__main__":
    sys.exit(main())
