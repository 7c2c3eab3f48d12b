"""How old a value is, how old it can be at most, and how old it may be before the wait is too long; times are arguments.

No two robots' clocks agree, and none is trusted to be right. So an age travels, never an instant: the sender says how old the
value was when the frame left, the receiver counts from the frame's arrival. That is a *lower* bound, because the frame was
under way in between. No transit took longer than a round trip without the time that the other side held it (`transit_max`):
with that added it is an *upper* bound.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Final

NS_PER_US: Final = 1000

AGE_MAX_US: Final = 2**32 - 1
"""The oldest age that travels, 71 minutes; it means: this old, or older."""

NO_ERROR_BOUND: Final = 2**32 - 1
"""As an error in µs: nothing is known about how much older the value may be."""

UNBOUNDED_NS: Final = 2**63 - 1
"""As an age in ns: there is no upper bound."""

EPSILON: Final = Fraction(2, 3)
"""Part of a slot by which the reference may delay its next frame (RA-TDMA). Source: Santos et al., 2009."""


def sent_age_us(stamp_ns: int, left_ns: int) -> int:
    """The age to send, by the clock of the sender alone: rounded down, so that it stays a lower bound."""
    return min(max(left_ns - stamp_ns, 0) // NS_PER_US, AGE_MAX_US)


def received(age_us: int, came_ns: int, transit_max_us: int, sender_error_us: int = 0) -> tuple[int, int]:
    """Stamp in ns and error in µs of a value that came in a frame, by the clock of the receiver alone.

    Args:
        came_ns: when the frame arrived, by the kernel's stamp.
        transit_max_us: no frame is under way for longer; `NO_ERROR_BOUND` while that is not known.
        sender_error_us: the error of the sender's own reading.
    """
    stamp_ns = came_ns - age_us * NS_PER_US
    rounded_us = transit_max_us + sender_error_us + 1  # the age was rounded down by less than 1 µs
    if age_us >= AGE_MAX_US or NO_ERROR_BOUND in (transit_max_us, sender_error_us):
        return stamp_ns, NO_ERROR_BOUND
    return stamp_ns, min(rounded_us, NO_ERROR_BOUND)


def age_max_ns(age_ns: int, error_us: int) -> int:
    """The upper bound of an age, from its lower bound and the bank's error."""
    return UNBOUNDED_NS if error_us == NO_ERROR_BOUND else age_ns + error_us * NS_PER_US


def effective_round_ns(round_ns: int, robots: int, epsilon: Fraction = EPSILON) -> int:
    """T_eff: how long a round takes at most when the reference delays it.

    T_tup × (1 + ε/K); alone (K = 1) a robot delays for no other. With ε = 0 it is the round as configured, the paper's form.
    """
    if robots <= 1:
        return round_ns
    return round_ns + -(-round_ns * epsilon.numerator // (epsilon.denominator * robots))


def bound_ns(period: int, produced_ns: int, transit_ns: int, effective_ns: int, lost: int = 0) -> int:
    """How old an item can be at a receiver while all works.

    min(T_prod, P·T_eff) + T_wt + P·T_eff, and P·T_eff for each frame lost in a row.

    Args:
        period: P, rounds between two transmissions.
        produced_ns: T_prod, the longest time between two puts.
        transit_ns: T_wt, the longest time under way.
        effective_ns: T_eff, see `effective_round_ns`.
        lost: frames lost in a row that are to be borne.
    """
    cycle = period * effective_ns
    return min(produced_ns, cycle) + transit_ns + cycle * (1 + lost)


def is_stale(age_max_ns: int, bound_ns: int) -> bool:
    """Whether a reading may be older than its bound; one without a bound (0) never is."""
    return 0 < bound_ns < age_max_ns
