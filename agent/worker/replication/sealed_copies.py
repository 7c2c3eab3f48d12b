"""A witness's side of sealed copies: it keeps, proves and gives back objects that it cannot open.

What it holds of the archive key is the public half of its signatures (`failover.archive.signature`). By it the witness proves
that a holder of the archive key wants an object kept under this name, with this size and digest, or removed. It replaces no
object, and takes of a component no copy that is older than the newest one here.

A put is asked for first, as an order; one without a proof sends no byte. The bytes come as a transfer under credit, as the files
of programs do (`agent.worker.replication.transfer`): they give way to snapshots. Only a transfer under way takes room: who asks
and sends nothing keeps nobody out. Nothing here knows what a snapshot is.

The disk is right: an object that somebody removed or changed there is looked at again before its next use.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
from msgspec import Struct

from agent.errors import RefusedError
from agent.system.threads import to_its_end
from agent.worker.replication.transfer import Refusal
from checkpoint.errors import StoreError
from checkpoint.store.atomic_files import TEMPORARY_PREFIX
from failover.archive import signature
from failover.archive.objects import FULL, OLDER, FolderObjects, require_room
from failover.archive.witness import (
    KEPT,
    LISTED_MAX,
    OTHER,
    READ_MAX,
    WANTED,
    Answer,
    Listed,
    Put,
    Read,
    Remove,
    Request,
    Size,
)
from failover.core.wire.messages import SNAPSHOT_SIZE_MAX, Content
from failover.errors import ArchiveError

FOLDER: Final = "sealed"
"""Below the state directory."""

NAME: Final = re.compile(r"(?:[\w.~%@-]{1,250}/){0,4}[\w.~%@-]{1,250}", re.ASCII)
"""Of an object, as `failover.archive.archive` makes it."""

COPIES: Final = re.compile(r"(?P<folder>.+/@[^/]+)/[^/]+")
"""The name of a checkpoint's object: the folder of its component, then what sorts by age."""

AWAITED_MAX: Final = 64
"""Objects of one peer that were asked for last, and whose bytes may come."""

UNSIGNED: Final = "its signature is not of this team's archive key for this name and content"

log = logging.getLogger("failover.sealed")


def is_name(name: str) -> bool:
    """Whether an object may be called so."""
    return NAME.fullmatch(name) is not None and all(word.strip(".") for word in name.split("/"))


def _folder(name: str) -> str:
    """What the names of all copies of a component begin with; "" where a name is of no checkpoint."""
    return found["folder"] + "/" if (found := COPIES.fullmatch(name)) is not None else ""


def _is_older(name: str, peer: str, newer: str) -> str:
    return f"refused the sealed copy {name} of {peer}: it is older than the newest copy here, {newer}"


@contextlib.contextmanager
def _as_store_error() -> Iterator[None]:
    """Raise StoreError, which a sender is told, in place of ArchiveError."""
    try:
        yield
    except ArchiveError as error:
        raise StoreError(str(error)) from error


class _Kept(Struct, frozen=True):
    """One object. ``digest``: of its bytes, where it came in this life of the worker."""

    size: int
    at_s: float
    digest: bytes = b""


class SealedCopies:
    """The objects that one witness keeps; the desk (`agent.worker.replication.transfer.Desk`) for those that come in.

    Attributes:
        arriving: bytes of all transfers under way, `agent.worker.replication.transfer.Receiver.arriving`.
    """

    def __init__(self, directory: Path, size_max: int, robot: str, public: Callable[[], bytes]) -> None:
        """
        Args:
            directory: of the objects.
            size_max: bytes of all of them.
            robot: own name, for the sentences.
            public: reads the public half; raises ArchiveError.
        """
        self.directory = directory
        self._size_max = size_max
        self._robot = robot
        self._public = public
        self._objects = FolderObjects(directory)
        self._kept: dict[str, _Kept] = {}
        self._awaited: dict[str, dict[bytes, Put]] = {}
        self.arriving: Callable[[], int] = lambda: 0
        self._turn = asyncio.Lock()

    def load(self) -> None:
        """Find what is kept. Raises ArchiveError, OSError."""
        self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        for left_over in self.directory.rglob(f"{TEMPORARY_PREFIX}*"):
            if left_over.is_file():
                left_over.unlink()
        self._kept = {one.name: _Kept(one.size, one.at_s) for one in self._objects.listed("")}

    def of_component(self, folder: str) -> tuple[int, int, float] | None:
        """How many copies of a component there are, their bytes, and the age of the newest in s; None: none.

        Args:
            folder: its name as part of an object's, `checkpoint.store.index.folder_name`.
        """
        found = sorted((name, kept) for name, kept in self._kept.items() if f"/{folder}/" in name)
        if not found:
            return None
        return len(found), sum(kept.size for _, kept in found), max(time.time() - found[-1][1].at_s, 0.0)

    # Requests

    async def answer(self, peer: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Answer one request of a peer.

        Raises:
            RefusedError: it is none, or is refused; says why.
            ArchiveError: the disk, or the public key, cannot be read.
        """
        try:
            request = msgspec.convert(arguments, Request, builtin_types=(bytes,))
        except msgspec.ValidationError as error:
            raise RefusedError(f"the request about a sealed copy was not understood: {error}; same release there?") from error
        built: dict[str, Any] = msgspec.to_builtins(await self._answered(peer, request), builtin_types=(bytes,))
        return built

    async def _answered(self, peer: str, request: Request) -> Answer:
        match request:
            case Size(name):
                await self._look_again((name,))
                kept = self._kept.get(name)
                return Answer(size=kept.size if kept is not None else None)
            case Listed(folder, after):
                await self._look_again(self._behind(folder, after)[:LISTED_MAX])
                names = self._behind(folder, after)
                told = tuple((name, self._kept[name].size, self._kept[name].at_s) for name in names[:LISTED_MAX])
                return Answer(objects=told, more=len(names) > LISTED_MAX)
            case Read(name, first, size):
                await self._look_again((name,))
                self._require_part(name, first, size)
                return Answer(content=await asyncio.to_thread(self._read, name, first, min(size, READ_MAX)))
            case Put():
                self._prove(peer, request, await asyncio.to_thread(self._public))
                await self._look_again((request.name,))
                if self._lacks(request.size) > 0:
                    await self._look_again(tuple(self._kept))
                return self._asked_to_put(peer, request)
            case Remove(name):
                await self._remove(peer, name, request.signature)
                return Answer()

    async def _look_again(self, names: Iterable[str]) -> None:
        """Take in what became of these objects on the disk, which is not ours alone."""
        before = {name: self._kept[name] for name in names if name in self._kept}
        sizes = await to_its_end(lambda: {name: self._objects.size(name) for name in before})
        for name, size in sizes.items():
            if self._kept.get(name) is before[name] and size != before[name].size:
                log.warning("the sealed copy %s is not as it was stored: somebody changed the disk of this witness", name)
                if size is None:
                    del self._kept[name]
                else:
                    self._kept[name] = _Kept(size, before[name].at_s)

    def _behind(self, folder: str, after: str) -> list[str]:
        return sorted(name for name in self._kept if name.startswith(f"{folder}/") and name > after)

    def _require_part(self, name: str, first: int, size: int) -> None:
        """Raises RefusedError: there is no such part of an object."""
        kept = self._kept.get(name)
        if kept is None:
            raise RefusedError(f"{self._robot} keeps no sealed copy {name[:250]!r}")
        if not 0 <= first <= kept.size or size < 1:
            raise RefusedError(f"{name} has {kept.size} bytes: there are no {size} from byte {first} on")

    def _read(self, name: str, first: int, size: int) -> bytes:
        with self._objects.open(name, first) as file:
            return file.read(size)

    def _prove(self, peer: str, put: Put, public: bytes) -> None:
        """Raises RefusedError: a holder of the archive key has not signed this."""
        if not is_name(put.name) or not 1 <= put.size <= SNAPSHOT_SIZE_MAX:
            raise RefusedError(f"{put.name[:250]!r} of {put.size} bytes is no sealed copy")
        if not signature.is_signed(public, put.signature, signature.PUT, put.name, put.size, put.digest):
            self._warn(f"{put.name} of {peer}")

    def _asked_to_put(self, peer: str, put: Put) -> Answer:
        """Whether a proved object is kept, or its bytes are awaited from now on. Raises RefusedError: there is no room."""
        if (kept := self._kept.get(put.name)) is not None:
            return Answer(found=KEPT if kept.digest == put.digest else OTHER)
        if newer := self._newer_than(put.name):
            return Answer(found=OLDER, why=_is_older(put.name, peer, newer))
        if (lacks := self._lacks(put.size)) > 0:
            older = sorted(name for name in self._kept if name.startswith(_folder(put.name) or "\0"))[:-1]
            if lacks <= sum(self._kept[name].size for name in older):
                return Answer(found=FULL, why=self._no_room(put), size=lacks)
            raise RefusedError(self._no_room(put))
        awaited = self._awaited.setdefault(peer, {})
        while len(awaited) >= AWAITED_MAX:
            del awaited[next(iter(awaited))]
        awaited[put.digest] = put
        return Answer(found=WANTED)

    def _lacks(self, size: int) -> int:
        """By how many bytes an object would be too much."""
        return self._held() + self.arriving() + size - self._size_max

    def _held(self) -> int:
        return sum(one.size for one in self._kept.values())

    def _no_room(self, put: Put) -> str:
        return (
            f"no room for {put.name} of {put.size} bytes: {self._robot} keeps {self._held()} bytes of sealed copies, "
            f"{self.arriving()} are on their way, and its sealed_size is {self._size_max}; raise it, lower s3_keep at the "
            f"robots, or remove copies of components that ended from {self.directory}"
        )

    def _newer_than(self, name: str) -> str:
        """The newest copy of a component, where a name is of an older one; "" otherwise."""
        if not (folder := _folder(name)):
            return ""
        newest = max((one for one in self._kept if one.startswith(folder)), default="")
        return newest if newest > name else ""

    def _warn(self, what: str) -> None:
        """Refuse, and let the log tell: a member has tried something that no member does."""
        log.warning("refused the sealed copy %s: %s", what, UNSIGNED)
        raise RefusedError(f"refused the sealed copy {what}: {UNSIGNED}")

    async def _remove(self, peer: str, name: str, signed: bytes) -> None:
        if not is_name(name):
            raise RefusedError(f"{name[:250]!r} is the name of no sealed copy")
        if not signature.is_signed(await asyncio.to_thread(self._public), signed, signature.REMOVE, name):
            self._warn(f"{name} of {peer}, to be removed")
        async with self._turn:
            if name in self._kept:
                await to_its_end(self._objects.remove, name)
                del self._kept[name]

    # As a desk (`agent.worker.replication.transfer.Desk`)

    def admits(self, peer: str, offer: Content) -> None:
        """Take the bytes of objects that were proved, and no others."""
        put = self._awaited.get(peer, {}).get(offer.digest)
        if put is None or put.size != offer.size:
            raise Refusal(f"{self._robot} has not asked for that sealed copy")
        if self._lacks(put.size) > 0:
            raise Refusal(self._no_room(put))

    def make_room(self, size: int) -> None:
        """See that the disk has it, and what else is on its way; nothing is removed for it."""
        with _as_store_error():
            require_room(self.directory, self.arriving())  # with this one; its file is given a name, and not copied

    async def take(self, peer: str, offer: Content, descriptor: int) -> None:
        """Keep it under its name; the digest, and with it the signature, is right. The first one of a name stays.

        Raises:
            StoreError: the disk does not take it, or a newer copy has come meanwhile.
        """
        put = self._awaited.get(peer, {}).pop(offer.digest, None)
        if put is None:
            raise StoreError(f"{self._robot} has not asked for that sealed copy")
        async with self._turn:
            if newer := self._newer_than(put.name):
                raise StoreError(_is_older(put.name, peer, newer))
            found: list[_Kept] = []
            try:
                with open(descriptor, "rb", buffering=0, closefd=False) as content:
                    await to_its_end(self._put, put, content, found)
            finally:  # also where the transfer was dropped meanwhile: the disk has it
                for one in found:
                    if one.digest or put.name not in self._kept:
                        self._kept[put.name] = one
        log.debug("keeps %s of %s, %d bytes", put.name, peer, put.size)

    def _put(self, put: Put, content: BinaryIO, found: list[_Kept]) -> None:
        """Store an object; what is there now comes into ``found``."""
        with _as_store_error():
            if self._objects.put(put.name, content):
                found.append(_Kept(put.size, time.time(), put.digest))
            elif (size := self._objects.size(put.name)) is not None:
                found.append(_Kept(size, time.time()))

    def not_taken(self, peer: str, offer: Content, why: str) -> None:
        """Its sender has been told."""

    def lost(self, peer: str) -> None:
        """The link to a peer is new: what was on its way is not any more."""
        self._awaited.pop(peer, None)
