"""The entry of the command ``failover``, see `failover.cli.main`."""

from __future__ import annotations

import gc
import sys

from checkpoint import quiet


def main() -> int:
    """Load and run the command line."""
    quiet.begin()
    from failover.cli import ahead

    ahead.start_for(sys.argv[1:])
    gc.disable()  # until the verb is loaded: nothing of that is rubbish
    from checkpoint import lean

    lean.begin()
    from failover.cli.main import main as run

    return quiet.left(run())


if __name__ == "__main__":
    sys.exit(main())
