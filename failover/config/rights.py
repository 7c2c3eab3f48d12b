"""``rights.toml`` of the team directory: the rules of rights, and where groups come from.

A file of its own beside team.toml: an agent reads it again when it has changed, so that a right is taken away without a restart.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from failover.config import strict_toml
from failover.core.rights import hours
from failover.core.rights.rules import RULES_MAX, Rule, make_rule
from failover.errors import FailoverError, FileMistakeError, RightsError

RIGHTS_FILE: Final = "rights.toml"
UNREADABLE: Final = (0, 0, 0)
"""In place of when, where and how large the file is."""

_ATTRIBUTE: Final = re.compile(r"[A-Za-z][A-Za-z0-9-]*")


@dataclass(frozen=True, slots=True)
class RuleConfig:
    """One rule, ``[[rights.rules]]``; see `failover.core.rights.rules`."""

    groups: tuple[str, ...] = ()
    verbs: tuple[str, ...] = ()
    paths: tuple[str, ...] = ()
    deny: bool = False
    hours: str = ""


@dataclass(frozen=True, slots=True)
class LdapConfig:
    """``[rights.ldap]``: the organisation's directory.

    Attributes:
        server: ``ldaps://host`` or ``ldap://host``; the latter begins with StartTLS unless ``tls = "none"``.
        base: the DN below which people and groups are.
        attribute: of a person's entry, that holds the name which the person types.
        account, password_file: a service account that may search; "": anonymous.
        ca_file: certificates that the server's must descend from; "": the system's.
        tls: "none" is refused for a server that is not this machine.
        timeout_s: of one request.
        refresh_s: how long an answer is good before the server is asked again.
        cache_h: how long the last good answer is used while the server is away; 0: never.
        offline_program: also for program and grant.
        user: the process that talks to the server runs as this user, where the agent is root.
    """

    server: str = ""
    base: str = ""
    attribute: str = "uid"
    account: str = ""
    password_file: str = ""
    ca_file: str = ""
    tls: Literal["require", "none"] = "require"
    timeout_s: float = 1
    refresh_s: int = 300
    cache_h: int = 72
    offline_program: bool = False
    user: str = "nobody"

    def __post_init__(self) -> None:
        """Refuse what cannot work, or would send a password in the clear. Raises ValueError."""
        if not self.server:
            return
        from urllib.parse import urlsplit  # here and below: a robot without a directory does not load them

        parts = urlsplit(self.server)
        if parts.scheme not in ("ldap", "ldaps") or not parts.hostname:
            raise ValueError(f"server = {self.server!r} is no address; write ldaps://HOST or ldap://HOST:PORT")
        if self.tls == "none" and parts.scheme == "ldap" and not is_loopback(parts.hostname):
            raise ValueError(f'tls = "none" would send passwords in the clear to {parts.hostname}; leave it "require"')
        if not self.base:
            raise ValueError('base is empty; write the DN below which people and groups are, as "dc=example,dc=org"')
        if not _ATTRIBUTE.fullmatch(self.attribute):
            raise ValueError(f"attribute = {self.attribute!r} is no name of an attribute, such as uid or sAMAccountName")
        for key, least, most in (("timeout_s", 0.05, 60), ("refresh_s", 1, 86_400), ("cache_h", 0, 8_760)):
            if not least <= getattr(self, key) <= most:
                raise ValueError(f"{key} = {getattr(self, key)} is not within {least:g} and {most:g}")


@dataclass(frozen=True, slots=True)
class RightsConfig:
    """The table ``[rights]``.

    Attributes:
        source: file: the groups of this machine, and ``groups``; ldap: those of a directory server.
        groups: group → its users, for ``source = "file"``.
    """

    source: Literal["file", "ldap"] = "file"
    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rules: tuple[RuleConfig, ...] = ()
    ldap: LdapConfig = field(default_factory=LdapConfig)


@dataclass(frozen=True, slots=True)
class _Tables:
    """The whole file."""

    rights: RightsConfig = field(default_factory=RightsConfig)


@dataclass(frozen=True, slots=True)
class Rights:
    """What was read: the table, and its rules with the lines where they stand."""

    config: RightsConfig
    rules: tuple[Rule, ...]


def read(directory: Path) -> Rights | None:
    """The team's rules; None where there is no file.

    Raises:
        FileMistakeError: it is mistaken; names file, line and key.
    """
    path = directory / RIGHTS_FILE
    if not path.exists():
        return None
    config = strict_toml.read(path, _Tables).rights
    if len(config.rules) > RULES_MAX:
        raise FileMistakeError(f"{strict_toml.place_of(path, ('rights', 'rules', str(RULES_MAX)))}: at most {RULES_MAX} rules")
    if config.source == "ldap" and not config.ldap.server:
        raise FileMistakeError(
            f'{strict_toml.place_of(path, ("rights", "source"))}: "ldap" needs server and base in [rights.ldap]'
        )
    if config.source == "ldap" and config.groups:
        raise FileMistakeError(
            f'{strict_toml.place_of(path, ("rights", "groups"))}: with source = "ldap" the server tells groups'
        )
    return Rights(config, tuple(_rule(path, number, said) for number, said in enumerate(config.rules)))


class RightsFile:
    """A team directory's ``rights.toml``, read again when it has changed.

    Attributes:
        path: of the file.
        exists: whether it was there at the last look, mistaken or not.
        rights: what it says; None where it is not there, or mistaken.
        mistake: why it cannot be read; "" where it can, or is not there.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / RIGHTS_FILE
        self.exists = False
        self.rights: Rights | None = None
        self.mistake = ""
        self._read_at: tuple[int, int, int] | None = None

    def look(self) -> bool:
        """Read it if it is another one than the last that was read; whether anything is different now."""
        try:
            found = os.stat(self.path)
            at: tuple[int, int, int] | None = (found.st_mtime_ns, found.st_ino, found.st_size)
        except FileNotFoundError:
            at = None
        except OSError as error:
            before = self.mistake
            self._read_at, self.exists, self.rights = UNREADABLE, True, None
            self.mistake = f"{self.path}: cannot be read: {error.strerror}"
            return self.mistake != before
        if at == self._read_at:
            return False
        before, was_unread = self.mistake, self._read_at == UNREADABLE
        self._read_at, self.exists, self.rights, self.mistake = at, at is not None, None, ""
        try:
            self.rights = read(self.path.parent)
        except (FailoverError, OSError) as error:
            self.mistake = str(error)
            if isinstance(error, OSError) or isinstance(error.__cause__, OSError):
                self._read_at = UNREADABLE  # the system could not, and may at the next look
                return not was_unread or self.mistake != before
        return True


def _rule(path: Path, number: int, said: RuleConfig) -> Rule:
    at = ("rights", "rules", str(number))
    try:
        span = hours.parse(said.hours) if said.hours else None
    except RightsError as error:
        raise FileMistakeError(f"{strict_toml.place_of(path, (*at, 'hours'))}: {error}") from error
    place = strict_toml.place_of(path, at).rpartition(": ")[0]
    try:
        return make_rule(said.groups, said.verbs, said.paths, deny=said.deny, hours=span, place=place)
    except RightsError as error:
        raise FileMistakeError(f"{strict_toml.place_of(path, (*at, error.key) if error.key else at)}: {error}") from error


def is_loopback(host: str) -> bool:
    """Whether what is said to this host stays on this machine."""
    import ipaddress

    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
