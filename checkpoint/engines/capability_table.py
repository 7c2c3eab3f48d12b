"""The whole capability table: the rows of all files that carry rows."""

from __future__ import annotations

from types import ModuleType
from typing import Final

from checkpoint.capability import Area, Capability, Verdict
from checkpoint.engines.ptrace import capability_rows
from checkpoint.engines.ptrace.facts import birth_order, memory_limits
from checkpoint.engines.ptrace.restore import checks, mapping_kinds, vdso
from checkpoint.resources import other_holders, refusals, shared_open_file
from checkpoint.resources.carried import capture
from checkpoint.resources.devices import by_rule, refused, stateless
from checkpoint.resources.events import aio, epoll, eventfd, fd_signals, inotify, pidfd, signalfd, timerfd
from checkpoint.resources.files import locks, memfd, namespaces, overmounted, proc_and_sys, regular
from checkpoint.resources.ipc import boards, fifos, pipes, pseudo_terminals, shared_memory, standard_streams, system_v_memory
from checkpoint.resources.process import (
    audit_login,
    control_groups,
    job_control,
    mlockall,
    parent_death_signals,
    refused_threads,
    scheduling,
    seccomp,
    shared_with_parent,
    thread_credentials,
    unrestorable_state,
    unshared_threads,
)
from checkpoint.resources.sockets import (
    inet,
    netlink,
    packet,
    peer_credentials,
    scm_rights,
    sockets,
    tcp,
    tcp_handover,
    unix,
    unix_names,
)

CARRIERS: Final[tuple[ModuleType, ...]] = (
    capability_rows,
    audit_login,
    birth_order,
    memory_limits,
    job_control,
    shared_with_parent,
    shared_open_file,
    thread_credentials,
    unshared_threads,
    control_groups,
    scheduling,
    parent_death_signals,
    seccomp,
    refused_threads,
    boards,
    shared_memory,
    regular,
    overmounted,
    capture,
    proc_and_sys,
    memfd,
    locks,
    pipes,
    fifos,
    eventfd,
    aio,
    signalfd,
    pidfd,
    namespaces,
    epoll,
    inotify,
    fd_signals,
    other_holders,
    timerfd,
    scm_rights,
    peer_credentials,
    unix_names,
    unix,
    tcp,
    tcp_handover,
    inet,
    netlink,
    packet,
    sockets,
    standard_streams,
    pseudo_terminals,
    stateless,
    by_rule,
    refused,
    unrestorable_state,
    refusals,
    checks,
    vdso,
    mapping_kinds,
    mlockall,
    system_v_memory,
)
"""In the order in which their rows stand within an area and a verdict."""


def rows() -> tuple[Capability, ...]:
    """Every row: by area, within an area preserved things first and refused ones last."""
    areas, verdicts = list(Area), list(Verdict)
    found = [row for carrier in CARRIERS for row in carried_by(carrier)]
    return tuple(sorted(found, key=lambda row: (areas.index(row.area), verdicts.index(row.verdict))))


def carried_by(carrier: ModuleType) -> tuple[Capability, ...]:
    """The rows of one file."""
    found: tuple[Capability, ...] = carrier.CAPABILITIES
    return found
