"""One team's archive: whole checkpoints, and the files that their programs need, each a sealed object (``ARCHIVE.md``)."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, Final
from urllib.parse import quote, unquote

import msgspec
from blake3 import blake3
from msgspec import Struct

from checkpoint.errors import UNDECODABLE, FormatError
from checkpoint.snapshot import format
from checkpoint.snapshot.canonical_state import Header
from checkpoint.snapshot.required_files import Need
from checkpoint.store.content_store import digest_of_descriptor
from checkpoint.store.index import BASE_SUFFIX, FOLDER_PREFIX, file_name, folder_name, order_of_name
from failover.archive import sealed
from failover.archive.keys import Keys, ids_of
from failover.archive.objects import FULL, FolderObjects, ObjectStore, PutRefusedError, require_room
from failover.config.store import S3
from failover.errors import ArchiveError

SUFFIX: Final = ".sealed"
CONTENTS: Final = "contents"
PART_SIZE: Final = 1 << 20
LABEL_SIZE_MAX: Final = sealed.FRAME_SIZE - 4
"""Bytes: it lies in the first frame."""

STAMP_MS_MAX: Final = 253_402_300_799_999
"""The last millisecond of the year 9999."""

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
    """One checkpoint in the archive, as its object's name says. An object with another name than it was sealed for does not open.

    Attributes:
        folder: of the component, `checkpoint.store.index.folder_name`; ``file``: of the checkpoint, in a store.
        stamp_ms: when it was sealed, since 1970; at least 1 more than the newest copy before it has. A new life of a component
            begins at epoch 1, and is newer all the same.
        epoch, generation, sequence: of the checkpoint.
        size: bytes of the object.
    """

    name: str
    folder: str
    file: str
    stamp_ms: int
    epoch: int
    generation: int
    sequence: int
    size: int

    @property
    def component(self) -> str:
        """Its name; one that was too long for an object's is cut."""
        return unquote(self.folder.removeprefix(FOLDER_PREFIX))

    @property
    def order(self) -> tuple[int, int, int, int]:
        """Later is greater."""
        return self.stamp_ms, self.epoch, self.generation, self.sequence

    @property
    def line(self) -> tuple[int, int, int, int]:
        """The same where epochs only grow (``rule = "etcd"``): a clock, or a late put, makes no copy newer."""
        return self.epoch, self.generation, self.sequence, self.stamp_ms

    @property
    def at_s(self) -> float:
        """When it was sealed, seconds since 1970."""
        return self.stamp_ms / 1000


class Archive:
    """The objects of one team.

    Args:
        keys: what is sealed here is for their readers.
        aside: a folder for files without a name that are sealed, or that arrive.
        by_epoch: the newest copy is that of the latest epoch, and none of an earlier epoch is put any more.
    """

    def __init__(self, objects: ObjectStore, keys: Keys, team: str, aside: Path, *, by_epoch: bool = False) -> None:
        self._by_epoch = by_epoch
        self._objects = objects
        self._keys = keys
        self._team = quote(team, safe="")
        self._aside = aside

    # Keeping

    def put(self, checkpoint: BinaryIO, robot: str, spec: bytes = b"") -> tuple[str, int]:
        """Keep a whole checkpoint, unless it is there unharmed for the same readers; prove that it arrived.

        Args:
            checkpoint: a file of the disk, of one base.

        Returns:
            The object's name, and its size.

        Raises:
            FormatError: it is no whole, unaltered base.
            ArchiveError: the place does not take it, or gives back something else; another robot has put a later epoch.
            OSError: the disk does not take the sealed copy.
        """
        header = format.verify(checkpoint.fileno())
        if not header.is_base:
            raise FormatError("a delta is not archived: it is no whole checkpoint")
        file, before = file_name(header), self.copies(header.component)
        if self._by_epoch and before and before[0].epoch > header.epoch:
            raise ArchiveError(
                f"the archive has {header.component} in epoch {before[0].epoch}, and this copy has epoch {header.epoch}: another "
                "robot has run it since; if none has, remove the copies of that epoch"
            )
        for copy in before:
            if copy.file == file and not self._lack(copy.name, copy.size):
                return copy.name, copy.size
        try:
            return self._put_now(checkpoint, header, robot, spec, before)
        except PutRefusedError as error:
            if error.why == FULL:
                raise
            return self._put_now(checkpoint, header, robot, spec, self.copies(header.component))  # another member was first

    def _put_now(self, checkpoint: BinaryIO, header: Header, robot: str, spec: bytes, before: list[Copy]) -> tuple[str, int]:
        """Keep a checkpoint as the newest copy, later than those before. Where there is no room, older ones of it go first."""
        now_s = time.time()
        stamp_ms = min(max([int(1000 * now_s), *(copy.stamp_ms + 1 for copy in before)]), STAMP_MS_MAX)
        name = f"{self._team}/{folder_name(header.component)}/{stamp_ms:012x}-{file_name(header)}{SUFFIX}"
        label = msgspec.msgpack.encode(Label(robot, now_s, spec))
        if len(label) > LABEL_SIZE_MAX:
            raise ArchiveError(f"the specification of {header.component} has {len(spec)} bytes: {LABEL_SIZE_MAX} is the limit")
        parts = _joined(len(label).to_bytes(4, "little") + label, checkpoint)
        return name, self._kept(name, parts, _size(checkpoint), spare=[copy.name for copy in before[1:]])

    def holds_whole(self, digest: bytes) -> bool:
        """Whether the content of this digest is here, with both ends of its object unharmed."""
        name = self._content_name(digest)
        size = self._objects.size(name)
        return size is not None and not self._refusal(name, size)

    def holds_for_all(self, digest: bytes) -> bool:
        """The same, and each reader can open it, and no other."""
        name = self._content_name(digest)
        size = self._objects.size(name)
        return size is not None and not self._lack(name, size)

    def put_content(self, digest: bytes, content: BinaryIO) -> int:
        """Keep a file that programs need, by its blake3 digest; the size of its object. Raises as `put`.

        An object of it that was harmed, or was sealed for other readers, is replaced.
        """
        name, found = self._content_name(digest), blake3()
        there = self._objects.size(name)
        if there is not None:
            if not self._lack(name, there):
                return there
            self._objects.remove(name)

        def prove() -> None:
            if found.digest() != digest:
                raise ArchiveError(
                    f"a file was to be archived as {digest.hex()}, and has another content; it was changed meanwhile"
                )

        return self._kept(name, _seen(_joined(b"", content), found.update), _size(content), prove)

    def thin(self, component: str, keep: int, but: str = "") -> int:
        """Remove all but the newest checkpoints of a component, and never the object of this name; how many went."""
        gone = [copy for copy in self.copies(component)[keep:] if copy.name != but]
        for copy in reversed(gone):
            self._objects.remove(copy.name)
        return len(gone)

    def _kept(
        self,
        name: str,
        parts: Iterator[bytes],
        size: int,
        prove: Callable[[], None] = lambda: None,
        spare: Sequence[str] = (),
    ) -> int:
        """Seal parts of so many bytes, prove them, and put them; the size of the object.

        Args:
            spare: objects that give way where the place is full, the last one first.
        """
        require_room(self._aside, size)
        with tempfile.TemporaryFile(dir=self._aside) as file:
            there = sealed.seal(self._keys, name, parts, file)
            prove()
            file.flush()
            is_ours = self._put_in_room(name, file, spare)
            if not is_ours:  # another member was first
                there = self._objects.size(name) or 0
        if refusal := self._refusal(name, there):
            if is_ours:  # it would count among those that are kept
                with contextlib.suppress(ArchiveError):
                    self._objects.remove(name)
            raise ArchiveError(f"{name} was put into the archive, and does not come back from it: {refusal}; it is put again")
        return there

    def _put_in_room(self, name: str, file: BinaryIO, spare: Sequence[str]) -> bool:
        """Put an object; whether it is ours."""
        for older in reversed(spare):
            try:
                return self._objects.put(name, file)
            except PutRefusedError as error:
                if error.why != FULL:
                    raise
            self._objects.remove(older)
        return self._objects.put(name, file)

    def _refusal(self, name: str, size: int) -> str:
        """Why an object is not whole; "" where its size and its two ends prove it: these keys, this name, the last frame."""
        try:
            self._proved(name, size)
        except ArchiveError as error:
            return str(error)
        return ""

    def _lack(self, name: str, size: int) -> str:
        """The same; or that it was sealed for others than those who are to open it."""
        try:
            readers = sealed.readers_in(self._proved(name, size))
        except ArchiveError as error:
            return str(error)
        return "" if readers == ids_of(self._keys.readers) else f"{name} was sealed for other members"

    def _proved(self, name: str, size: int) -> bytes:
        """The head of an object that is whole."""
        found = self._objects.size(name)
        if found != size:
            raise ArchiveError(f"it was sent with {size} bytes, and has {found or 0} there")
        with closing(self._objects.open(name)) as source:
            head = sealed.read_head(name, source)
        with closing(self._objects.open(name, sealed.last_frame(head, size))) as source:
            last = sealed.exactly(source, sealed.FRAME_SIZE + sealed.TAG_SIZE)
        sealed.check_end(self._keys, name, head, size, last)
        return head

    # Asking

    def copies(self, component: str = "") -> list[Copy]:
        """The checkpoints that are here, of one component or of all; the newest of each first."""
        below = f"{self._team}/{folder_name(component)}" if component else self._team
        found = []
        for stored in self._objects.listed(below):
            place, _, words = stored.name.removeprefix(f"{self._team}/").partition("/")
            stamp, _, file = words.removesuffix(SUFFIX).partition("-")
            is_one = place.startswith(FOLDER_PREFIX) and "/" not in words and words.endswith(BASE_SUFFIX + SUFFIX)
            if is_one and (stamp_ms := _stamp(stamp)) is not None and (order := order_of_name(file)) is not None:
                found.append(Copy(stored.name, place, file, stamp_ms, *order, stored.size))
        found.sort(key=lambda copy: copy.line if self._by_epoch else copy.order, reverse=True)
        return sorted(found, key=lambda copy: copy.folder)

    def named(self, name: str) -> list[Copy]:
        """The copies of the component that is named by its name or an end of it, the newest first.

        Raises:
            ArchiveError: the name fits several.
        """
        end, folder = "/" + name.lstrip("/"), folder_name(name)  # the folder: where the name was too long for an object's
        fitting = [copy for copy in self.copies() if copy.folder == folder or copy.component.endswith(end)]
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
            parts = sealed.unsealed(self._keys, copy.name, source)
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
        if file_name(header) != copy.file or folder_name(header.component) != copy.folder:
            raise ArchiveError(f"{copy.name} in the archive holds another checkpoint than its name says")
        return label

    def fetch_content(self, need: Need, file: BinaryIO) -> None:
        """Write a file that a program needs to an empty file. Raises as `fetch`."""
        name = self._content_name(need.digest)
        if self._objects.size(name) is None:
            raise ArchiveError(f"{need.path}, which the program needs, is not in the archive; install it here")
        with closing(self._objects.open(name)) as source:
            for part in sealed.unsealed(self._keys, name, source):
                file.write(part)
        file.flush()
        if digest_of_descriptor(file.fileno()) != need.digest:
            raise ArchiveError(f"{name} in the archive is not the content of {need.path}")

    def _content_name(self, digest: bytes) -> str:
        keyed = blake3(self._keys.shared + digest, derive_key_context=_NAMES).hexdigest()
        return f"{self._team}/{CONTENTS}/{keyed}{SUFFIX}"


def _stamp(word: str) -> int | None:
    """The milliseconds that a name begins with; None if it is no such name."""
    with contextlib.suppress(ValueError):
        return stamp if 0 <= (stamp := int(word, 16)) <= STAMP_MS_MAX else None
    return None


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


def _seen(parts: Iterator[bytes], see: Callable[[bytes], object]) -> Iterator[bytes]:
    for part in parts:
        see(part)
        yield part


def _joined(before: bytes, file: BinaryIO) -> Iterator[bytes]:
    if before:
        yield before
    offset = 0
    while part := os.pread(file.fileno(), PART_SIZE, offset):
        yield part
        offset += len(part)


def _label(name: str, packed: bytes) -> Label:
    try:
        label = msgspec.msgpack.decode(packed, type=Label)
        if not 0 <= label.at_s <= STAMP_MS_MAX / 1000:
            raise ValueError("its time is none")
        return label
    except UNDECODABLE as error:
        raise ArchiveError(f"{name} in the archive holds no checkpoint of this version of failover: {error}") from error
