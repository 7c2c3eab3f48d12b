"""A witness's side of sealed copies: it keeps, proves and gives back objects that it cannot open.

What it holds of the archive key is the public half of its signatures (`failover.archive.signature`). By it the witness proves
that a holder of the archive key wants an object kept under this name, with this size and digest, or removed. It takes a name
once, and of a component no copy that is older than the newest one here.

A put is asked for first, as an order; what is refused sends no byte. The bytes come as a transfer under credit, as the files of
programs do (`agent.worker.replication.transfer`): they give way to snapshots. Nothing here knows what a snapshot is.
"""

from __future__ import annotations

import asyncio
import logging
import os
import re
import time
from collections.abc import Callable
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
from failover.archive.objects import FolderObjects
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
from failover.core.wire.messages import Content
from failover.errors import ArchiveError

FOLDER: Final = "sealed"
"""Below the state directory."""

NAME: Final = re.compile(r"(?:[\w.~%@-]{1,250}/){0,4}[\w.~%@-]{1,250}", re.ASCII)
"""Of an object, as `failover.archive.archive` makes it."""

COPIES: Final = re.compile(r"(?P<folder>.+/@[^/]+)/[^/]+")
"""The name of a checkpoint's object: the folder of its component, then what sorts by age."""

AWAITED_MAX: Final = 64
"""Objects of one peer whose bytes may be on their way."""

log = logging.getLogger("failover.sealed")


class _Kept(Struct, frozen=True):
    """One object. ``digest``: of its bytes, where it came in this life of the worker."""

    size: int
    at_s: float
    digest: bytes = b""


class SealedCopies:
    """The objects that one witness keeps; the desk (`agent.worker.replication.transfer.Desk`) for those that come in."""

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
        self._turn = asyncio.Lock()

    def load(self) -> None:
        """Find what is kept. Raises ArchiveError, OSError."""
        self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        for left_over in self.directory.rglob(f"{TEMPORARY_PREFIX}*"):
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
                kept = self._kept.get(name)
                return Answer(size=kept.size if kept is not None else None)
            case Listed(folder, after):
                names = sorted(name for name in self._kept if name.startswith(f"{folder}/") and name > after)
                told = tuple((name, self._kept[name].size, self._kept[name].at_s) for name in names[:LISTED_MAX])
                return Answer(objects=told, more=len(names) > LISTED_MAX)
            case Read(name, first):
                return Answer(content=await asyncio.to_thread(self._read, name, first))
            case Put():
                return Answer(found=self._asked_to_put(peer, request, await asyncio.to_thread(self._public)))
            case Remove(name):
                await self._remove(peer, name, request.signature)
                return Answer()

    def _read(self, name: str, first: int) -> bytes:
        if name not in self._kept or first < 0:
            raise RefusedError(f"{self._robot} keeps no sealed copy {name[:250]!r}")
        with self._objects.open(name, first) as file:
            return file.read(READ_MAX)

    def _asked_to_put(self, peer: str, put: Put, public: bytes) -> str:
        """Prove that an object may be kept; its bytes are awaited then. Raises RefusedError: it may not."""
        if not NAME.fullmatch(put.name) or any(not word.strip(".") for word in put.name.split("/")) or put.size < 1:
            raise RefusedError(f"{put.name[:250]!r} of {put.size} bytes is no sealed copy")
        if not signature.is_signed(public, put.signature, signature.PUT, put.name, put.size, put.digest):
            self._warn(f"{put.name} of {peer}", "its signature is not of this team's archive key for this name and content")
        if (kept := self._kept.get(put.name)) is not None:
            return KEPT if kept.digest == put.digest else OTHER
        if newer := self._newer_than(put.name):
            self._warn(f"{put.name} of {peer}", f"it is older than the newest copy here, {newer}")
        awaited = self._awaited.setdefault(peer, {})
        size = put.size + sum(one.size for waiting in self._awaited.values() for one in waiting.values() if one != put)
        held = sum(one.size for one in self._kept.values())
        if size + held > self._size_max:
            raise RefusedError(
                f"no room for {put.name} of {put.size} bytes: {self._robot} keeps {held} bytes of sealed copies, and its "
                f"sealed_size is {self._size_max}; raise it, or lower s3_keep at the robots"
            )
        while len(awaited) >= AWAITED_MAX:
            del awaited[next(iter(awaited))]
        awaited[put.digest] = put
        return WANTED

    def _newer_than(self, name: str) -> str:
        """The newest copy of a component, where a name is of an older one; "" otherwise."""
        is_copy = COPIES.fullmatch(name)
        if is_copy is None:
            return ""
        newest = max((one for one in self._kept if one.startswith(is_copy["folder"] + "/")), default="")
        return newest if newest > name else ""

    def _warn(self, what: str, why: str) -> None:
        """Refuse, and let the log tell: a member has tried something that no member does."""
        log.warning("refused the sealed copy %s: %s", what, why)
        raise RefusedError(f"refused the sealed copy {what}: {why}")

    async def _remove(self, peer: str, name: str, signed: bytes) -> None:
        public = await asyncio.to_thread(self._public)
        if not signature.is_signed(public, signed, signature.REMOVE, name):
            self._warn(f"{name[:250]} of {peer}, to be removed", "its signature is not of this team's archive key for this name")
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

    def make_room(self, size: int) -> None:
        """See that the disk has it; nothing is removed for it."""
        disk = os.statvfs(self.directory)
        if disk.f_bavail * disk.f_frsize < 2 * size:  # it arrives in a file without a name first
            raise StoreError(f"the disk of {self._robot} has no room for a sealed copy of {size} bytes; free some space")

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
                raise StoreError(f"refused the sealed copy {put.name} of {peer}: it is older than the newest copy here, {newer}")
            with open(descriptor, "rb", buffering=0, closefd=False) as content:
                is_kept = await to_its_end(self._put, put.name, content)
            if is_kept or put.name not in self._kept:
                self._kept[put.name] = _Kept(put.size, time.time(), put.digest if is_kept else b"")
        log.debug("keeps %s of %s, %d bytes", put.name, peer, put.size)

    def _put(self, name: str, content: BinaryIO) -> bool:
        try:
            return self._objects.put(name, content)
        except ArchiveError as error:
            raise StoreError(str(error)) from error

    def not_taken(self, peer: str, offer: Content, why: str) -> None:
        """Its sender has been told."""
        self._awaited.get(peer, {}).pop(offer.digest, None)

    def lost(self, peer: str) -> None:
        """The link to a peer is new: what was on its way is not any more."""
        self._awaited.pop(peer, None)
