"""One process of simulated robots, see `failover.simulators.group`."""

from __future__ import annotations

import sys

from failover.simulators.group import main

if __name__ == "__main__":
    sys.exit(main())
