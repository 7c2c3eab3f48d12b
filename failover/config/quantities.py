"""Spans of time and sizes as people write them: 90s, 10min, 7d; 500MB, 20GB."""

from __future__ import annotations

import re
from typing import Final

SPANS_MS: Final = {"ms": 1, "s": 1_000, "min": 60_000, "h": 3_600_000, "d": 86_400_000}
SIZES: Final = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
DIGITS_MAX: Final = 10

_QUANTITY = re.compile(r"([0-9]+)([A-Za-z]+)")


def span_ms(text: str) -> int:
    """A span of time in milliseconds.

    Raises:
        ValueError: it is none, or none at all.
    """
    return _times(text, SPANS_MS, "span of time; write 90s, 10min, 2h or 3d")


def size_bytes(text: str) -> int:
    """A size in bytes, by powers of ten.

    Raises:
        ValueError: it is none, or nothing.
    """
    return _times(text, SIZES, "size; write 500MB, 20GB or 1TB")


def _times(text: str, units: dict[str, int], what: str) -> int:
    found = _QUANTITY.fullmatch(text)
    if found is None or found[2] not in units or len(found[1]) > DIGITS_MAX or not int(found[1]):
        raise ValueError(f"{text[:40]!r} is no {what}")
    return int(found[1]) * units[found[2]]
