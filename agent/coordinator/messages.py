"""What the main loop tells the process that speaks with etcd, and what that answers."""

from __future__ import annotations

from msgspec import Struct

from agent.coordinator_config import CoordinatorConfig
from failover.core.election.coordinator import Said, Word
from failover.core.types import Config


class Know(Struct, frozen=True, tag=True):
    """The team as it is now, its name, and where etcd is; comes first, and after each change."""

    config: Config
    team: str
    coordinator: CoordinatorConfig


class Begin(Struct, frozen=True, tag=True):
    """Begin a round with this word. Answered by Ended."""

    word: Word


class Ended(Struct, frozen=True, tag=True):
    """A round is over; ``trouble``: why etcd took nothing in, "" if it did."""

    said: Said
    trouble: str = ""


ToCoordinator = Know | Begin
