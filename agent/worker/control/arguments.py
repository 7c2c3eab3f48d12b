"""Arguments of the control socket's verbs; `failover.client.control` defines their meaning."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec

from agent.errors import RefusedError
from checkpoint.arch import EVERY_LEVEL
from failover.config.choices import misfit
from failover.config.team import Robot

SIGNAL_MAX: Final = 64
"""The last real-time signal. Source: signal(7)."""

PID_MAX: Final = (1 << 31) - 1
"""The largest value of a pid_t."""

USER_SIZE_MAX: Final = 256
"""Characters of a user's name: what useradd(8) takes."""

RIGHTS_ASKED_MAX: Final = 8
"""Rights in one question: there are no more."""

DECISIONS_ASKED_MAX: Final = 512
"""Rights times paths in one question: each is a look through all rules, and other clients wait meanwhile."""

PATH_SIZE_MAX: Final = 300
"""Characters of a path in such a question."""

Text = Annotated[str, msgspec.Meta(pattern=r"\A[^\0]*\Z")]
"""Text that the kernel can be told: a string of C ends with a NUL."""

Variable = Annotated[str, msgspec.Meta(pattern=r"\A[^\0=]+\Z")]
"""A name in the environment."""

Offset = Annotated[int, msgspec.Meta(ge=-(1 << 28))]
"""Of a byte in a stream, from its beginning; below zero: so many bytes before its present end."""

Epoch = Annotated[int, msgspec.Meta(ge=0, le=1 << 50)]
"""The epoch that an order was decided on; 0: any."""

Age = Annotated[int, msgspec.Meta(ge=0, le=1 << 50)]
"""Milliseconds since something happened; 0 for no limit."""

HookName = Literal["before_capture", "before_resume", "after_resume"]
"""Occasions for a command that comes with a program, see `agent.worker.components.hooks`."""

Connections = Literal["", "reset", "carry", "refuse"]
"""What becomes of connections with others; "" for the setting of this robot's operator."""

SharedMemory = Literal["", "refuse", "detach"]
"""What becomes of shared memory that others have mapped, too; "" for the setting of this robot's operator."""

T = TypeVar("T")


def arguments_of(kind: type[T], verb: str, arguments: dict[str, Any]) -> T:
    """A verb's arguments, checked.

    Raises:
        RefusedError: one is missing, unknown or of the wrong kind.
    """
    try:
        return msgspec.convert(arguments, kind)
    except msgspec.ValidationError as error:
        at, said = misfit(arguments, kind) or ((), str(error))
        raise RefusedError(f"{verb}: its arguments are not right: {'.'.join(at)}{': ' if at else ''}{said}") from error


class RunArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``run``."""

    argv: list[Text]
    name: str = ""
    env: dict[Variable, Text] = {}
    cwd: Text = "/"
    umask: Annotated[int, msgspec.Meta(ge=0, le=0o777)] = 0o022
    isolate: bool = True
    wait: bool = True
    user: str = ""
    engine: Literal["auto", "ptrace", "cooperative"] = "auto"
    output: Literal["immediate", "committed"] = "immediate"
    portable: Annotated[str, msgspec.Meta(pattern=f"^(no|{'|'.join(EVERY_LEVEL)})?$")] = ""
    hooks: dict[HookName, list[Text]] = {}
    carry: list[Text] = []
    shared: list[Text] = []
    devices: dict[Text, Text] = {}
    connections: Connections = ""
    shared_memory: SharedMemory = ""


class ReserveArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``reserve``."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=PATH_SIZE_MAX)]
    span_ms: Annotated[int, msgspec.Meta(ge=1)]
    why: str = ""


class UnreserveArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``unreserve``; ``breaks``: also another user's."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=PATH_SIZE_MAX)]
    breaks: bool = False


class RightsArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``rights``."""

    user: Annotated[str, msgspec.Meta(min_length=1, max_length=USER_SIZE_MAX)]
    right: str
    path: str


class MayArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``may``."""

    rights: Annotated[list[str], msgspec.Meta(min_length=1, max_length=RIGHTS_ASKED_MAX)]
    paths: Annotated[list[Annotated[str, msgspec.Meta(max_length=PATH_SIZE_MAX)]], msgspec.Meta(max_length=DECISIONS_ASKED_MAX)]


class ProtectArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``protect``."""

    pid: Annotated[int, msgspec.Meta(ge=1, le=PID_MAX)]
    name: str
    carry: list[Text] = []
    shared: list[Text] = []
    devices: dict[Text, Text] = {}
    connections: Connections = ""
    shared_memory: SharedMemory = ""


class StopArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``stop``."""

    name: str
    signal: Annotated[int, msgspec.Meta(ge=1, le=SIGNAL_MAX)] = 15
    epoch: Epoch = 0


class LogsArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``logs``."""

    name: str
    follow: bool = False
    offsets: tuple[Offset, Offset] = (0, 0)
    since_ms: Annotated[int, msgspec.Meta(ge=0)] = 0
    times: bool = False


class NameArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``release`` and ``start``."""

    name: str = ""
    epoch: Epoch = 0


class HandoverArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``handover`` and ``failback``."""

    name: str
    to: str = ""
    epoch: Epoch = 0


class PromoteArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``promote``."""

    name: str
    robot: str = ""
    sure: bool = False
    epoch: Epoch = 0


class DrainArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``drain``."""

    robot: str
    on: bool = True


class PreferArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``prefer``."""

    name: str
    robot: str
    epoch: Epoch = 0


class StatusArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``status``."""

    watch: bool = False
    every_ms: Annotated[int, msgspec.Meta(ge=1, le=3_600_000)] = 500
    team: bool = False


class WhyArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``why``."""

    name: str = ""
    robot: str = ""
    age_ms_max: Age = 0


class PageArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``story``: the page that a robot asks another for when it merges event logs; ``before``: life and number of a line."""

    name: str = ""
    age_ms_max: Age = 0
    before: tuple[int, int] = (0, 0)


class PieceArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``piece``: the bytes that another robot asks for when it passes a stream on."""

    name: str
    stream: int
    offset: Offset
    since_ms: Annotated[int, msgspec.Meta(ge=0)] = 0
    times: bool = False


class TeamArguments(msgspec.Struct, forbid_unknown_fields=True):
    """Of ``team``."""

    act: Literal["add", "remove", "rotate"]
    robot: str
    member: Robot | None = None


class TakenTeam(msgspec.Struct):
    """A team as one robot tells another. See `failover.config.team.Team`.

    Attributes:
        proposer, have: where a grant is asked: by whom, and the change that it has now.
    """

    team: str
    change: int
    robots: dict[str, Robot]
    proposer: str = ""
    have: int = 0
    next_seat: int = 0
    former: dict[str, Robot] = {}
