"""All errors of the package `agent`: one family, one sentence per class."""

from __future__ import annotations

from typing import Final

from checkpoint.errors import CheckpointError


class AgentError(Exception):
    """The daemon could not do something; the message says what, on what, why not and what to do."""


class GuardError(AgentError):
    """A guard refused a request, or could not carry it out; the component is as it was."""


class GuardLostError(GuardError):
    """The guard of a component does not answer: it ended, or closed the connection."""


class KeeperLostError(AgentError):
    """The keeper ended before it answered; the program runs on unharmed, a new keeper starts with a base."""


class BallotError(AgentError):
    """The record of what must not be forgotten cannot be read or written; nothing may be decided without it."""


class ConfigError(AgentError):
    """The configuration cannot be used; the message names the file and, where it can, the line."""


class LaneError(AgentError):
    """The replication link could not be opened, or a peer on it broke the rules."""


class DirectoryError(AgentError):
    """The organisation's directory cannot be asked who a user is, or its answer cannot be used."""


class CoordinatorError(AgentError):
    """etcd does not answer, or refuses what it is asked: it has no vote meanwhile."""


class RefusedError(AgentError):
    """A request on the control socket cannot be served.

    Attributes:
        kind: the class name told to the client.
        reasons: one sentence each, with what to do about it.
    """

    def __init__(self, message: str, kind: str = "RefusedError", reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.kind = kind
        self.reasons = reasons


TROUBLE: Final = (CheckpointError, AgentError, OSError)
"""What can go wrong with a program, its processes or a disk, and is told; anything else is our mistake and ends the worker."""
