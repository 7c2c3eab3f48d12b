"""What a person or a program may write for one thing: an address, a path, or free text.

======== ================================= ==========================================================================
kind     examples                          compared as
======== ================================= ==========================================================================
address  ``192.168.0.7:5555``, ``[::1]:5`` numeric address and port; ``tcp://`` before it says nothing more
path     ``University/Lab/Robotino/PWM``   its steps, each in NFKC; a first ``/`` and blanks around ``→`` do not count
text     ``engine``, ``left engine``       NFKC, blanks between words as one
======== ================================= ==========================================================================
"""

from __future__ import annotations

import enum
import ipaddress
import re
from typing import Final

from msgspec import Struct

from failover.core.wire.names import text_size
from failover.errors import NameFormatError

NAME_SIZE_MAX: Final = 200
"""Bytes of UTF-8 of a name of any kind; components' names have the same limit."""

NAME_DEPTH_MAX: Final = 16
"""Steps of a path: organisation, place, robot, and what is in it."""

PORT_MAX: Final = 65_535

_ADDRESS = re.compile(r"(?:tcp://)?(?:\[([0-9A-Fa-f:.]+)\]|([0-9]+(?:\.[0-9]+){3})):([0-9]{1,5})", re.ASCII)
_ARROW = re.compile(r"\s*→\s*")


class Kind(enum.StrEnum):
    """Which of the three."""

    ADDRESS = "address"
    PATH = "path"
    TEXT = "text"


class Name(Struct, frozen=True):
    """A name as it is compared. ``text``: in the normal form of its kind."""

    kind: Kind
    text: str


def parse(text: str) -> Name:
    """Which name was written.

    Raises:
        NameFormatError: it is none; says why.
    """
    if text_size(text) > NAME_SIZE_MAX:
        raise NameFormatError(f"{text[:40]!r}… cannot be a name: it is longer than {NAME_SIZE_MAX} bytes of UTF-8")
    if not text.strip() or not text.isprintable():
        raise NameFormatError(f"{text!r} cannot be a name: it is empty or holds characters that cannot be seen")
    if match := _ADDRESS.fullmatch(text.strip()):
        return Name(Kind.ADDRESS, _address(match, text))
    normal = _ARROW.sub("/", _normal(text).strip())
    if "/" in normal:
        return Name(Kind.PATH, _path(normal, text))
    return Name(Kind.TEXT, " ".join(normal.split()))


def path(text: str) -> str:
    """The normal form of what must be a path: its steps with ``/`` between them, none before.

    Raises:
        NameFormatError: it is no path.
    """
    name = parse(text)
    if name.kind is Kind.ADDRESS or any(character.isspace() for character in name.text):
        raise NameFormatError(f"{text!r} is no path: write steps with '/' between them, such as Lab/robot1/Engines/3/PWM")
    return name.text if name.kind is Kind.PATH else _path(name.text, text)


def alias(text: str) -> str:
    """The normal form of what must be free text.

    Raises:
        NameFormatError: it is an address or a path, or no name at all.
    """
    name = parse(text)
    if name.kind is not Kind.TEXT:
        raise NameFormatError(f"{text!r} cannot be an alias: it reads as {name.kind}; leave out '/', or the port")
    return name.text


def _address(match: re.Match[str], text: str) -> str:
    try:
        host = ipaddress.ip_address(match[1] or match[2])
    except ValueError as error:
        raise NameFormatError(f"{text!r} is no address: {error}") from error
    if not 0 < int(match[3]) <= PORT_MAX:
        raise NameFormatError(f"{text!r} is no address: a port is a number from 1 to {PORT_MAX}")
    return f"{host}:{int(match[3])}" if host.version == 4 else f"[{host}]:{int(match[3])}"


def _path(normal: str, text: str) -> str:
    steps = normal.removeprefix("/").split("/")
    if any(step.strip() in ("", ".", "..") for step in steps):
        raise NameFormatError(f"{text!r} cannot be a path: a step is empty, '.' or '..'")
    if len(steps) > NAME_DEPTH_MAX:
        raise NameFormatError(f"{text!r} cannot be a path: it has {len(steps)} steps, {NAME_DEPTH_MAX} are the most")
    if any(character.isspace() for character in normal):
        raise NameFormatError(f"{text!r} cannot be a path: a step holds a blank; write '_' or '-' instead")
    if text_size(normal) > NAME_SIZE_MAX:
        raise NameFormatError(f"{text!r} cannot be a path: its normal form is longer than {NAME_SIZE_MAX} bytes")
    return "/".join(steps)


def _normal(text: str) -> str:
    if text.isascii():
        return text
    import unicodedata  # half a megabyte, for names that need it

    return unicodedata.normalize("NFKC", text)
