"""What a bundle says about itself: ``manifest.json``, checked word by word.

{"name": "engine", "version": "1.4", "path": "Lab/robot1/Engines/3/PWM", "entry": "engine.py:Engine", "engine": "python",
 "author": "anna", "needs": ["numpy"], "permissions": {"network": false, "devices": ["/dev/ttyACM0"]},
 "health": {"seconds": 10, "messages": 3, "query": "read"}}
"""

from __future__ import annotations

import re
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.naming import names
from failover.core.programs import versions
from failover.core.programs.archive import FILES, check_path
from failover.errors import NameFormatError, ProgramError

MANIFEST: Final = "manifest.json"
MANIFEST_SIZE_MAX: Final = 64 << 10
"""Bytes; one is read before anything else of a bundle is."""

NEEDS_MAX: Final = 64
DEVICES_MAX: Final = 16
MEMORY_MAX_MB: Final = 1 << 20
SECONDS_MAX: Final = 86_400.0
MESSAGES_MAX: Final = 4_096
ANSWER_MAX_S: Final = 60.0

_NAME: Final = re.compile(r"[a-z][a-z0-9_-]{0,62}", re.ASCII)
_MODULE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*", re.ASCII)
_CLASS: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}", re.ASCII)
_DEVICE: Final = re.compile(r"/dev(/[A-Za-z0-9_.:+-]+)+", re.ASCII)


class Permissions(Struct, frozen=True, forbid_unknown_fields=True):
    """What a program may have beyond its own files.

    Attributes:
        network: whether it may open connections.
        devices: which device files it may open.
        memory_mb: how much memory it may have; 0: no limit.
    """

    network: bool = False
    devices: tuple[str, ...] = ()
    memory_mb: int = 0


class Health(Struct, frozen=True, forbid_unknown_fields=True):
    """When a new version has proved itself: after so long **and** so many messages, without a failure.

    Attributes:
        query: a verb that must answer at the end; "": none.
        answer_s: how long one message may take; a longer one is a failure.
    """

    seconds: float = 10.0
    messages: int = 0
    query: str = ""
    answer_s: float = 5.0


class Manifest(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole manifest.

    Attributes:
        name: of the program; its versions share it.
        path: in the tree of names, for which it speaks and for which its author needs the right.
        entry: ``FILE:CLASS``, a driver.
        needs: modules that must be there; a robot without one refuses the bundle.
        state: how often the form of the kept state changed; for people, the program's own declaration decides.
        on_rollback: with which state the old version goes on: ``replay``: its own at the switch, and the commands since then once
            more; ``newest``: that of the version that failed, if the old one can read it, else as ``replay``.
    """

    name: str
    version: str
    path: str
    entry: str
    engine: Literal["python"] = "python"
    author: str = ""
    needs: tuple[str, ...] = ()
    state: int = 1
    on_rollback: Literal["replay", "newest"] = "replay"
    permissions: Permissions = Permissions()
    health: Health = Health()

    @property
    def entry_file(self) -> str:
        """The file in which the driver is."""
        return self.entry.partition(":")[0]

    @property
    def entry_class(self) -> str:
        """The class that it is."""
        return self.entry.partition(":")[2]


def encode(manifest: Manifest) -> bytes:
    """The bytes of a manifest: the same for the same words."""
    return msgspec.json.encode(manifest, order="sorted") + b"\n"


def decode(content: bytes) -> Manifest:
    """A checked manifest.

    Raises:
        ProgramError: names the key that is wrong.
    """
    if len(content) > MANIFEST_SIZE_MAX:
        raise ProgramError(f"{MANIFEST} has {len(content)} bytes, {MANIFEST_SIZE_MAX} are the most")
    try:
        found = msgspec.json.decode(content, type=Manifest)
    except UNDECODABLE as error:
        raise ProgramError(f"{MANIFEST} is not as documented: {error}") from error
    check(found)
    return found


def check(manifest: Manifest) -> None:
    """Refuse what cannot work.

    Raises:
        ProgramError: names the key that is wrong.
    """
    check_name(manifest.name)
    versions.order(manifest.version)
    try:
        normal = names.path(manifest.path)
    except NameFormatError as error:
        raise ProgramError(f"path: {error}") from error
    if normal != manifest.path:
        raise ProgramError(f"path: {manifest.path!r} is not in its normal form; write {normal}")
    check_path(FILES + manifest.entry_file)
    if not manifest.entry_file.endswith(".py") or not _CLASS.fullmatch(manifest.entry_class):
        raise ProgramError(f"entry: {manifest.entry[:100]!r} is none; write FILE.py:CLASS, as engine.py:Engine")
    if not manifest.author.isprintable() or len(manifest.author) > 200:
        raise ProgramError("author: is longer than 200 characters, or holds some that cannot be seen")
    if len(manifest.needs) > NEEDS_MAX or not all(_MODULE.fullmatch(one) and len(one) < 200 for one in manifest.needs):
        raise ProgramError(f"needs: must be at most {NEEDS_MAX} names of modules, such as numpy")
    if not 1 <= manifest.state < 1 << 31:
        raise ProgramError(f"state: {manifest.state} is no number of a form; the first one is 1")
    _check_permissions(manifest.permissions)
    _check_health(manifest.health)


def check_name(name: str) -> None:
    """Raises ProgramError: it cannot name a program."""
    if not _NAME.fullmatch(name):
        raise ProgramError(f"name: {name[:40]!r} is none; write small letters, digits, - and _, as engine or arm-2")


def _check_permissions(said: Permissions) -> None:
    wrong = [one for one in said.devices if not _DEVICE.fullmatch(one) or {".", ".."} & set(one.split("/"))]
    if wrong or len(said.devices) > DEVICES_MAX:
        raise ProgramError(f"permissions.devices: must be at most {DEVICES_MAX} files below /dev; {wrong[:1]} is none")
    if not 0 <= said.memory_mb <= MEMORY_MAX_MB:
        raise ProgramError(f"permissions.memory_mb: {said.memory_mb} is not within 0 and {MEMORY_MAX_MB}")


def _check_health(said: Health) -> None:
    limits: tuple[tuple[str, Any, float], ...] = (
        ("seconds", said.seconds, SECONDS_MAX),
        ("messages", said.messages, MESSAGES_MAX),
        ("answer_s", said.answer_s, ANSWER_MAX_S),
    )
    for key, value, most in limits:
        if not 0 <= value <= most:  # neither is a number that is none
            raise ProgramError(f"health.{key}: {value} is not within 0 and {most:g}")
    if not said.answer_s:
        raise ProgramError("health.answer_s: 0 leaves no time for an answer")
    if said.query and not _CLASS.fullmatch(said.query):
        raise ProgramError(f"health.query: {said.query[:40]!r} is no verb")
