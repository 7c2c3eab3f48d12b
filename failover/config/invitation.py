"""An invitation: one line by which one robot joins a team, once, within minutes.

It holds an address, the robot's name and role, and a secret of 128 random bits. Both sides derive two pairs of CURVE keys from
secret, role and name: that of the inviting side, and that of the joining one. The handshake proves to each side that the other
one has the secret, and what follows is encrypted. So a listener learns nothing, and a machine without the secret can neither take
part nor put other keys in. The keys that the robot keeps are made anew; they are derived from nothing.

Source of the handshake: rfc.zeromq.org/spec/26 (CurveZMQ).
"""

from __future__ import annotations

import base64
import binascii
from hashlib import blake2b
from typing import Final, get_args

from msgspec import Struct

from failover.config.team import Role
from failover.core.wire import names
from failover.errors import InvitationError, NameFormatError

SECRET_SIZE: Final = 16
CHECK_SIZE: Final = 2
"""Bytes by which a line that was not copied whole is found out before anything is asked."""

KEY_SIZE: Final = 32

ROLES: Final[tuple[Role, ...]] = get_args(Role)

_PERSON_INVITING: Final = b"failover-invites"
_PERSON_JOINING: Final = b"failover-joins\x00\x00"


class Invitation(Struct, frozen=True):
    """What the line says.

    Attributes:
        robot, role: that may join, and as what; another name or role makes other keys of the same secret.
        host, port: where the inviting side listens.
    """

    robot: str
    host: str
    port: int
    secret: bytes
    role: Role = "robot"

    @property
    def line(self) -> str:
        """As a person copies it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.robot}@{host}:{self.port}/{self._text()}"

    def _text(self) -> str:
        content = self.secret + bytes([ROLES.index(self.role)])
        content += _check(self.robot, self.host, self.port, content)
        return base64.b32encode(content).decode().rstrip("=").lower()

    def inviting_secret(self) -> bytes:
        """The secret CURVE key of the side that invites, for this invitation alone."""
        return self._key(_PERSON_INVITING)

    def joining_secret(self) -> bytes:
        """The same of the side that joins."""
        return self._key(_PERSON_JOINING)

    def _key(self, person: bytes) -> bytes:
        return blake2b(f"{self.role} {self.robot}".encode(), digest_size=KEY_SIZE, key=self.secret, person=person).digest()


def read(line: str) -> Invitation:
    """The invitation of a line.

    Raises:
        InvitationError: it is none, or not as it was printed.
    """
    robot, at, rest = line.strip().rpartition("@")
    place, slash, text = rest.rpartition("/")
    host, colon, port = place.rpartition(":")
    try:
        if not (at and slash and colon and host):
            raise ValueError("its parts are not there")
        names.check_robot(robot)
        content = base64.b32decode(text.upper() + "=" * (-len(text) % 8))
        role = ROLES[content[SECRET_SIZE]]
        found = Invitation(robot, host.strip("[]"), int(port), content[:SECRET_SIZE], role)
        if not 0 < found.port < 1 << 16 or found.line != line.strip():
            raise ValueError("it is not as it was printed")
    except (ValueError, IndexError, binascii.Error, NameFormatError) as error:
        raise InvitationError(
            f"{line!r} is no invitation, or not all of it: copy the line that failover team invite printed, every character"
        ) from error
    return found


def _check(robot: str, host: str, port: int, content: bytes) -> bytes:
    return blake2b(f"{robot}@{host}:{port}".encode() + content, digest_size=CHECK_SIZE).digest()
