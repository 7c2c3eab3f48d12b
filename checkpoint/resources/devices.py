"""Devices without a state: the kernel's null, zero, full and random numbers. They are opened again.

Facts: ``descriptors``; ``path``; ``flags`` of open(2); ``offset`` is always 0.
"""

from __future__ import annotations

import os
import stat
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.model import Resource
from checkpoint.resources import OpenFile, Surroundings

KIND: Final = "devices"

CAPABILITIES: Final = (preserved(Area.DEVICES, "/dev/null, zero, full, random, urandom", "opened again"),)

MEMORY_MAJOR: Final = 1
STATELESS: Final = {3: "/dev/null", 5: "/dev/zero", 7: "/dev/full", 8: "/dev/random", 9: "/dev/urandom"}
"""Minor numbers of the memory devices. Source: Documentation/admin-guide/devices.txt."""


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The stateless device that an open file is, if it is one."""
    rdev = held.first.rdev
    if not stat.S_ISCHR(held.first.mode) or os.major(rdev) != MEMORY_MAJOR or os.minor(rdev) not in STATELESS:
        return None
    flags, path = held.first.flags & ~os.O_CLOEXEC, STATELESS[os.minor(rdev)]
    return Resource(KIND, held.name, {"descriptors": held.numbers, "path": path, "flags": flags, "offset": 0})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Other devices are refused by ``unsupported``."""
    return None
