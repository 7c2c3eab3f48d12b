"""The entry of the keeper: ``python -m checkpoint keeper``, see `checkpoint.keeper`."""

from __future__ import annotations

import gc
import sys

from checkpoint import quiet


def main() -> int:
    """Load and run what the words of this process say."""
    quiet.begin()
    return quiet.left(run(sys.argv[1:]))


def run(words: list[str]) -> int:
    """Load and run the keeper."""
    gc.disable()  # of what is loaded nothing is rubbish, and what captures make is freed by counting
    from checkpoint import allocator, lean

    allocator.be_frugal()
    lean.begin()
    lean.load_numpy()
    from checkpoint import keeper

    return keeper.main(words)


if __name__ == "__main__":
    sys.exit(main())
