"""A driver that keeps nothing, and notes in a file what it carries out: ``python noting.py FILE``."""

from __future__ import annotations

import os
import sys

import failover


@failover.driver("Lab/robot1/Noting", alias="noting")
class Noting:
    def __init__(self) -> None:
        self.file = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    @failover.command
    def note(self, number: int) -> int:
        os.write(self.file, f"{number}\n".encode())
        return number


if __name__ == "__main__":
    failover.run(Noting)
