"""``programs.toml`` of the team directory: whose signature on a program counts."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Final

from failover.config import strict_toml
from failover.errors import FileMistakeError

PROGRAMS_FILE: Final = "programs.toml"
KEYS_MAX: Final = 1_000

_PUBLIC: Final = re.compile(r"[0-9a-f]{64}", re.ASCII)


@dataclass(frozen=True, slots=True)
class KeyConfig:
    """One key, ``[[keys]]``.

    Attributes:
        owner: the user whose it is, as rights.toml and the accounts name that user.
        public: 64 hexadecimal digits, as ``failover program key`` prints them.
        until: the last day on which it counts; "": for ever.
    """

    owner: str = ""
    public: str = ""
    until: str = ""

    def __post_init__(self) -> None:
        """Refuse what cannot be. Raises ValueError."""
        if not self.owner or not self.owner.isprintable():
            raise ValueError(f"owner = {self.owner!r} is no user")
        if not _PUBLIC.fullmatch(self.public):
            raise ValueError(f"public = {self.public!r} is no key; failover program key prints one, 64 of the digits 0-9 a-f")
        if self.until:
            self.last_day()

    def last_day(self) -> date:
        """The last day on which it counts. Raises ValueError: it is no day."""
        try:
            return date.fromisoformat(self.until) if self.until else date.max
        except ValueError:
            raise ValueError(f'until = {self.until!r} is no day; write "2027-12-31"') from None


@dataclass(frozen=True, slots=True)
class ProgramsFile:
    """The whole file."""

    keys: tuple[KeyConfig, ...] = ()


def read(directory: Path) -> dict[str, KeyConfig]:
    """Public key → whose it is; empty where there is no file.

    Raises:
        FileMistakeError: it is mistaken; names file, line and key.
    """
    path = directory / PROGRAMS_FILE
    if not path.exists():
        return {}
    found = strict_toml.read(path, ProgramsFile).keys
    if len(found) > KEYS_MAX:
        raise FileMistakeError(f"{path}: {len(found)} keys are more than {KEYS_MAX}")
    keys = {one.public: one for one in found}
    if len(keys) < len(found):
        raise FileMistakeError(f"{path}: one public key is there twice; each has one owner")
    return keys
