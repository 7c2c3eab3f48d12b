"""What the worker asks the archive's process, and what that answers."""

from __future__ import annotations

from msgspec import Struct

from checkpoint.snapshot.required_files import Need
from failover.archive.archive import Copy, Label


class Look(Struct, frozen=True, tag=True):
    """Which of these contents does the archive lack, or hold harmed, or for other readers? ``digests``: blake3, 32 bytes each."""

    digests: tuple[bytes, ...]


class KeepContent(Struct, frozen=True, tag=True):
    """Archive a file that a program needs; with its descriptor."""

    digest: bytes


class KeepCheckpoint(Struct, frozen=True, tag=True):
    """Archive the state that a chain leads to, and remove older copies; with the descriptors of its files, a base first."""

    component: str


class ListCopies(Struct, frozen=True, tag=True):
    """Which copies has the archive?"""


class Fetch(Struct, frozen=True, tag=True):
    """Write a copy to an empty file, whose descriptor comes with this message."""

    copy: Copy


class FetchContent(Struct, frozen=True, tag=True):
    """The same with a file that a program needs."""

    need: Need


class Done(Struct, frozen=True, tag=True):
    """The answer to each of them.

    Attributes:
        refusal: why it could not be done; "" where it is.
        lacking: of the digests that were asked for.
        name, size: of the object.
        copies: the newest of each component first.
        label: of the copy.
    """

    refusal: str = ""
    lacking: tuple[bytes, ...] = ()
    name: str = ""
    size: int = 0
    copies: tuple[Copy, ...] = ()
    label: Label | None = None


Request = Look | KeepContent | KeepCheckpoint | ListCopies | Fetch | FetchContent


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
