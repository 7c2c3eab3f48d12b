"""Reads a peer's entry: its state, and whether it consents to this robot's primacy or objects to it."""

from __future__ import annotations

from checkpoint.model import Position
from failover.core.component import Component
from failover.core.membership import Peer
from failover.core.types import State
from failover.core.wire.messages import BARE, Entry

STATES = tuple(State)
"""A state's place in here is its number in a beat."""


def state_of(entry: Entry) -> State:
    """The state that an entry tells of; a number that is none reads as absent."""
    return STATES[entry.state] if 0 <= entry.state < len(STATES) else State.ABSENT


def kept(entry: Entry) -> Position | None:
    """The position from which the sender can restore; None if it has none, or has lost what it held: its own may be older."""
    return None if entry.flags & BARE else entry.position


def grants(component: Component, peer: Peer, me: str) -> bool:
    """Whether the peer consents to our primacy of the present epoch, by its freshest word."""
    entry = peer.entry(component.name)
    agreed = entry is not None and (entry.epoch, entry.primary) == (component.epoch, me)
    return agreed and entry is not None and state_of(entry) is not State.STOPPING


def objects(component: Component, peer: Peer, me: str) -> bool:
    """Whether the peer's fresh word is that it does not follow us. A stale one is no objection: words are told in turn."""
    known = peer.entry(component.name) is not None or peer.complete
    return known and not grants(component, peer, me)
