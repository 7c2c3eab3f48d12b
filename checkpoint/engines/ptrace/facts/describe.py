"""Collect the facts about a running process besides its pages, from /proc and from the answers of the process."""

from __future__ import annotations

import functools
import os

from blake3 import blake3

from checkpoint.engines.ptrace.facts.remote_queries import Told
from checkpoint.errors import ProbeError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.particulars import Told as Facts
from checkpoint.linux.procfs.procfs import Stat, Status
from checkpoint.linux.spawn import cpuid
from checkpoint.model import Credentials, Machine, MemoryLayout


def layout(stat: Stat, told: Told, auxv: bytes) -> MemoryLayout:
    """Where code, data, heap, stack, arguments and environment lie."""
    return MemoryLayout(
        start_code=stat.start_code,
        end_code=stat.end_code,
        start_data=stat.start_data,
        end_data=stat.end_data,
        start_brk=stat.start_brk,
        brk=told.brk,
        start_stack=stat.start_stack,
        arg_start=stat.arg_start,
        arg_end=stat.arg_end,
        env_start=stat.env_start,
        env_end=stat.env_end,
        auxv=auxv,
    )


def credentials(status: Status, told: Told) -> Credentials:
    """Whose rights it has."""
    return Credentials(
        uids=status.uids,
        gids=status.gids,
        groups=status.groups,
        capabilities=status.capabilities,
        no_new_privs=status.no_new_privs,
        securebits=told.securebits,
    )


def coredump_filter(facts: Facts) -> int:
    """Source: core(5); the file is empty for a process without memory, and missing where the kernel makes no core dumps."""
    try:
        return int(facts.read("coredump_filter"), 16)
    except (ProbeError, ValueError):
        return -1


def this_machine() -> Machine:
    """Where we run; ``robot`` and ``xstate_mask`` are left to the capture."""
    about = os.uname()
    return Machine(
        architecture=about.machine,
        page_size=abi.PAGE_SIZE,
        kernel=about.release,
        boot_id=_boot_id(),
        hostname=about.nodename,
        features=cpuid.features(),
        vdso_digest=_vdso_digest(),
    )


@functools.cache
def _boot_id() -> str:
    """The kernel's own, which stays the same as long as we live."""
    with open("/proc/sys/kernel/random/boot_id") as file:
        return file.read().strip()


@functools.cache
def _vdso_digest() -> bytes:
    """The digest of our own vdso, which stays the same as long as we live; a restore asks for it three times a process."""
    own = os.getpid()
    for line in procfs.parse_maps(procfs.read_text(own, "maps")):
        if line.name == "[vdso]":
            return blake3(Memory(own).read(line.start, line.size)).digest()
    return b""
