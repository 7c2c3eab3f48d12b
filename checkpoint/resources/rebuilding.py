"""What every kind's ``rebuild`` knows of the restore as a whole."""

from __future__ import annotations

from dataclasses import dataclass

from checkpoint.engine import RestoreOptions
from checkpoint.errors import RestoreError
from checkpoint.model import Clocks, Fact


@dataclass(frozen=True, slots=True)
class Rebuilding:
    """One restore.

    Attributes:
        clocks: as the program read them at the capture.
        inner_pid: what the process itself will know as its PID.
    """

    options: RestoreOptions
    clocks: Clocks
    inner_pid: int

    @property
    def elapsed_ns(self) -> int:
        """How long ago the capture was."""
        return self.options.elapsed_ns


def number_of(fact: Fact) -> int:
    """A fact that is an integer.

    Raises:
        RestoreError: it is not.
    """
    if not isinstance(fact, int):
        raise RestoreError(f"cannot restore: a resource says {fact!r} where a number belongs")
    return fact
