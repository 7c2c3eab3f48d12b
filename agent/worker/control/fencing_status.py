"""Status of fencing in one sentence: how a program here is kept from acting when it may not, and what this robot lacks for it.

Each part alone, and agent and keeper together, may die or stand still: the guard freezes its program before the lease ends, and a
guard that stands still is ended with its program. One case remains: all of them stand still at once, as in a machine that hangs
for a while and then continues. Nothing here helps then: a hardware watchdog must reset the robot, or another machine or a person
must switch it off.

Source: the kernel's Documentation/watchdog/watchdog-api.rst and Documentation/ABI/testing/sysfs-class-watchdog.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from msgspec import Struct

WATCHDOGS: Final = Path("/sys/class/watchdog")
ACTIVE: Final = "active"

GUARDED: Final = "guards freeze programs when the lease is over"
MORE: Final = "docs/fencing.md"


class Watchdog(Struct, frozen=True):
    """A hardware watchdog that a program feeds, as far as the kernel tells.

    Attributes:
        timeout_s: without a sign of life for so long it resets the machine; 0: not told.
        is_told: False: it is there, and a kernel without CONFIG_WATCHDOG_SYSFS does not tell whether a program feeds it. Opening
            the device would tell, and start it.
    """

    identity: str
    timeout_s: int
    is_told: bool = True


def watchdog(directory: Path = WATCHDOGS) -> Watchdog | None:
    """The first active one, else the first of which that is not known; None where there is none, or no program feeds one."""
    places = sorted(directory.glob("watchdog*"))
    active = [place for place in places if _fact(place, "state") == ACTIVE]
    untold = [place for place in places if not _fact(place, "state")]
    for place in (*active, *untold):
        timeout = _fact(place, "timeout")
        seconds = int(timeout) if timeout.isdecimal() else 0
        return Watchdog(_fact(place, "identity") or place.name, seconds, is_told=place in active)
    return None


def sentence(found: Watchdog | None) -> str:
    """For ``failover status``."""
    if found is None:
        return f"{GUARDED}; if all of this robot hangs, nothing does: no hardware watchdog is active ({MORE})"
    if not found.is_told:
        return (
            f"{GUARDED}; if all of this robot hangs, only its watchdog ({found.identity}) would help, and this kernel does not "
            f"tell whether a program feeds it ({MORE})"
        )
    after = f"after {found.timeout_s} s" if found.timeout_s else "after its timeout"
    return f"{GUARDED}; if all of this robot hangs, its watchdog ({found.identity}) would reset it {after}"


def _fact(place: Path, name: str) -> str:
    try:
        return (place / name).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
