"""Objects in the keeping of a witness of the team: the third kind of place, beside S3 and a folder.

Here is the side of whoever puts and fetches. How requests travel is the caller's (`Witness`): a running agent has its replication
link, and ``failover-agent recover`` a connection of its own. The other side: `agent.worker.replication.sealed_copies`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any, BinaryIO, Final, Protocol

import msgspec
from msgspec import Struct

from checkpoint.store.content_store import digest_of_descriptor
from failover.archive import signature
from failover.archive.objects import FULL, OLDER, PutRefusedError, Readable, Stored
from failover.errors import ArchiveError

READ_MAX: Final = 192 << 10
"""Bytes of one answer: it travels as one message."""

HEAD: Final = 8 << 10
"""Bytes that are asked for first: who looks at an object's head needs no more."""

LISTED_MAX: Final = 500
"""Objects of one answer."""

WANTED: Final = "wanted"
KEPT: Final = "kept"
OTHER: Final = "other"
"""What a witness answers to a `Put`: its bytes are wanted; it keeps them; it keeps an object of that name that has others.

Or `failover.archive.objects.FULL` or ``OLDER``.
"""


class Size(Struct, frozen=True, tag_field="act", tag="size"):
    """How large is an object? Answer: ``size``."""

    name: str


class Listed(Struct, frozen=True, tag_field="act", tag="listed"):
    """Which objects are below a folder, from behind a name on? Answer: ``objects``, ``more``."""

    folder: str
    after: str = ""


class Read(Struct, frozen=True, tag_field="act", tag="read"):
    """Bytes of an object from one on, ``size`` of them or `READ_MAX` at most. Answer: ``content``."""

    name: str
    first: int
    size: int = READ_MAX


class Put(Struct, frozen=True, tag_field="act", tag="put"):
    """An object is to be kept: its bytes follow as a transfer of this digest. Answer: ``found``."""

    name: str
    size: int
    digest: bytes
    signature: bytes


class Remove(Struct, frozen=True, tag_field="act", tag="remove"):
    """An object is to be removed. Answer: nothing."""

    name: str
    signature: bytes


Request = Size | Listed | Read | Put | Remove


class Answer(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What a witness answers.

    Attributes:
        size: of the object; None: there is none. Where there is no room for a `Put`: how many bytes are too much.
        content: at most `READ_MAX` bytes; b"" at the object's end.
        found: of a `Put`; ``why``: the sentence, where it is not taken.
        objects: (name, size, seconds since 1970), in the order of names, at most `LISTED_MAX`; ``more``: there are more.
    """

    size: int | None = None
    content: bytes = b""
    found: str = ""
    why: str = ""
    objects: tuple[tuple[str, int, float], ...] = ()
    more: bool = False


class Witness(Protocol):
    """A way to the witness. Both methods raise ArchiveError: it does not answer, or it refuses; with its reason."""

    def ask(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Have it answer one request."""
        ...

    def ship(self, digest: bytes, size: int, descriptor: int) -> None:
        """Have it take the bytes of a file that it wants."""
        ...


class WitnessObjects:
    """The objects at one witness, as `failover.archive.objects.ObjectStore` says."""

    def __init__(self, witness: Witness, key: bytes) -> None:
        """
        Args:
            key: the archive key; what is put and removed is signed with what descends from it.
        """
        self._witness = witness
        self._key = key

    def put(self, name: str, content: BinaryIO) -> bool:
        """See `ObjectStore.put`."""
        size, digest = os.fstat(content.fileno()).st_size, digest_of_descriptor(content.fileno())
        request = Put(name, size, digest, signature.sign(self._key, signature.PUT, name, size, digest))
        answer = self._ask(request)
        if answer.found in (FULL, OLDER):
            raise PutRefusedError(answer.found, answer.why, answer.size or 0)
        if answer.found != WANTED:
            return False
        try:
            self._witness.ship(digest, size, content.fileno())
        except ArchiveError as error:
            raise ArchiveError(f"{name} did not come to the witness: {error}") from error
        return self._ask(request).found == KEPT

    def size(self, name: str) -> int | None:
        """See `ObjectStore.size`."""
        return self._ask(Size(name)).size

    def open(self, name: str, first: int = 0) -> Readable:
        """See `ObjectStore.open`."""
        return _Body(self, name, first, self._read(name, first, HEAD))

    def listed(self, folder: str) -> Iterator[Stored]:
        """See `ObjectStore.listed`."""
        after, is_more = "", True
        while is_more:
            answer = self._ask(Listed(folder, after))
            for name, size, at_s in answer.objects:
                if name <= after:
                    raise ArchiveError(f"the witness lists {name!r} behind {after!r}: it does not keep to the order of names")
                yield Stored(name, size, at_s)
                after = name
            is_more = answer.more and bool(answer.objects)

    def remove(self, name: str) -> None:
        """See `ObjectStore.remove`."""
        self._ask(Remove(name, signature.sign(self._key, signature.REMOVE, name)))

    def _read(self, name: str, first: int, size: int = READ_MAX) -> bytes:
        return self._ask(Read(name, first, size)).content

    def _ask(self, request: Request) -> Answer:
        answer = self._witness.ask(msgspec.to_builtins(request, builtin_types=(bytes,)))
        try:
            return msgspec.convert(answer, Answer, builtin_types=(bytes,))
        except msgspec.ValidationError as error:
            raise ArchiveError(
                f"this robot does not understand the answer of the witness: {error}; same release there?"
            ) from error


class _Body:
    """An object's content, part by part."""

    def __init__(self, objects: WitnessObjects, name: str, first: int, rest: bytes) -> None:
        self._objects, self._name, self._next, self._rest = objects, name, first + len(rest), memoryview(rest)

    def read(self, size: int, /) -> bytes:
        """See `failover.archive.objects.Readable`."""
        if not self._rest:
            self._rest = memoryview(self._objects._read(self._name, self._next))
            self._next += len(self._rest)
        taken, self._rest = self._rest[:size], self._rest[size:]
        return bytes(taken)

    def close(self) -> None:
        """Ask for no more."""
        self._rest = memoryview(b"")
