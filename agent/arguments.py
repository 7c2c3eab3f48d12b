"""What the verbs of the control socket take; their meaning: `failover.client.control`."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from agent.errors import RefusedError

T = TypeVar("T")


def arguments_of(kind: type[T], verb: str, arguments: dict[str, Any]) -> T:
    """A verb's arguments, checked.

    Raises:
        RefusedError: one is missing, unknown or of the wrong kind.
    """
    try:
        return msgspec.convert(arguments, kind)
    except msgspec.ValidationError as error:
        raise RefusedError(f"{verb}: its arguments are not right: {error}") from error


class RunArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``run``."""

    argv: list[str]
    name: str = ""
    env: dict[str, str] = {}
    cwd: str = "/"
    umask: int = 0o022
    isolate: bool = True
    wait: bool = True


class ProtectArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``protect``."""

    pid: int
    name: str


class StopArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``stop``."""

    name: str
    signal: int = 15


class LogsArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``logs``."""

    name: str
    follow: bool = False
    offsets: tuple[int, int] = (0, 0)


class NameArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``release``, ``failback`` and ``why``."""

    name: str = ""


class HandoverArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``handover``."""

    name: str
    to: str = ""


class PreferArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``prefer``."""

    name: str
    robot: str


class StatusArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``status``."""

    watch: bool = False
    every_ms: int = 500
    team: bool = False


class PieceArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``piece``: what another robot asks for when it passes a stream on."""

    name: str
    stream: int
    offset: int
