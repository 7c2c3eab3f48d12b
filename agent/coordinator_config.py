"""The table ``[coordinator]`` of agent.toml: where etcd is, under ``rule = "etcd"``."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import urlsplit

ENDPOINTS_MAX: Final = 16

EXAMPLE: Final = 'endpoints = ["https://10.0.0.5:2379"]'


@dataclass(frozen=True, slots=True)
class CoordinatorConfig:
    """How this robot reaches etcd. See `agent.coordinator.etcd`.

    Attributes:
        endpoints: of the members of one etcd cluster; the first that answers is asked until it does not.
        ca: file with the certificates that etcd's is checked by; "": those that this system trusts.
        certificate, key: files that prove who this robot is; "": none.
        user, password_file: of etcd's own accounts; "": none.
    """

    endpoints: list[str] = field(default_factory=list)
    ca: str = ""
    certificate: str = ""
    key: str = ""
    user: str = ""
    password_file: str = ""

    def __post_init__(self) -> None:
        """Refuse what reaches no etcd.

        Raises:
            ValueError: says which key, and what to write instead.
        """
        if len(self.endpoints) > ENDPOINTS_MAX:
            raise ValueError(f"endpoints names {len(self.endpoints)}; at most {ENDPOINTS_MAX}")
        for endpoint in self.endpoints:
            if not _is_sound(endpoint):
                raise ValueError(f"endpoints: {endpoint!r} is no address of etcd; write {EXAMPLE}")
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together: name both files, or neither")
        if bool(self.user) != bool(self.password_file):
            raise ValueError("user and password_file belong together: name both, or neither")
        if self.user and (plain := [one for one in self.endpoints if not _is_private(one)]):
            raise ValueError(f"the password of user would travel to {plain[0]} in the clear; write https")


def _is_private(endpoint: str) -> bool:
    """Whether nobody between reads what is said to it."""
    parts = urlsplit(endpoint)
    if parts.scheme == "https" or parts.hostname == "localhost":
        return True
    try:
        return ipaddress.ip_address(str(parts.hostname)).is_loopback
    except ValueError:
        return False


def _is_sound(endpoint: str) -> bool:
    try:
        parts = urlsplit(endpoint)
        sound = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port is not None
    except ValueError:
        return False
    return sound and parts.path in ("", "/") and not (parts.query or parts.fragment or parts.username)
