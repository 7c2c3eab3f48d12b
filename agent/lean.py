"""The entry of the agent's other processes, which are as lean as the heart (`checkpoint.lean`).

`python -m agent.lean MODULE ARGUMENT…` is how the heart starts its lanes.
"""

from __future__ import annotations

import sys
from importlib import import_module

from checkpoint import lean


def main() -> int:
    """Be one of the agent's other processes."""
    lean.begin()
    module = import_module(sys.argv.pop(1))
    return int(module.main())


if __name__ == "__main__":
    sys.exit(main())
