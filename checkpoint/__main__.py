"""Entry point of a keeper (``python -m checkpoint keeper``, see `checkpoint.keeper.server`) and of the process that forks an
agent's keepers (``keepers``, see `checkpoint.keeper.fork_server`)."""

from __future__ import annotations

import gc
import sys

from checkpoint.runtime import early_interrupt


def main() -> int:
    """Load and run what the words of this process say."""
    early_interrupt.begin()
    return early_interrupt.left(run(sys.argv[1:]))


def run(words: list[str]) -> int:
    """Load and run the keeper, or what forks keepers."""
    gc.disable()  # nothing that is loaded is rubbish, and reference counting frees what captures make
    from checkpoint.runtime import allocator, slim_imports

    allocator.be_frugal()
    slim_imports.begin()
    slim_imports.load_numpy()
    from checkpoint.keeper import fork_server, server

    return fork_server.main(words) if words[:1] == ["keepers"] else server.main(words)


if __name__ == "__main__":
    sys.exit(main())
