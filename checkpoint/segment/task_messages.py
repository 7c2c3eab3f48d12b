"""The messages between a guard and a cooperating program, as bytes. TASK.md beside this file is normative.

The guard listens before the program is started, at a name that it leaves in the program's environment (`VARIABLE`). The program,
or a child of it, connects when it has a state to keep, says `Hello` and waits for `Begin`. Neither waits for the other
afterwards.

Both ends may be hostile to each other: a packet is decoded strictly, or refused as a whole.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from checkpoint.errors import TaskPacketError

VARIABLE: Final = "FAILOVER_TASK"
"""Names the guard's socket: `NAME_PREFIX` and 16 hexadecimal digits; the first character stands for a zero byte."""
NAME_PREFIX: Final = "@failover."
NAME: Final = re.compile(re.escape(NAME_PREFIX) + "[0-9a-f]{16}")

VERSION: Final = 1
PACKET_SIZE_MAX: Final = 512
COMPONENT_SIZE: Final = 256
ROBOT_SIZE: Final = 64
TEXT_SIZE: Final = 504
"""Bytes of the three fields for text, the zero byte at the end included."""

RESTARTED: Final = "restarted"
TAKEN_OVER: Final = "taken over"
HANDED_OVER: Final = "handed over"
REASONS: Final = (RESTARTED, TAKEN_OVER, HANDED_OVER)
"""Why a program goes on from a state: on the same robot; on another after a loss; on another as it was ordered."""

_HEAD: Final = struct.Struct("<II")
_BEGIN: Final = struct.Struct(f"<QQQIIQQ{COMPONENT_SIZE}s{ROBOT_SIZE}s")
_REFUSED: Final = struct.Struct(f"<{TEXT_SIZE}s")
_SAFE: Final = struct.Struct("<Q")
_KINDS: Final = {"Hello": 1, "Begin": 2, "Refused": 3, "Keeps": 4, "Safe": 5, "Kept": 6}


class Origin(Struct, frozen=True):
    """Where the state comes from that a program goes on with.

    Attributes:
        robot: where it was committed.
        generation: of the checkpoint that holds it.
        why: one of `REASONS`.
        age_ns: between the commit and the start of the program.
    """

    robot: str
    generation: int
    why: str
    age_ns: int


class Hello(Struct, frozen=True):
    """From the program, first of all: it has a state to keep, and waits to be told how to begin."""


class Begin(Struct, frozen=True):
    """Begin, or go on. With descriptors: the counters of its streams, and its state as a segment if there is an origin.

    Attributes:
        component: its name.
        epoch: of the primacy under which it runs: the fencing token.
        pipes: inode numbers of its standard output and error: a program that finds others there has redirected them.
    """

    component: str
    epoch: int
    pipes: tuple[int, int]
    origin: Origin | None = None


class Refused(Struct, frozen=True):
    """The guard will not keep this process's state; it hangs up after saying why."""

    text: str


class Keeps(Struct, frozen=True):
    """From the program, after its first commit to each segment: a capture finds something there from now on."""


class Safe(Struct, frozen=True):
    """A standby holds everything up to this commit of this program's lineage."""

    commit: int


class Kept(Struct, frozen=True):
    """No robot can stand by now; this robot's own disk holds everything up to this commit of this program's lineage."""

    commit: int


FromProgram = Hello | Keeps
FromGuard = Begin | Refused | Safe | Kept
Packet = FromProgram | FromGuard


def encode(packet: Packet) -> bytes:
    """The bytes of a packet. Names fit their fields; a reason that does not is cut."""
    head = _HEAD.pack(_KINDS[type(packet).__name__], VERSION)
    match packet:
        case Begin():
            return head + _begin_body(packet)
        case Refused(text):
            return head + _REFUSED.pack(text.encode(errors="replace")[: TEXT_SIZE - 1].decode(errors="ignore").encode())
        case Safe(commit) | Kept(commit):
            return head + _SAFE.pack(commit)
        case _:
            return head


def _begin_body(begin: Begin) -> bytes:
    origin = begin.origin or Origin("", 0, "", 0)
    component, robot = begin.component.encode(), origin.robot.encode()
    assert len(component) < COMPONENT_SIZE and len(robot) < ROBOT_SIZE, "names are shorter than their fields"
    why = REASONS.index(origin.why) + 1 if begin.origin else 0
    return _BEGIN.pack(begin.epoch, *begin.pipes, why, 0, origin.generation, origin.age_ns, component, robot)


def from_program(packet: bytes) -> FromProgram:
    """Decode a message of a program.

    Raises:
        TaskPacketError: it is no such packet; says why.
    """
    kind, body = _opened(packet)
    if kind not in (_KINDS["Hello"], _KINDS["Keeps"]):
        raise TaskPacketError(f"a program sent a packet of kind {kind}, which is none that programs send")
    _check_size(body, 0, kind)
    return Hello() if kind == _KINDS["Hello"] else Keeps()


def from_guard(packet: bytes) -> FromGuard:
    """Decode a message of a guard.

    Raises:
        TaskPacketError: it is no such packet; says why.
    """
    kind, body = _opened(packet)
    reader = _GUARDS.get(kind)
    if reader is None:
        raise TaskPacketError(f"a guard sent a packet of kind {kind}, which is none that guards send")
    layout, made = reader
    _check_size(body, layout.size, kind)
    return made(*layout.unpack(body))


def _opened(packet: bytes) -> tuple[int, bytes]:
    """The kind of a packet, and what follows its head."""
    if len(packet) < _HEAD.size:
        raise TaskPacketError(f"a packet of {len(packet)} bytes, where {_HEAD.size} to {PACKET_SIZE_MAX} are possible")
    kind, version = _HEAD.unpack_from(packet)
    if version != VERSION:
        raise TaskPacketError(
            f"a packet of version {version}, where version {VERSION} is spoken; install the same release of failover for both"
        )
    return kind, packet[_HEAD.size :]


def _check_size(body: bytes, size: int, kind: int) -> None:
    if len(body) != size:
        raise TaskPacketError(f"a packet of kind {kind} has {_HEAD.size + size} bytes, this one {_HEAD.size + len(body)}")


def _begin(
    epoch: int, first: int, second: int, why: int, zero: int, generation: int, age_ns: int, component: bytes, robot: bytes
) -> Begin:
    if zero or why > len(REASONS):
        raise TaskPacketError(f"how to begin is said with reason {why} and {zero} where there are {len(REASONS)} reasons and 0")
    name, committed_at = _text(component), _text(robot)
    if not name:
        raise TaskPacketError("how to begin is said without the name of the component")
    if not why and (generation or age_ns or committed_at):
        raise TaskPacketError("how to begin is said with an origin and without a reason")
    origin = Origin(committed_at, generation, REASONS[why - 1], age_ns) if why else None
    return Begin(name, epoch, (first, second), origin)


def _refused(text: bytes) -> Refused:
    return Refused(_text(text))


def _text(field: bytes) -> str:
    """The text of a field: UTF-8, a zero byte, and zeros to the end."""
    text = field.rstrip(b"\0")
    if len(text) == len(field) or b"\0" in text:
        raise TaskPacketError(f"a field of {len(field)} bytes holds no text that ends with zeros")
    try:
        return text.decode()
    except UnicodeDecodeError as error:
        raise TaskPacketError(f"a field of {len(field)} bytes is not UTF-8: {error.reason} at byte {error.start}") from error


_GUARDS: Final[dict[int, tuple[struct.Struct, Callable[..., FromGuard]]]] = {
    _KINDS["Begin"]: (_BEGIN, _begin),
    _KINDS["Refused"]: (_REFUSED, _refused),
    _KINDS["Safe"]: (_SAFE, Safe),
    _KINDS["Kept"]: (_SAFE, Kept),
}
