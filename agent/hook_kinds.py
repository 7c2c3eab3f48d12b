"""Kinds of operator hooks: the occasions at which a robot may run commands, and the signal that can stand for a command.

`agent.worker.components.hooks` runs the commands. The main loop, too, checks the configuration by this module, so the code that
runs commands is not loaded there.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

Kind = Literal["before_start", "before_capture", "before_resume", "after_resume"]
KINDS: Final[tuple[Kind, ...]] = ("before_start", "before_capture", "before_resume", "after_resume")

SIGNAL: Final = "signal:"
"""Begins the word that stands in place of a command, see `signal_in`."""


def signal_in(command: Sequence[str]) -> int:
    """The signal by which the program itself is told; 0 where a command is run.

    Raises:
        ValueError: it names none that a program can handle.
    """
    if not command or not command[0].startswith(SIGNAL):
        return 0
    number = signal.Signals.__members__.get(command[0].removeprefix(SIGNAL))
    if len(command) > 1 or number is None or number in (signal.SIGKILL, signal.SIGSTOP):
        raise ValueError(f"{' '.join(command)!r} names no signal that a program can handle: say {SIGNAL}SIGUSR2, for one")
    return int(number)


def check_told(commands: Mapping[Any, Sequence[str]]) -> None:
    """Let a signal be a hook where a program can hear it.

    Raises:
        ValueError: it is none, or meant for another occasion.
    """
    for kind, command in commands.items():
        if signal_in(command) and kind != "after_resume":
            raise ValueError(
                f"{kind} = {command[0]!r}: failover cannot wait for a signal's handler; only after_resume takes a signal"
            )
