"""``page.toml``: where the operators' page listens, and who may log in from another machine."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ipaddress
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from failover.config import strict_toml
from failover.config.rights import is_loopback
from failover.errors import PageError

PAGE_FILE: Final = Path("/etc/failover/page.toml")

PORT_MAX: Final = (1 << 16) - 1

SCRYPT_N: Final = 1 << 14
SCRYPT_R: Final = 8
SCRYPT_P: Final = 1
SALT_SIZE: Final = 16
"""A guess takes 16 MB and some hundredths of a second. Source: RFC 7914; hashlib."""

_PASSWORD: Final = re.compile(r"scrypt:(\d{1,7}):(\d{1,2}):(\d{1,2}):([A-Za-z0-9+/=]{16,64}):([A-Za-z0-9+/=]{16,128})", re.ASCII)
_NAME: Final = re.compile(r"[^\s/\x00-\x1f]{1,64}")


@dataclass(frozen=True, slots=True)
class UserConfig:
    """A person who may log in; ``[users.anna]``.

    Attributes:
        password: what ``failover page --password`` prints.
        account: this robot's account by whose rights the person acts; "": that of the page's own process.
    """

    password: str = ""
    account: str = ""

    def __post_init__(self) -> None:
        """Refuse what cannot be. Raises ValueError."""
        if not _PASSWORD.fullmatch(self.password):
            raise ValueError("password is not what failover page --password prints")


@dataclass(frozen=True, slots=True)
class PageConfig:
    """The whole file.

    Attributes:
        listen: address and port. On another address than the loopback only with a certificate and users.
        certificate, key: PEM files for TLS; "" for none. The certificate's file holds the chain, too.
        users: who may log in. Without any, the kernel tells whose program on this robot has connected.
    """

    listen: str = "127.0.0.1:7480"
    certificate: str = ""
    key: str = ""
    users: dict[str, UserConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what cannot be. Raises ValueError."""
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together; name both PEM files, or neither")
        for name in self.users:
            if not _NAME.fullmatch(name):
                raise ValueError(f"users: {name!r} is no name: write 1 to 64 visible characters without /")

    def at(self, listen: str) -> PageConfig:
        """The same at another address."""
        return replace(self, listen=listen)

    @property
    def address(self) -> tuple[str, int]:
        """Where to listen; port 0: at any. Raises PageError: it is no address."""
        host, _, port = self.listen.rpartition(":")
        try:
            is_bracketed = host[:1] == "[" and host[-1:] == "]"
            found = ipaddress.ip_address(host[1:-1] if is_bracketed else host)
            if is_bracketed != (found.version == 6) or not port.isascii() or not port.isdigit() or int(port) > PORT_MAX:
                raise ValueError(port)
        except ValueError as error:
            raise PageError(f"{self.listen!r} is no address with a port, as 127.0.0.1:7480 and [::1]:7480 are") from error
        return str(found), int(port)

    def check(self) -> None:
        """Refuse to listen where people could read along, or act without saying who they are.

        Raises:
            PageError: names what is missing.
        """
        host, _ = self.address
        if is_loopback(host):
            return
        lacks = [
            what for what, there in (("TLS (certificate, key)", self.certificate), ("a login ([users])", self.users)) if not there
        ]
        if lacks:
            raise PageError(
                f"cannot listen at {self.listen}: another address than the loopback needs {' and '.join(lacks)} in page.toml; "
                "or listen at 127.0.0.1, and go there by ssh -L 7480:127.0.0.1:7480 ROBOT"
            )


def read(path: Path | None) -> PageConfig:
    """The file; None: the usual one if it is there, else the defaults.

    Raises:
        FileMistakeError: it is missing or mistaken; names file, line and key.
    """
    if path is None and not PAGE_FILE.exists():
        return PageConfig()
    return strict_toml.read(path or PAGE_FILE, PageConfig)


def hashed(password: str) -> str:
    """A password as page.toml holds it: with a salt of its own."""
    salt = os.urandom(SALT_SIZE)
    made = hashlib.scrypt(password.encode(), salt=salt, n=SCRYPT_N, r=SCRYPT_R, p=SCRYPT_P)
    return f"scrypt:{SCRYPT_N}:{SCRYPT_R}:{SCRYPT_P}:{base64.b64encode(salt).decode()}:{base64.b64encode(made).decode()}"


def is_password(password: str, kept: str) -> bool:
    """Whether a password is the one of a line that `hashed` made; False for a line that cannot be read."""
    found = _PASSWORD.fullmatch(kept)
    if found is None:
        return False
    n, r, p = (int(number) for number in found.groups()[:3])
    try:
        salt, wanted = (base64.b64decode(text, validate=True) for text in found.groups()[3:])
        made = hashlib.scrypt(password.encode(), salt=salt, n=n, r=r, p=p, dklen=len(wanted), maxmem=256 << 20)
    except (binascii.Error, ValueError, UnicodeEncodeError):
        return False
    return hmac.compare_digest(made, wanted)
