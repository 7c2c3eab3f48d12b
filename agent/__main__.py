"""Entry point of ``failover-agent`` (see `agent.main`). Until the main loop handles Ctrl-C as an orderly end, it ends quietly."""

from __future__ import annotations

import sys

from checkpoint.runtime import early_interrupt


def main() -> int:
    """Load and run the daemon's command line."""
    early_interrupt.begin()
    from checkpoint.runtime import slim_imports

    slim_imports.begin()
    from agent.main import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
