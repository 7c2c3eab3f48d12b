"""How fast commands reach a device, and how those that wait become one; pure: every instant is an argument.

A device takes at most ``rate_hz`` commands a second; the others wait in the mailbox, in order. Of commands that are declared
``latest``, those that follow one another there become one when the device is free: fields of later ones replace those of earlier
ones. Nothing overtakes anything: a command of another verb in between ends the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import msgspec

from failover.core.messaging.envelope import Envelope

Coalesce = Literal["queue", "latest"]
"""What becomes of commands that wait: each is carried out, or those in a row become one."""

SECOND: Final = 1_000_000_000


class Pace:
    """When the device may get its next command."""

    def __init__(self, rate_hz: float | None) -> None:
        """
        Args:
            rate_hz: the most commands a second; None: as many as come.
        """
        self._period_ns = 0 if rate_hz is None else round(SECOND / rate_hz)
        self._free_ns = 0

    def wait_ns(self, now_ns: int) -> int:
        """How long the next command has to wait; 0: not at all."""
        return max(self._free_ns - now_ns, 0)

    def begun(self, now_ns: int) -> None:
        """A command goes to the device now."""
        self._free_ns = now_ns + self._period_ns


def merged(run: Sequence[Envelope]) -> Envelope:
    """Commands of one verb in a row as one: the newest, with the fields of earlier ones that it does not name."""
    *earlier, newest = run
    if not isinstance(newest.body, Mapping):
        return newest
    body: dict[str, object] = {}
    for one in (*earlier, newest):
        body.update(one.body if isinstance(one.body, Mapping) else {})
    return msgspec.structs.replace(newest, body=body)
