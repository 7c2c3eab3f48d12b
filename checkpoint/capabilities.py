"""The table of what comes back: the rows of all files that carry some."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from types import ModuleType
from typing import Final

from checkpoint import room
from checkpoint.capability import Area, Capability, Verdict
from checkpoint.engines import births, preserved, restore_checks, restore_kinds, restore_vdso
from checkpoint.resources import (
    aio_rings,
    attached_devices,
    carried_connections,
    carried_trees,
    covered_files,
    deadlines,
    death_signals,
    devices,
    elsewhere,
    epolls,
    eventfds,
    fifos,
    files,
    internet_sockets,
    joint,
    kernel_files,
    locks,
    logins,
    memory_files,
    memory_locks,
    namespace_files,
    netlink_sockets,
    packet_sockets,
    pidfds,
    pipes,
    refused_devices,
    refused_threads,
    seccomp,
    shared,
    shared_objects,
    signalfds,
    signalling,
    sockets,
    stops,
    streams,
    system_v_memory,
    tcp_connections,
    terminals,
    thread_rights,
    thread_tables,
    timerfds,
    travelling,
    unix_makers,
    unix_names,
    unix_sockets,
    unkept,
    unsupported,
    watches,
)

CARRIERS: Final[tuple[ModuleType, ...]] = (
    preserved,
    logins,
    births,
    room,
    stops,
    joint,
    shared,
    thread_rights,
    thread_tables,
    deadlines,
    death_signals,
    seccomp,
    refused_threads,
    shared_objects,
    files,
    covered_files,
    carried_trees,
    kernel_files,
    memory_files,
    locks,
    pipes,
    fifos,
    eventfds,
    aio_rings,
    signalfds,
    pidfds,
    namespace_files,
    epolls,
    watches,
    signalling,
    elsewhere,
    timerfds,
    travelling,
    unix_makers,
    unix_names,
    unix_sockets,
    tcp_connections,
    carried_connections,
    internet_sockets,
    netlink_sockets,
    packet_sockets,
    sockets,
    streams,
    terminals,
    devices,
    attached_devices,
    refused_devices,
    unkept,
    unsupported,
    restore_checks,
    restore_vdso,
    restore_kinds,
    memory_locks,
    system_v_memory,
)
"""In the order in which their rows stand within an area and a verdict."""


def rows() -> tuple[Capability, ...]:
    """Every row: by area, within an area what is preserved first and what is refused last."""
    areas, verdicts = list(Area), list(Verdict)
    found = [row for carrier in CARRIERS for row in carried_by(carrier)]
    return tuple(sorted(found, key=lambda row: (areas.index(row.area), verdicts.index(row.verdict))))


def carried_by(carrier: ModuleType) -> tuple[Capability, ...]:
    """The rows of one file."""
    found: tuple[Capability, ...] = carrier.CAPABILITIES
    return found


def row_of(sentence: str) -> Capability | None:
    """The row that a refusal or note belongs to, by the words that it says; None where no row has them."""
    return next((row for row in rows() for part in row.said if _pattern(part).search(sentence)), None)


@cache
def _pattern(part: str) -> re.Pattern[str]:
    return re.compile(".*".join(map(re.escape, part.split("{}"))))


def by_area() -> Mapping[Area, tuple[Capability, ...]]:
    """The rows of each area."""
    return {area: tuple(row for row in rows() if row.area == area) for area in Area}
