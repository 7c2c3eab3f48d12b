"""One team's archive: whole checkpoints, and the files that their programs need, each a sealed object (``ARCHIVE.md``)."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, Final
from urllib.parse import quote, unquote

import msgspec
from blake3 import blake3
from msgspec import Struct

from checkpoint.errors import UNDECODABLE, FormatError
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import Need
from checkpoint.store.content_store import digest_of_descriptor
from checkpoint.store.index import BASE_SUFFIX, FOLDER_PREFIX, file_name, folder_name, order_of_name
from failover.archive import sealed
from failover.archive.objects import FolderObjects, ObjectStore
from failover.config.store import S3
from failover.errors import ArchiveError

SUFFIX: Final = ".sealed"
CONTENTS: Final = "contents"
PART_SIZE: Final = 1 << 20
LABEL_SIZE_MAX: Final = sealed.FRAME_SIZE - 4
"""Bytes: it lies in the first frame."""

_NAMES: Final = "failover-archive-1 names of contents"
"""Context of the digests by which contents are named: who has not the key cannot tell which programs a team runs."""


def object_store(place: str, endpoint: str = "") -> ObjectStore:
    """The store at a place: ``s3://BUCKET/PREFIX``, or the absolute path of a folder.

    Raises:
        ArchiveError: it is neither, or the library for S3 is not installed.
    """
    if place.startswith(S3):
        from failover.archive.s3 import S3Objects  # here: a folder needs no such library

        bucket, _, prefix = place.removeprefix(S3).partition("/")
        return S3Objects(bucket, prefix.strip("/"), endpoint)
    return FolderObjects(Path(place))


class Label(Struct, frozen=True):
    """What stands before a checkpoint in its object.

    Attributes:
        robot: that archived it; ``at_s``: when, seconds since 1970.
        spec: of the component, in msgpack, as the rules have it; b"": not known there.
    """

    robot: str
    at_s: float
    spec: bytes = b""


class Copy(Struct, frozen=True):
    """One checkpoint in the archive, as its object's name says.

    Attributes:
        folder: of the component, `checkpoint.store.index.folder_name`.
        epoch, generation, sequence: of the checkpoint.
        size: bytes of the object; ``at_s``: when it came, seconds since 1970.
    """

    name: str
    folder: str
    epoch: int
    generation: int
    sequence: int
    size: int
    at_s: float

    @property
    def component(self) -> str:
        """Its name; one that was too long for an object's is cut."""
        return unquote(self.folder.removeprefix(FOLDER_PREFIX))

    @property
    def order(self) -> tuple[int, int, int]:
        """Later is greater."""
        return self.epoch, self.generation, self.sequence


class Archive:
    """The objects of one team.

    Args:
        key: the archive key.
        aside: a folder for files without a name that are sealed, or that arrive.
    """

    def __init__(self, objects: ObjectStore, key: bytes, team: str, aside: Path) -> None:
        self._objects = objects
        self._key = key
        self._team = quote(team, safe="")
        self._aside = aside

    # Keeping

    def put(self, checkpoint: BinaryIO, robot: str, spec: bytes = b"") -> tuple[str, int]:
        """Keep a whole checkpoint, unless it is there; prove that it arrived.

        Args:
            checkpoint: a file of the disk, of one base.

        Returns:
            The object's name, and its size.

        Raises:
            FormatError: it is no whole, unaltered base.
            ArchiveError: the place does not take it, or gives back something else.
            OSError: the disk does not take the sealed copy.
        """
        header = format.verify(checkpoint.fileno())
        if not header.is_base:
            raise FormatError("a delta is not archived: it is no whole checkpoint")
        name = f"{self._team}/{folder_name(header.component)}/{file_name(header)}{SUFFIX}"
        label = msgspec.msgpack.encode(Label(robot, time.time(), spec))
        if len(label) > LABEL_SIZE_MAX:
            raise ArchiveError(f"the specification of {header.component} has {len(spec)} bytes: {LABEL_SIZE_MAX} is the limit")
        before = len(label).to_bytes(4, "little") + label
        return name, self._kept(name, _joined(before, checkpoint))

    def lacks(self, digest: bytes) -> bool:
        """Whether the content of this digest is not here."""
        return self._objects.size(self._content_name(digest)) is None

    def put_content(self, digest: bytes, content: BinaryIO) -> int:
        """Keep a file that programs need, by its blake3 digest; the size of its object. Raises as `put`."""
        if digest_of_descriptor(content.fileno()) != digest:
            raise ArchiveError(f"a file was to be archived as {digest.hex()}, and has another content; it was changed meanwhile")
        return self._kept(self._content_name(digest), _joined(b"", content))

    def thin(self, component: str, keep: int) -> int:
        """Remove all but the newest checkpoints of a component; how many went."""
        gone = self.copies(component)[keep:]
        for copy in reversed(gone):
            self._objects.remove(copy.name)
        return len(gone)

    def _kept(self, name: str, parts: Iterator[bytes]) -> int:
        there, is_ours = self._objects.size(name), False
        if there is None:
            with tempfile.TemporaryFile(dir=self._aside) as file:
                there = sealed.seal(self._key, name, parts, file)
                file.flush()
                is_ours = self._objects.put(name, file)
                if not is_ours:  # another member was first
                    there = self._objects.size(name) or 0
        try:
            self._prove(name, there)
        except ArchiveError:
            if is_ours:  # its name is free for another try
                with contextlib.suppress(ArchiveError):
                    self._objects.remove(name)
            raise
        return there

    def _prove(self, name: str, size: int) -> None:
        """Read the ends of an object back: as long as it should be, under this key, with its last frame."""
        found = self._objects.size(name)
        if found != size:
            raise ArchiveError(
                f"{name} was put into the archive with {size} bytes, and has {found or 0} there; the next try is a new one"
            )
        with closing(self._objects.open(name)) as source:
            head = sealed.exactly(source, sealed.HEAD_SIZE)
        with closing(self._objects.open(name, sealed.last_frame(size))) as source:
            sealed.check_end(self._key, name, head, size, sealed.exactly(source, sealed.FRAME_SIZE + sealed.TAG_SIZE))

    # Asking

    def copies(self, component: str = "") -> list[Copy]:
        """The checkpoints that are here, of one component or of all; the newest of each first."""
        below = f"{self._team}/{folder_name(component)}" if component else self._team
        found = []
        for stored in self._objects.listed(below):
            place, _, file = stored.name.removeprefix(f"{self._team}/").partition("/")
            is_one = place.startswith(FOLDER_PREFIX) and "/" not in file and file.endswith(BASE_SUFFIX + SUFFIX)
            if is_one and (order := order_of_name(file)) is not None:
                found.append(Copy(stored.name, place, *order, stored.size, stored.at_s))
        found.sort(key=lambda copy: copy.order, reverse=True)
        return sorted(found, key=lambda copy: copy.folder)

    def named(self, name: str) -> list[Copy]:
        """The copies of the component that is named by its name or an end of it, the newest first.

        Raises:
            ArchiveError: the name fits several.
        """
        fitting = [copy for copy in self.copies() if copy.component == name or copy.component.endswith("/" + name.lstrip("/"))]
        if len(meant := sorted({copy.component for copy in fitting})) > 1:
            raise ArchiveError(f"{name!r} could be {', '.join(meant)}; give the whole name")
        return fitting

    def fetch(self, copy: Copy, file: BinaryIO) -> Label:
        """Write a checkpoint to an empty file, which holds it whole and proved afterwards.

        Raises:
            ArchiveError: it was altered, cut off, or sealed with another key; the file is worth nothing.
            OSError: the file does not take it.
        """
        with closing(self._objects.open(copy.name)) as source:
            parts = sealed.unsealed(self._key, copy.name, source)
            first = next(parts, b"")
            size = int.from_bytes(first[:4], "little")
            label = _label(copy.name, first[4 : 4 + size]) if size <= LABEL_SIZE_MAX else None
            if label is None:
                raise ArchiveError(f"{copy.name} in the archive holds no checkpoint of this version of failover")
            file.write(first[4 + size :])
            for part in parts:
                file.write(part)
        file.flush()
        try:
            header = format.verify(file.fileno())
        except FormatError as error:
            raise ArchiveError(f"{copy.name} in the archive is no whole checkpoint: {error}") from error
        if file_name(header) + SUFFIX != copy.name.rpartition("/")[2] or folder_name(header.component) != copy.folder:
            raise ArchiveError(f"{copy.name} in the archive holds another checkpoint than its name says")
        return label

    def fetch_content(self, need: Need, file: BinaryIO) -> None:
        """Write a file that a program needs to an empty file. Raises as `fetch`."""
        name = self._content_name(need.digest)
        if self._objects.size(name) is None:
            raise ArchiveError(f"{need.path}, which the program needs, is not in the archive; install it here")
        with closing(self._objects.open(name)) as source:
            for part in sealed.unsealed(self._key, name, source):
                file.write(part)
        file.flush()
        if digest_of_descriptor(file.fileno()) != need.digest:
            raise ArchiveError(f"{name} in the archive is not the content of {need.path}")

    def _content_name(self, digest: bytes) -> str:
        keyed = blake3(self._key + digest, derive_key_context=_NAMES).hexdigest()
        return f"{self._team}/{CONTENTS}/{keyed}{SUFFIX}"


def _joined(before: bytes, file: BinaryIO) -> Iterator[bytes]:
    if before:
        yield before
    offset = 0
    while part := os.pread(file.fileno(), PART_SIZE, offset):
        yield part
        offset += len(part)


def _label(name: str, packed: bytes) -> Label:
    try:
        return msgspec.msgpack.decode(packed, type=Label)
    except UNDECODABLE as error:
        raise ArchiveError(f"{name} in the archive holds no checkpoint of this version of failover: {error}") from error
