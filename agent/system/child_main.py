"""Entry point of the agent's other processes, as small as the main loop's (`checkpoint.runtime.slim_imports`).

The main loop starts its worker process with `python -m agent.system.child_main MODULE ARGUMENT…`.
"""

from __future__ import annotations

import gc
import sys
from importlib import import_module

from checkpoint.runtime import slim_imports


def main() -> int:
    """Be one of the agent's other processes."""
    slim_imports.begin()
    gc.disable()  # nothing that is loaded is rubbish
    module = import_module(sys.argv.pop(1))
    gc.freeze()  # a full collection would look at all of it each time: a pause of tens of milliseconds
    gc.enable()
    return int(module.main())


if __name__ == "__main__":
    sys.exit(main())
