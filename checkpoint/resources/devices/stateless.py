"""Devices without a state: the kernel's null, zero, full and random devices. The restore opens them again.

Facts: ``descriptors``; ``path``; ``flags`` of open(2); ``offset`` is always 0; if the device file was deleted since, ``deleted``
true, and ``mode``, ``device_number``, ``uid``, ``gid``.
"""

from __future__ import annotations

import os
import stat
from typing import Final

from checkpoint.capability import Area, preserved
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.files import unlinked
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "devices"

CAPABILITIES: Final = (preserved(Area.DEVICES, "/dev/null, zero, full, random, urandom", "opened again"),)

FLAGS: Final = os.O_ACCMODE | os.O_APPEND | os.O_NONBLOCK | os.O_DSYNC | os.O_SYNC
MEMORY_MAJOR: Final = 1
STATELESS: Final = {3: "/dev/null", 5: "/dev/zero", 7: "/dev/full", 8: "/dev/random", 9: "/dev/urandom"}
"""Minor numbers of the memory devices. Source: Documentation/admin-guide/devices.txt."""


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The stateless device that an open file is, if it is one."""
    rdev = held.first.rdev
    if not stat.S_ISCHR(held.first.mode) or os.major(rdev) != MEMORY_MAJOR or os.minor(rdev) not in STATELESS:
        return None
    flags, path = held.first.flags & ~os.O_CLOEXEC, STATELESS[os.minor(rdev)]
    facts: dict[str, Fact] = {"descriptors": held.numbers, "path": path, "flags": flags, "offset": 0}
    if not held.first.links and held.first.target.endswith(procfs.DELETED):
        first = held.first
        facts |= {"deleted": True, "path": first.target.removesuffix(procfs.DELETED), "mode": first.mode}
        facts |= {"device_number": rdev, "uid": first.uid, "gid": first.gid}
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Other devices are refused by `refused`."""
    return None


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it again, or a device file like the one that was deleted."""
    facts = held.facts
    flags = number_of(facts["flags"]) & FLAGS
    if not facts.get("deleted"):
        return table.open(str(facts["path"]), flags)
    node = unlinked.make_node(table, str(facts["path"]), number_of(facts["mode"]), number_of(facts["device_number"]))
    made = table.open(f"/proc/self/fd/{node}", flags)
    owner = number_of(facts["uid"]), number_of(facts["gid"])
    table.attempt(f"the deleted device {facts['path']!s} belongs to the user that the program runs as", "fchown", made, *owner)
    table.close(node)
    return made
