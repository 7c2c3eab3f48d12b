"""Restore descriptors of the program's own namespaces (/proc/self/ns/net …): each leads to the restored program's namespace.

Facts: ``descriptors``; ``namespace``: its kind, for example "net".

Source: namespaces(7), "The /proc/pid/ns/ directory"; nsfs in fs/nsfs.c.
"""

from __future__ import annotations

import os
import re
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding

KIND: Final = "namespace_files"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "a descriptor of a namespace in which the program lives (/proc/self/ns/net)",
        "stands for the namespace in which the restored program lives",
    ),
    refused(
        Area.PIPES,
        "a descriptor of a namespace in which the program does not live",
        "let the program close it",
        "a namespace in which the program does not live",
    ),
)

_TARGET: Final = re.compile(r"(cgroup|ipc|mnt|net|pid|time|user|uts):\[\d+\]")


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Which kind of namespace it is."""
    kind = _kind_of(held)
    return Resource(KIND, held.name, {"descriptors": held.numbers, "namespace": kind}) if kind else None


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why it cannot be opened again."""
    kind = _kind_of(held)
    if not kind or _is_own(held, kind):
        return None
    return f"{held.name} is {held.first.target}, a namespace in which the program does not live: let the program close it"


def _kind_of(held: OpenFile) -> str:
    found = _TARGET.fullmatch(held.first.target)
    return found[1] if found else ""


def _is_own(held: OpenFile, kind: str) -> bool:
    try:
        return procfs.read_link(held.pid, f"ns/{kind}") == held.first.target
    except (ProcessGoneError, OSError):
        return False


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open that of the process itself."""
    return table.open(f"/proc/self/ns/{held.facts['namespace']!s}", os.O_RDONLY)
