"""The entry of the agent's other processes, which are as lean as the heart (`checkpoint.runtime.slim_imports`).

`python -m agent.system.child_main MODULE ARGUMENT…` is how the heart starts its lanes.
"""

from __future__ import annotations

import sys
from importlib import import_module

from checkpoint.runtime import slim_imports


def main() -> int:
    """Be one of the agent's other processes."""
    slim_imports.begin()
    module = import_module(sys.argv.pop(1))
    return int(module.main())


if __name__ == "__main__":
    sys.exit(main())
