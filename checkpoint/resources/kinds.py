"""Which kinds of open files there are, in the order in which they are asked."""

from __future__ import annotations

import functools
import socket
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

from checkpoint.engine import REFUSED, Finding
from checkpoint.errors import CaptureError
from checkpoint.linux.descriptor import Descriptor
from checkpoint.model import Fact, Resource
from checkpoint.resources import (
    attached_devices,
    covered_files,
    devices,
    epolls,
    eventfds,
    fifos,
    files,
    internet_sockets,
    kernel_files,
    memory_files,
    namespace_files,
    netlink_sockets,
    packet_sockets,
    pidfds,
    pipes,
    refused_devices,
    shared,
    signalfds,
    sockets,
    streams,
    tcp_connections,
    terminals,
    timerfds,
    unix_sockets,
    unsupported,
    watches,
)
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings

Observer = Callable[[OpenFile, Opened], Mapping[str, Fact]]
"""Given one open file, and all."""


class Kind(Protocol):
    """What every file of this room has; for an open file of another kind both answer None."""

    KIND: str

    def describe(self, held: OpenFile, surroundings: Surroundings, /) -> Resource | None:
        """The open file as facts."""

    def refuse(self, held: OpenFile, surroundings: Surroundings, /) -> str | None:
        """Why it cannot be kept."""


ASKED: Final[tuple[Kind, ...]] = (
    attached_devices,
    terminals,
    streams,
    shared,
    kernel_files,
    memory_files,
    covered_files,
    files,
    devices,
    pipes,
    fifos,
    eventfds,
    timerfds,
    signalfds,
    pidfds,
    namespace_files,
    epolls,
    watches,
    unix_sockets,
    tcp_connections,
    internet_sockets,
    netlink_sockets,
    packet_sockets,
    refused_devices,
    unsupported,
)
"""The last one refuses whatever no other took."""

_OBSERVED: Final[Mapping[str, Observer]] = {
    timerfds.TARGET: timerfds.observe,
    epolls.TARGET: epolls.observe,
    watches.TARGET: watches.observe,
    pidfds.TARGET: pidfds.observe,
}
"""By the kernel's name for an open file."""


def observer_of(one: Descriptor, noted: sockets.Noted | None) -> Observer | None:
    """What asks an open file for what only a process that stands still can tell.

    Args:
        noted: see `sockets.queue_of`; None for a process that runs.
    """
    if one.target == eventfds.TARGET:
        return eventfds.observe if noted is not None and not eventfds.is_told(one) else None
    if one.target.startswith(("anon_inode:", "pipe:")):
        return _OBSERVED.get(one.target)
    if sockets.is_socket(one):
        return functools.partial(observe_socket, noted=noted)
    if terminals.is_terminal(one):
        return terminals.observe
    if memory_files.is_memory_file(one):
        return memory_files.observe
    return fifos.observe if fifos.is_fifo(one) else _OBSERVED.get(one.target)


def observe_socket(held: OpenFile, opened: Opened, *, noted: sockets.Noted | None) -> Mapping[str, Fact]:
    """A socket of a family that is kept; nothing of another.

    Raises:
        CaptureError: it cannot be looked into.
    """
    try:
        with sockets.looked_into(held.pid, held.first.number) as looked:
            if looked.family == socket.AF_UNIX:
                return unix_sockets.observe(held, looked, opened, noted)
            if looked.family == socket.AF_NETLINK:
                return netlink_sockets.observe(held, looked, opened)
            if packet_sockets.is_mine(looked):
                return packet_sockets.observe(held, looked, opened)
            if internet_sockets.is_kept(looked.family, looked.type, looked.proto):
                return _observe_internet_socket(held, looked, opened, noted)
    except OSError as error:
        raise CaptureError(f"cannot look into the socket {held.name} of pid {held.pid}: {error.strerror}; try again") from error
    return {}


def _observe_internet_socket(
    held: OpenFile, looked: socket.socket, opened: Opened, noted: sockets.Noted | None
) -> Mapping[str, Fact]:
    facts = internet_sockets.observe(held, looked, opened, noted)
    if internet_sockets.is_of_tcp(facts) and facts["state"] == internet_sockets.CLOSED:
        facts["ends"] = tcp_connections.ends_of(looked)
    return (
        facts | tcp_connections.observe(held, looked, facts, opened.listings) if tcp_connections.is_connection(facts) else facts
    )


def findings_of_all(resources: Sequence[Resource], *, standing: bool) -> tuple[Finding, ...]:
    """What can be told only of all resources of all processes of a component together.

    Args:
        standing: they all stood still.
    """
    return (
        *tcp_connections.findings(resources, standing=standing),
        *internet_sockets.findings(resources),
        *unix_sockets.findings(resources),
        *netlink_sockets.findings(resources),
        *packet_sockets.findings(resources),
        *files.findings(resources),
        *pidfds.findings(resources),
    )


def reasons_of_all(resources: Sequence[Resource]) -> tuple[str, ...]:
    """Why all of them together, of processes that stood still, cannot be kept, one sentence each."""
    return tuple(finding.text for finding in findings_of_all(resources, standing=True) if finding.verdict == REFUSED)
