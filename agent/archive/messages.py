"""What the worker asks the archive's process, and what that answers."""

from __future__ import annotations

from msgspec import Struct


class Look(Struct, frozen=True, tag=True):
    """Which of these contents does the archive lack, or hold harmed? ``digests``: blake3, 32 bytes each."""

    digests: tuple[bytes, ...]


class KeepContent(Struct, frozen=True, tag=True):
    """Archive a file that a program needs; with its descriptor."""

    digest: bytes


class KeepCheckpoint(Struct, frozen=True, tag=True):
    """Archive the state that a chain leads to, and remove older copies; with the descriptors of its files, a base first."""

    component: str


class Done(Struct, frozen=True, tag=True):
    """The answer to each of them.

    Attributes:
        refusal: why it could not be done; "" where it is.
        lacking: of the digests that were asked for.
        name, size: of the object.
    """

    refusal: str = ""
    lacking: tuple[bytes, ...] = ()
    name: str = ""
    size: int = 0


Request = Look | KeepContent | KeepCheckpoint


class Carry(Struct, frozen=True, tag=True):
    """Instead of an answer, before it: have the witness do this (`failover.archive.witness`). Answered by `Carried`.

    Attributes:
        arguments: of a request to it, in msgpack; b"": take these bytes, whose file comes with this message.
        digest, size: of that file.
    """

    arguments: bytes = b""
    digest: bytes = b""
    size: int = 0


class Carried(Struct, frozen=True, tag=True):
    """What came of a `Carry`.

    Attributes:
        refusal: why it was not done; "" where it was.
        answer: of the witness, in msgpack.
    """

    refusal: str = ""
    answer: bytes = b""
