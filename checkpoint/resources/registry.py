"""The kinds of open files, in the order in which they are asked."""

from __future__ import annotations

import functools
import socket
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

from checkpoint.engine import Finding
from checkpoint.errors import CaptureError
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.model import Fact, Resource
from checkpoint.resources import refusals, shared_open_file
from checkpoint.resources.devices import by_rule, refused, stateless
from checkpoint.resources.events import epoll, eventfd, inotify, pidfd, signalfd, timerfd
from checkpoint.resources.files import memfd, namespaces, overmounted, proc_and_sys, regular
from checkpoint.resources.ipc import boards, fifos, pipes, pseudo_terminals, standard_streams
from checkpoint.resources.open_file import Opened, OpenFile, Surroundings
from checkpoint.resources.sockets import inet, netlink, packet, sockets, tcp, unix

Observer = Callable[[OpenFile, Opened], Mapping[str, Fact]]
"""Given one open file, and all."""


class Kind(Protocol):
    """The contract of a module for one kind; for an open file of another kind both answer None."""

    KIND: str

    def describe(self, held: OpenFile, surroundings: Surroundings, /) -> Resource | None:
        """The open file as facts."""

    def refuse(self, held: OpenFile, surroundings: Surroundings, /) -> str | None:
        """Why it cannot be kept."""


ASKED: Final[tuple[Kind, ...]] = (
    by_rule,
    pseudo_terminals,
    standard_streams,
    shared_open_file,
    boards,
    proc_and_sys,
    memfd,
    overmounted,
    regular,
    stateless,
    pipes,
    fifos,
    eventfd,
    timerfd,
    signalfd,
    pidfd,
    namespaces,
    epoll,
    inotify,
    unix,
    tcp,
    inet,
    netlink,
    packet,
    refused,
    refusals,
)
"""The last one refuses everything that no other took."""

_OBSERVED: Final[Mapping[str, Observer]] = {
    timerfd.TARGET: timerfd.observe,
    epoll.TARGET: epoll.observe,
    inotify.TARGET: inotify.observe,
    pidfd.TARGET: pidfd.observe,
}
"""By the kernel's name for an open file."""


def observer_of(one: Descriptor, noted: sockets.Noted | None) -> Observer | None:
    """The function that asks an open file for facts that only a process that stands still can tell.

    Args:
        noted: see `sockets.queue_of`; None for a process that runs.
    """
    if one.target == eventfd.TARGET:
        return eventfd.observe if noted is not None and not eventfd.is_told(one) else None
    if one.target.startswith(("anon_inode:", "pipe:")):
        return _OBSERVED.get(one.target)
    if sockets.is_socket(one):
        return functools.partial(observe_socket, noted=noted)
    if pseudo_terminals.is_terminal(one):
        return pseudo_terminals.observe
    if memfd.is_memory_file(one):
        return memfd.observe
    return fifos.observe if fifos.is_fifo(one) else _OBSERVED.get(one.target)


def observe_socket(held: OpenFile, opened: Opened, *, noted: sockets.Noted | None) -> Mapping[str, Fact]:
    """A socket of a family that is kept; nothing of another.

    Raises:
        CaptureError: it cannot be looked into.
    """
    try:
        with sockets.looked_into(held.pid, held.first.number) as looked:
            if looked.family == socket.AF_UNIX:
                return unix.observe(held, looked, opened, noted)
            if looked.family == socket.AF_NETLINK:
                return netlink.observe(held, looked, opened)
            if packet.is_mine(looked):
                return packet.observe(held, looked, opened)
            if inet.is_kept(looked.family, looked.type, looked.proto):
                return _observe_internet_socket(held, looked, opened, noted)
    except OSError as error:
        raise CaptureError(f"cannot look into the socket {held.name} of pid {held.pid}: {error.strerror}; try again") from error
    return {}


def _observe_internet_socket(
    held: OpenFile, looked: socket.socket, opened: Opened, noted: sockets.Noted | None
) -> Mapping[str, Fact]:
    facts = inet.observe(held, looked, opened, noted)
    if inet.is_of_tcp(facts) and facts["state"] == inet.CLOSED:
        facts["ends"] = tcp.ends_of(looked)
    return facts | tcp.observe(held, looked, facts, opened.listings) if tcp.is_connection(facts) else facts


def findings_of_all(resources: Sequence[Resource], surroundings: Surroundings, *, standing: bool) -> tuple[Finding, ...]:
    """Findings about all resources of all processes of a component together.

    Args:
        standing: they all stood still.
    """
    return (
        *tcp.findings(resources, surroundings, standing=standing),
        *inet.findings(resources, surroundings),
        *unix.findings(resources, surroundings),
        *netlink.findings(resources),
        *packet.findings(resources),
        *regular.findings(resources, surroundings),
        *pidfd.findings(resources),
    )


OF_ALL: Final = frozenset(kind.KIND for kind in (tcp, inet, unix, netlink, packet, regular, pidfd))
"""Kinds of `findings_of_all`: the notes about these may differ at the next capture."""
