"""Restore the seccomp(2) restrictions of a process's threads: strict mode, and filters.

Facts: ``descriptors`` (none); ``filters``: a list of [instructions, flags], each program once; ``threads``: a list of [tid,
strict, filters], the last a list of positions in ``filters``, oldest first.

The restore installs them while they are suspended (`checkpoint.linux.trace.seccomp`), so that they do not judge the last calls of
the restore. The release of the threads puts them in force. Filters that all threads have in common are installed before the
threads are created, and so they are the same filters in all of them: a filter for all threads (SECCOMP_FILTER_FLAG_TSYNC) can be
added afterwards as before.

Source: seccomp(2).
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux import abi
from checkpoint.linux.trace import seccomp
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.linux.trace.seccomp import FLAG_LOG, FREE, Confinement, Filter
from checkpoint.model import Credentials, Fact, Resource

KIND: Final = "seccomp"

ASKS_ANOTHER: Final = (
    "it runs under a seccomp filter that leaves calls to another process to judge (SECCOMP_RET_USER_NOTIF), which is not kept "
    "yet: run it without that filter"
)

CAPABILITIES: Final = (
    preserved(
        Area.PROCESS,
        "seccomp: filters of the process and of single threads, strict mode",
        "in force again from the first instruction on; failover needs CAP_SYS_ADMIN, and the kernel CONFIG_CHECKPOINT_RESTORE",
    ),
    refused(
        Area.PROCESS,
        "a seccomp filter that lets another process judge calls (SECCOMP_RET_USER_NOTIF); any seccomp filter without "
        "CAP_SYS_ADMIN",
        "run the program without the filter, or failover as root: a capture makes system calls in the program that the "
        "filter may forbid",
        "runs under a seccomp filter",
    ),
)

PR_SET_SECCOMP: Final = 22
STRICT_MODE: Final = 1
SET_FILTER: Final = 1
"""SECCOMP_SET_MODE_FILTER."""
FLAG_SPEC_ALLOW: Final = 4
"""SECCOMP_FILTER_FLAG_SPEC_ALLOW: the switches of the process tell which features of the processor a filter had switched off."""


def not_ours(why: str, who: str = "it") -> str:
    """Why a confined process, or thread, is refused where we may not suspend filters."""
    return f"{who} runs under a seccomp filter, which forbids system calls of a capture: {why}"


def untold(why: str) -> str:
    """Why a process is refused whose filters the kernel does not tell."""
    return f"it runs under a seccomp filter that the kernel does not tell ({why}): run it without that filter"


def describe(threads: Iterable[tuple[int, Confinement]]) -> tuple[Resource, ...]:
    """The confinement of each thread, by its id as it sees it itself."""
    filters: dict[Filter, int] = {}
    told: list[Fact] = []
    for tid, found in threads:
        if found:
            places: list[Fact] = [filters.setdefault(one, len(filters)) for one in found.filters]
            told.append([tid, found.is_strict, places])
    if not told:
        return ()
    listed: list[Fact] = [[one.instructions, FLAG_LOG if one.is_logged else 0] for one in filters]
    return (Resource(KIND, "seccomp", {"descriptors": [], "filters": listed, "threads": told}),)


def mismatches(held: Resource) -> Iterator[str]:
    """Why it cannot be had here."""
    if why := seccomp.why_not():
        yield f"it runs under a seccomp filter, which would forbid system calls of a restore: {why}"


def is_confined(resources: Iterable[Resource]) -> bool:
    """Whether any thread is."""
    return any(held.kind == KIND for held in resources)


def of_thread(resources: Iterable[Resource], tid: int) -> Confinement:
    """The confinement of a thread."""
    for held in resources:
        if held.kind == KIND:
            filters, threads = held.facts["filters"], held.facts["threads"]
            assert isinstance(filters, list) and isinstance(threads, list)
            for one in threads:
                assert isinstance(one, list) and isinstance(one[2], list)
                if one[0] == tid:
                    return Confinement(bool(one[1]), tuple(_filter(filters[int(str(place))]) for place in one[2]))
    return FREE


def _filter(fact: Fact) -> Filter:
    assert isinstance(fact, list) and isinstance(fact[0], bytes) and isinstance(fact[1], int)
    return Filter(fact[0], bool(fact[1] & FLAG_LOG))


def of_all(resources: Sequence[Resource], tids: Iterable[int]) -> tuple[Filter, ...]:
    """The filters that all threads begin with."""
    chains = [of_thread(resources, tid).filters for tid in tids]
    alike = itertools.takewhile(lambda ones: len(set(ones)) == 1, zip(*chains, strict=False))
    return tuple(ones[0] for ones in alike)


def install(table: CallTable, filters: Iterable[Filter], credentials: Credentials) -> None:
    """Add the calls that put filters on the thread that makes them, oldest first; it has not given up its rights yet.

    Args:
        credentials: that the thread is to have.
    """
    for number, one in enumerate(filters):
        if not number and credentials.no_new_privs:
            table.call("forbid new privileges", "prctl", abi.PR_SET_NO_NEW_PRIVS, 1)
        program = struct.pack("<HxxxxxxQ", len(one.instructions) // abi.SOCK_FILTER_SIZE, table.place(one.instructions))
        flags = FLAG_SPEC_ALLOW | (FLAG_LOG if one.is_logged else 0)
        table.call("install a seccomp filter", "seccomp", SET_FILTER, flags, table.place(program))


def confine(table: CallTable, found: Confinement, done: int, credentials: Credentials) -> None:
    """As `install`, what else a thread is confined to.

    Args:
        done: filters that it was born with.
    """
    install(table, found.filters[done:], credentials)
    if found.is_strict:
        table.call("enter seccomp's strict mode", "prctl", PR_SET_SECCOMP, STRICT_MODE)
