"""A program that keeps one field of every kind and an array of a MB, and names the Python under which it was started.

Its output: ``# PYTHON NUMPY DIGEST`` at the beginning of each life, where DIGEST is the same for the same state, then numbers.
"""

from __future__ import annotations

import platform
import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import xxhash

import failover
from failover.state import Schema
from tests.samples.state import Sampled, packed, sampled

PAUSE_S: Final = 0.005


@dataclass
class Travelled:
    """What survives.

    Attributes:
        number: of the next line.
    """

    number: int = 0
    luggage: Sampled = field(default_factory=sampled)
    grid: np.ndarray = field(default_factory=lambda: np.arange(1 << 17, dtype=np.float64))


def digest_of(state: Travelled) -> str:
    """Of everything that does not change from line to line."""
    return xxhash.xxh3_64_hexdigest(packed(Schema.of(Sampled, name="sample").encode(state.luggage)) + state.grid[1:].tobytes())


def main() -> None:
    """Say where we are, then count."""
    state = failover.resume("traveller", default=Travelled())
    print("#", platform.python_version(), np.__version__, digest_of(state))
    while True:
        print(state.number)
        state.number += 1
        state.grid[0] = state.number
        failover.commit()
        time.sleep(PAUSE_S)


if __name__ == "__main__":
    main()
