"""A medium, links that share one collision domain such as a radio: has it slots, how are frames cast, do all fit a round.

A frame goes to all members of a medium by one *multicast* datagram; where that does not arrive, by *broadcast*; where that does
not, either, by one *unicast* datagram for each member, which a radio acknowledges and repeats by itself.
"""

from __future__ import annotations

import enum
import math

from msgspec import Struct

LOAD_MAX = 0.8
"""Of a round may be on the air if all robots send; the rest is for beacons, acknowledgements and others."""

HEADERS_SIZE = 64
"""Bytes of IEEE 802.11, LLC, IP and UDP around a frame."""

PREAMBLE_US = 192
"""The long preamble and header of 802.11b. Source: IEEE 802.11-2007, 15.2.2."""

SPACING_US = 50 + 310
"""Mean of what a station waits before each frame: DIFS, and 15.5 of the 31 slots of the first window."""

STEP_MS = 5
"""A round is proposed in steps of this."""

UNHEARD_ROUNDS = 20
"""Rounds without a sign that any robot hears us, though we hear some, after which another way to cast is tried: a second."""


RETRY_ROUNDS = 3_000
"""Rounds after which ``auto`` begins again with multicast: a minute of heartbeats. Switches and filters are set up anew."""


class Cast(enum.StrEnum):
    """How a frame reaches all members of a medium."""

    AUTO = "auto"
    MULTICAST = "multicast"
    BROADCAST = "broadcast"
    UNICAST = "unicast"


FALLBACK = {Cast.MULTICAST: Cast.BROADCAST, Cast.BROADCAST: Cast.UNICAST}
"""What follows a way that does not work, under ``auto``; unicast is what heartbeats always used, and is kept."""


class Medium(Struct, frozen=True):
    """A medium, as it is configured.

    Attributes:
        name: for messages.
        is_wireless: by what the kernel says of its links.
        slots: None: exactly where it is wireless.
        cast: how frames go to all.
        rate_mbps: at which they do, None where that is not known: multicast on a radio goes at its lowest basic rate.
    """

    name: str
    is_wireless: bool
    slots: bool | None = None
    cast: Cast = Cast.AUTO
    rate_mbps: float | None = None

    @property
    def is_slotted(self) -> bool:
        """Whether robots take turns on it."""
        return self.is_wireless if self.slots is None else self.slots


def air_us(size: int, rate_mbps: float, copies: int = 1) -> int:
    """How long a frame of ``size`` bytes takes on a radio, with what it waits for before; ``copies``: in unicast of each."""
    return copies * (SPACING_US + PREAMBLE_US + math.ceil((size + HEADERS_SIZE) * 8 / rate_mbps))


def overload(medium: Medium, robots: int, size: int, t_tup_ms: int) -> str:
    """Why so many robots with frames of ``size`` bytes do not fit a round, and the cure; "" if they do or that is not known."""
    if not medium.is_slotted or medium.rate_mbps is None:
        return ""
    copies = max(robots - 1, 1) if medium.cast is Cast.UNICAST else 1
    each_us = air_us(size, medium.rate_mbps, copies)
    needed_ms = robots * each_us / 1_000
    if needed_ms <= LOAD_MAX * t_tup_ms:
        return ""
    least_ms = math.ceil(needed_ms / LOAD_MAX / STEP_MS) * STEP_MS
    return (
        f"medium {medium.name}: {robots} robots × {each_us / 1_000:.1f} ms need {needed_ms:.0f} ms of air, more than "
        f"{LOAD_MAX:.0%} of a round of {t_tup_ms} ms: t_tup_ms ≥ {least_ms}, or fewer and shorter items"
    )


def room(medium: Medium, robots: int, t_tup_ms: int, most: int) -> int:
    """Bytes of one frame so that all robots fit a round; ``most`` where the rate is not known, and never more than that."""
    if not medium.is_slotted or medium.rate_mbps is None or not robots:
        return most
    copies = max(robots - 1, 1) if medium.cast is Cast.UNICAST else 1
    each_us = math.floor(LOAD_MAX * t_tup_ms * 1_000 / robots / copies)
    return max(min(math.floor((each_us - SPACING_US - PREAMBLE_US) * medium.rate_mbps / 8) - HEADERS_SIZE, most), 0)


def dropped(items: tuple[tuple[int, int], ...], size_max: int) -> tuple[int, ...]:
    """Which items a frame leaves out so that the others fit: those of the longest period first, of equal ones the last.

    Args:
        items: (period in rounds, bytes) of each, in the order of their declaration.

    Returns:
        places in ``items``, ascending.
    """
    left, size = [], sum(size for _, size in items)
    for place in sorted(range(len(items)), key=lambda place: (-items[place][0], -place)):
        if size <= size_max:
            break
        left.append(place)
        size -= items[place][1]
    return tuple(sorted(left))


class Casting:
    """Which way frames are cast on one medium now. Invariant: under another setting than ``auto`` it never changes.

    Attributes:
        why: the present way was chosen, "" for the first choice.
    """

    def __init__(self, cast: Cast) -> None:
        self._is_auto = cast is Cast.AUTO
        self.now = Cast.MULTICAST if self._is_auto else cast
        self.why = ""
        self._unheard = self._rounds = 0

    def failed(self, reason: str) -> bool:
        """The kernel refused a send; whether another way is to be tried at once."""
        return self._fall_back(reason)

    def round_over(self, heard: int, hears_us: int) -> bool:
        """Once a round: how many robots we hear, and how many of those hear us; whether frames are cast in another way now."""
        self._rounds += 1
        if self._is_auto and self.now is not Cast.MULTICAST and self._rounds >= RETRY_ROUNDS:
            self.now, self.why, self._unheard, self._rounds = Cast.MULTICAST, "", 0, 0
            return True
        self._unheard = self._unheard + 1 if heard and not hears_us else 0
        return self._unheard >= UNHEARD_ROUNDS and self._fall_back(f"{heard} robots are heard, and none has heard a {self.now}")

    def _fall_back(self, reason: str) -> bool:
        after = FALLBACK.get(self.now) if self._is_auto else None
        if after is None:
            return False
        self.now, self.why, self._unheard, self._rounds = after, reason, 0, 0
        return True
