"""The trial of a new version: what came since the switch, when it has proved itself, and when it has failed; pure.

    Trial(health, now) → handled(message) … → verdict(now): wait | ask | passed

Every instant is an argument. Whoever runs the trial rolls back at the first failure, and gives the old version `replay`.
"""

from __future__ import annotations

import enum
from typing import Any, Final

from msgspec import Struct

from failover.core.programs.manifest import MESSAGES_MAX, Health

SECOND: Final = 1_000_000_000
JOURNAL_MAX: Final = MESSAGES_MAX
"""Commands that are remembered for a replay: three minutes at 20 Hz. Who has carried out so many has proved itself."""


class Verdict(enum.Enum):
    """What is to be done with the new version."""

    WAIT = "wait"
    ASK = "ask"
    PASSED = "passed"


class Command(Struct, frozen=True):
    """A message that the new version has carried out, as the old one will get it."""

    verb: str
    body: Any


class Trial:
    """One trial, from a switch to its end."""

    def __init__(self, health: Health, now_ns: int) -> None:
        self._health = health
        self._until_ns = now_ns + round(health.seconds * SECOND)
        self._journal: list[Command] = []
        self._messages = 0

    def handled(self, command: Command, *, changes: bool) -> None:
        """The new version has carried out a message. ``changes``: it was a command, and belongs into a replay."""
        self._messages += 1
        if changes:
            self._journal.append(command)

    @property
    def replay(self) -> tuple[Command, ...]:
        """The commands since the switch, in order: at most `JOURNAL_MAX`."""
        return tuple(self._journal)

    @property
    def messages(self) -> int:
        """How many were carried out."""
        return self._messages

    def verdict(self, now_ns: int) -> Verdict:
        """Whether it has proved itself by now."""
        is_over = now_ns >= self._until_ns and self._messages >= self._health.messages
        if not is_over and len(self._journal) < JOURNAL_MAX:
            return Verdict.WAIT
        return Verdict.ASK if self._health.query else Verdict.PASSED

    def wait_ns(self, now_ns: int) -> int | None:
        """How long until the verdict can change without a message; None: it needs messages."""
        if self._messages < self._health.messages:
            return None
        return max(self._until_ns - now_ns, 0)
