"""Check whether this machine has enough memory for all processes of a component together.

Memory that the processes have in common since a fork exists once while the component runs, and once in a snapshot. But a keeper
that makes or restores a whole snapshot holds it once for each process for a moment. Where that is more than the machine can give,
the kernel would kill a process; so the keeper refuses in advance.

The limit of a control group around this process (memory.max) counts as the machine's own.

Source: proc_meminfo(5), proc_pid_status(5).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from checkpoint.capability import Area, refused
from checkpoint.errors import ProcessGoneError
from checkpoint.linux import cgroup_memory
from checkpoint.linux.procfs import procfs
from checkpoint.model import Snapshot

CAPABILITIES: Final = (
    refused(
        Area.MEMORY,
        "a program of several processes that together hold more than its machine has free, each counted alone",
        "start fewer processes, or give the machine memory or swap",
        "its processes hold {} GB together, and copying them takes {} GB",
        "its processes hold {} GB where each has its own",
    ),
)

COPIES: Final = 2
"""A keeper that takes a base holds everything twice: as it was read, and in the order of the snapshot."""

GB: Final = 10**9
_KIB: Final = 1024
_FREE: Final = re.compile(r"^(?:MemAvailable|SwapFree):\s+(\d+) kB$", re.MULTILINE)
_SWAP: Final = re.compile(r"^SwapFree:\s+(\d+) kB$", re.MULTILINE)
_COPIED: Final = re.compile(r"^(?:RssAnon|VmSwap):\s+(\d+) kB$", re.MULTILINE)


def free() -> int:
    """Bytes that programs can still have here, those of the swap included; control groups of this process may leave it less."""
    told = Path("/proc/meminfo").read_text()
    return min(_added(_FREE, told), cgroup_memory.left(_added(_SWAP, told)))


def held(pid: int) -> int:
    """Bytes of a process's private memory, pages shared since a fork included; 0 of a process that has ended.

    Shared memory is copied once, for all processes that map it.
    """
    try:
        return _added(_COPIED, procfs.read_text(pid, "status"))
    except ProcessGoneError:
        return 0


def _added(pattern: re.Pattern[str], text: str) -> int:
    return sum(int(found) for found in pattern.findall(text)) * _KIB


def refuse_capture(pids: Iterable[int]) -> tuple[str, ...]:
    """Why a base of several processes cannot be taken here."""
    size, room = sum(map(held, pids)), free()
    if COPIES * size <= room:
        return ()
    told = size / GB, COPIES * size / GB, room / GB
    return (
        f"its processes hold {told[0]:.1f} GB together, and copying them takes {told[1]:.1f} GB; {told[2]:.1f} GB are free: "
        "start fewer, or give this machine, or the agent's control group, memory or swap",
    )


def refuse_restore(state: Snapshot) -> tuple[str, ...]:
    """Why a base of several processes cannot be restored here."""
    if not state.copies:
        return ()
    size, room = len(memoryview(state.contents).cast("B")) + sum(copy.size for copy in state.copies), free()
    if size <= room:
        return ()
    return (
        f"its processes hold {size / GB:.1f} GB where each has its own, and this machine has {room / GB:.1f} GB free for that: "
        "end something here, or give it, or the agent's control group, memory or swap",
    )
