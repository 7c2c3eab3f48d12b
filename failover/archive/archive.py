"""One team's archive: checkpoints, and the files that their programs need, each a sealed object (``ARCHIVE.md``).

A copy is a base, or a delta to the copy before it: what has changed since. Whoever fetches one fetches those before it, too,
back to a base, and folds them. A chain stays short, and its deltas together smaller than half of the base. A delta is made only
by the process that has put the copy before it, as long as that is the newest one, is whole, and was sealed for the same readers.
"""

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

from checkpoint.errors import UNDECODABLE, CheckpointError, FormatError
from checkpoint.snapshot import format
from checkpoint.snapshot.canonical_state import Header
from checkpoint.snapshot.required_files import Need
from checkpoint.store.chain_files import folded_in_steps
from checkpoint.store.content_store import digest_of_descriptor
from checkpoint.store.difference import Known, difference, known_of
from checkpoint.store.index import BASE_SUFFIX, DELTA_SUFFIX, FOLDER_PREFIX, file_name, folder_name, order_of_name
from failover.archive import sealed
from failover.archive.keys import Keys, check_own, ids_of
from failover.archive.objects import FULL, FolderObjects, ObjectStore, PutRefusedError, require_room
from failover.config.store import S3
from failover.core.types import SPAN
from failover.errors import ArchiveError

SUFFIX: Final = ".sealed"
CONTENTS: Final = "contents"
PART_SIZE: Final = 1 << 20
LABEL_SIZE_MAX: Final = sealed.FRAME_SIZE - 4
"""Bytes: it lies in the first frame."""

PARENT: Final = "~"
"""In the name of a delta, before the stamp of the copy that it follows."""

DELTAS_MAX: Final = 15
"""Deltas that may follow one base."""

DELTAS_PART: Final = 0.5
"""How large they may be together, as a part of the base."""

CHANGED_MAX: Final = 64 << 20
"""Bytes of changed pages of one delta: they are in memory while it is made."""

LAST_MAX: Final = 64
"""Components of which the last copy is remembered."""

NUMBER_MAX: Final = (1 << 63) - 1

SIZE_MAX: Final = 1 << 50
"""Bytes of an object: what a place says beyond that is no truth."""

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
        size: bytes of all objects that it takes to have it: this one, and those before it back to a base.
        before: names of those others, the base first.
    """

    name: str
    folder: str
    file: str
    stamp_ms: int
    epoch: int
    generation: int
    sequence: int
    size: int
    before: tuple[str, ...] = ()

    @property
    def component(self) -> str:
        """Its name; one that was too long for an object's is cut."""
        return unquote(self.folder.removeprefix(FOLDER_PREFIX))

    @property
    def base(self) -> str:
        """The object of the base that it takes."""
        return (*self.before, self.name)[0]

    @property
    def order(self) -> tuple[int, int, int, int, int]:
        """Later is greater. What a site puts after an operator gave it up is never the newest: `failover.core.election.sites`."""
        return self.epoch // SPAN, self.stamp_ms, self.epoch, self.generation, self.sequence

    @property
    def line(self) -> tuple[int, int, int, int]:
        """The same where epochs only grow (``rule = "etcd"``): a clock, or a late put, makes no copy newer."""
        return self.epoch, self.generation, self.sequence, self.stamp_ms

    @property
    def at_s(self) -> float:
        """When it was sealed, seconds since 1970."""
        return self.stamp_ms / 1000


class Last(Struct, frozen=True, eq=False):
    """What is remembered of the newest copy that this process has put of a component: a delta may follow it.

    Attributes:
        name: of the object; ``known``: of the state; ``keys``: for whose readers it was sealed.
    """

    name: str
    known: Known
    keys: Keys


class Archive:
    """The objects of one team.

    Args:
        keys: what is sealed here is for their readers.
        aside: a folder for files without a name that are sealed, or that arrive.
        by_epoch: the newest copy is that of the latest epoch, and none of an earlier epoch is put any more.
        last: component → what was put last, which lasts longer than this object; None: each copy is a base.
    """

    def __init__(
        self,
        objects: ObjectStore,
        keys: Keys,
        team: str,
        aside: Path,
        *,
        by_epoch: bool = False,
        last: dict[str, Last] | None = None,
    ) -> None:
        self._last = last
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
            The object's name, and the bytes of all objects that it takes to have this copy.

        Raises:
            FormatError: it is no whole, unaltered base.
            ArchiveError: the place does not take it, or gives back something else; another robot has put a later epoch.
            OSError: the disk does not take the sealed copy.
        """
        header = format.verify(checkpoint.fileno())
        if not header.is_base:
            raise FormatError("a delta is not archived: it is no whole checkpoint")
        folder = f"{self._team}/{folder_name(header.component)}"
        there = self._found(folder)
        before, _ = there
        if self._by_epoch and before and before[0].epoch > header.epoch:
            raise ArchiveError(
                f"the archive has {header.component} in epoch {before[0].epoch}, and this copy has epoch {header.epoch}: another "
                "robot has run it since; if none has, remove the copies of that epoch"
            )
        for copy in before:
            if _stem(copy.file) == _stem(file_name(header)) and not self._lack_of(copy):
                return copy.name, copy.size
        try:
            return self._put_now(checkpoint, header, robot, spec, folder, there)
        except PutRefusedError as error:
            if error.why == FULL:
                raise
            return self._put_now(checkpoint, header, robot, spec, folder, self._found(folder))  # another member was first

    def _put_now(
        self, checkpoint: BinaryIO, header: Header, robot: str, spec: bytes, folder: str, there: tuple[list[Copy], list[_Object]]
    ) -> tuple[str, int]:
        """Keep a checkpoint as the newest copy, later than those before. Where there is no room, older ones of it go first."""
        before, found = there
        now_s = time.time()
        stamp_ms = min(max([int(1000 * now_s), *(one.stamp_ms + 1 for one in found)]), STAMP_MS_MAX)
        label = msgspec.msgpack.encode(Label(robot, now_s, spec))
        if len(label) > LABEL_SIZE_MAX:
            raise ArchiveError(f"the specification of {header.component} has {len(spec)} bytes: {LABEL_SIZE_MAX} is the limit")
        with tempfile.TemporaryFile(dir=self._aside) as changed:
            known = known_of(checkpoint.fileno()) if self._last is not None else None
            parent = None
            if known is not None and before and before[0].stamp_ms < stamp_ms:
                parent = before[0] if self._continues(header.component, before[0], checkpoint, known, changed) else None
            content: BinaryIO = changed if parent else checkpoint
            name = f"{folder}/{stamp_ms:012x}-{file_name(format.read_header(content.fileno()))}"
            name += (f"{PARENT}{parent.stamp_ms:012x}" if parent else "") + SUFFIX
            parts = _joined(len(label).to_bytes(4, "little") + label, content)
            size = self._kept(name, parts, _size(content), spare=_spare(before, found))
        if self._last is not None:
            self._last.pop(header.component, None)
        if parent and self._objects.size(parent.name) is None:  # another member has removed it meanwhile
            self._objects.remove(name)
            return self._put_now(checkpoint, header, robot, spec, folder, self._found(folder))
        if self._last is not None and known is not None and not known.is_tree:
            self._last[header.component] = Last(name, known, self._keys)
            while len(self._last) > LAST_MAX:
                del self._last[next(iter(self._last))]
        return name, size + (parent.size if parent else 0)

    def _continues(self, component: str, newest: Copy, checkpoint: BinaryIO, known: Known, file: BinaryIO) -> bool:
        """Write what has changed since the newest copy to an empty file, where a delta may follow that copy."""
        assert self._last is not None
        last = self._last.get(component)
        if last is None or last.name != newest.name or last.keys != self._keys or len(newest.before) >= DELTAS_MAX:
            return False
        if self._lack_of(newest) or (base_size := self._objects.size(newest.base)) is None:
            return False
        delta = difference(checkpoint.fileno(), known, last.known, CHANGED_MAX)
        if delta is None:
            return False
        format.encode(delta, file)
        file.flush()
        return newest.size + _size(file) <= (1 + DELTAS_PART) * base_size

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
        if (there := self._objects.size(name)) is not None and not self._lack(name, there):
            return there

        def prove() -> None:
            if found.digest() != digest:
                raise ArchiveError(
                    f"a file was to be archived as {digest.hex()}, and has another content; it was changed meanwhile"
                )

        return self._kept(name, _seen(_joined(b"", content), found.update), _size(content), prove, replaces=True)

    def thin(self, component: str, keep: int, but: str = "") -> int:
        """Remove all but the newest checkpoints of a component and what these need, and never the object of this name.

        Where two copies at least are kept, they have two bases.

        Returns:
            How many objects went.
        """
        copies, found = self._found(f"{self._team}/{folder_name(component)}")
        newest_of = {_stem(copy.file): copy for copy in reversed(copies)}  # of a checkpoint that was sealed anew, the newest copy
        wanted = [copy for copy in copies if newest_of[_stem(copy.file)] is copy]
        kept = [*wanted[:keep], *(copy for copy in copies if copy.name == but)]
        if len({copy.base for copy in kept}) == 1 < keep:  # harm to one object is not to reach all copies
            kept += [copy for copy in wanted[keep:] if copy.base != kept[0].base][:1]
        needed = {name for copy in kept for name in (copy.name, *copy.before)}
        newest = max((copy.stamp_ms for copy in copies), default=0)
        gone = [one for one in found if one.name not in needed and one.stamp_ms <= newest]
        for one in sorted(gone, key=lambda one: one.stamp_ms, reverse=True):  # a delta goes before what it follows
            self._objects.remove(one.name)
        return len(gone)

    def _kept(
        self,
        name: str,
        parts: Iterator[bytes],
        size: int,
        prove: Callable[[], None] = lambda: None,
        spare: Sequence[_Object] = (),
        *,
        replaces: bool = False,
    ) -> int:
        """Seal parts of so many bytes, prove them, and put them; the size of the object.

        Args:
            spare: objects that give way where the place is full, the last one first.
            replaces: an object of this name goes at the last moment, if it still lacks something (`_lack`).
        """
        check_own(self._keys)
        require_room(self._aside, size)
        with tempfile.TemporaryFile(dir=self._aside) as file:
            there = sealed.seal(self._keys, name, parts, file)
            prove()
            file.flush()
            if replaces and (found := self._objects.size(name)) is not None:
                if not self._lack(name, found):
                    return found  # another member was first
                self._objects.remove(name)
            is_ours = self._put_in_room(name, file, spare)
            if not is_ours:  # another member was first
                there = self._objects.size(name) or 0
        if refusal := self._refusal(name, there):
            if is_ours:  # it would count among those that are kept
                with contextlib.suppress(ArchiveError):
                    self._objects.remove(name)
            raise ArchiveError(f"{name} was put into the archive, and does not come back from it: {refusal}; it is put again")
        return there

    def _put_in_room(self, name: str, file: BinaryIO, spare: Sequence[_Object]) -> bool:
        """Put an object; whether it is ours."""
        rest = list(spare)
        while True:
            try:
                return self._objects.put(name, file)
            except PutRefusedError as error:
                if error.why != FULL or not rest or error.lacks > sum(one.size for one in rest):
                    raise
            self._objects.remove(rest.pop().name)

    def _refusal(self, name: str, size: int) -> str:
        """Why an object is not whole; "" where its size and its two ends prove it: these keys, this name, the last frame.

        Raises:
            ArchiveError: its place does not answer.
        """
        return self._looked_at(name, size)[0]

    def _lack(self, name: str, size: int) -> str:
        """The same; or that it was sealed for others than those who are to open it."""
        refusal, readers = self._looked_at(name, size)
        return refusal or ("" if readers == ids_of(self._keys.readers) else f"{name} was sealed for other members")

    def _lack_of(self, copy: Copy) -> str:
        """The same of each object that it takes to have a copy."""
        lacks = (self._lack(name, self._objects.size(name) or 0) for name in (copy.name, *copy.before))
        return next(filter(None, lacks), "")

    def _looked_at(self, name: str, size: int) -> tuple[str, frozenset[bytes]]:
        """Why it is not whole, and its readers. What its place cannot do is raised, and is no fault of the object."""
        nobody = frozenset[bytes]()
        found = self._objects.size(name)
        if found != size or not sealed.HEAD_SIZE_LEAST < size <= SIZE_MAX:
            return f"it was sent with {size} bytes, and has {found or 0} there", nobody
        with closing(self._objects.open(name)) as source:
            first = sealed.exactly(source, sealed.HEAD_SIZE_LEAST)
            try:
                head_size = sealed.head_size(name, first)
            except ArchiveError as error:
                return str(error), nobody
            head = first + sealed.exactly(source, head_size - len(first))
        if len(head) < head_size or size < head_size + sealed.TAG_SIZE:
            return f"{name} in the archive was cut off in its head", nobody
        with closing(self._objects.open(name, sealed.last_frame(head, size))) as source:
            last = sealed.exactly(source, sealed.FRAME_SIZE + sealed.TAG_SIZE)
        try:
            sealed.check_end(self._keys, name, head, size, last)
        except ArchiveError as error:
            return str(error), nobody
        return "", sealed.readers_in(head)

    # Asking

    def copies(self, component: str = "") -> list[Copy]:
        """The checkpoints that are here, of one component or of all; the newest of each first."""
        return self._found(f"{self._team}/{folder_name(component)}" if component else self._team)[0]

    def _found(self, below: str) -> tuple[list[Copy], list[_Object]]:
        """The same; and the objects of all checkpoints there, also of those that lack what they follow."""
        found = sorted(self._objects_of(below), key=lambda one: one.stamp_ms)
        copies: list[Copy] = []
        whole: dict[tuple[str, int], list[Copy]] = {}
        for one in found:
            parent = None
            if one.parent_ms is not None:
                parent = next((copy for copy in whole.get((one.folder, one.parent_ms), ()) if _follows(one, copy)), None)
                if parent is None:
                    continue
            before = (*parent.before, parent.name) if parent else ()
            size = one.size + (parent.size if parent else 0)
            copies.append(Copy(one.name, one.folder, one.file, one.stamp_ms, *one.number, size, before))
            whole.setdefault((one.folder, one.stamp_ms), []).append(copies[-1])
        copies.sort(key=lambda copy: copy.line if self._by_epoch else copy.order, reverse=True)
        return sorted(copies, key=lambda copy: copy.folder), found

    def _objects_of(self, below: str) -> list[_Object]:
        """The objects of checkpoints below a place, in no particular order."""
        found = []
        for stored in self._objects.listed(below):
            place, _, words = stored.name.removeprefix(f"{self._team}/").partition("/")
            is_one = place.startswith(FOLDER_PREFIX) and "/" not in words and words.endswith(SUFFIX)
            if is_one and (one := _object(stored.name, place, words.removesuffix(SUFFIX), stored.size)) is not None:
                found.append(one)
        return found

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
            ArchiveError: it, or one that it follows, was altered, cut off, or sealed with another key; the file is worth nothing.
            OSError: the file, or the disk, does not take it.
        """
        if not copy.before:
            return self._fetch_one(copy.name, copy.folder, copy.file, file)
        require_room(self._aside, 3 * copy.size)  # the objects, folded, and the file
        try:
            with contextlib.ExitStack() as files:
                chain = []
                for name in (*copy.before, copy.name):
                    chain.append(files.enter_context(tempfile.TemporaryFile(dir=self._aside)))
                    label = self._fetch_one(name, copy.folder, _file_of(name), chain[-1])
                with folded_in_steps([one.fileno() for one in chain], self._aside) as folded:
                    for part in _joined(b"", folded):
                        file.write(part)
            file.flush()
            header = format.verify(file.fileno())
        except CheckpointError as error:
            raise ArchiveError(f"{copy.name} in the archive does not continue the copy before it: {error}") from error
        if _stem(file_name(header)) != _stem(copy.file):
            raise ArchiveError(f"{copy.name} in the archive leads to another checkpoint than its name says")
        return label

    def _fetch_one(self, name: str, folder: str, named: str, file: BinaryIO) -> Label:
        """One object of a checkpoint."""
        with closing(self._objects.open(name)) as source:
            parts = sealed.unsealed(self._keys, name, source)
            first = next(parts, b"")
            size = int.from_bytes(first[:4], "little")
            label = _label(name, first[4 : 4 + size]) if size <= LABEL_SIZE_MAX else None
            if label is None:
                raise ArchiveError(f"{name} in the archive holds no checkpoint of this version of failover")
            file.write(first[4 + size :])
            for part in parts:
                file.write(part)
        file.flush()
        try:
            header = format.verify(file.fileno())
        except FormatError as error:
            raise ArchiveError(f"{name} in the archive is no whole checkpoint: {error}") from error
        if file_name(header) != named or folder_name(header.component) != folder:
            raise ArchiveError(f"{name} in the archive holds another checkpoint than its name says")
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


class _Object(Struct, frozen=True):
    """An object of a checkpoint, as its name says. ``parent_ms``: the stamp of the copy that a delta follows; None: a base."""

    name: str
    folder: str
    file: str
    stamp_ms: int
    parent_ms: int | None
    number: tuple[int, int, int]
    size: int


def _object(name: str, folder: str, words: str, size: int) -> _Object | None:
    """None where the name is none of a checkpoint."""
    stamp, _, rest = words.partition("-")
    file, mark, parent = rest.partition(PARENT)
    stamp_ms, parent_ms, number = _stamp(stamp), _stamp(parent) if mark else None, order_of_name(file)
    is_delta = file.endswith(DELTA_SUFFIX)
    if stamp_ms is None or number is None or is_delta != (parent_ms is not None) or not (is_delta or file.endswith(BASE_SUFFIX)):
        return None
    if (parent_ms is not None and parent_ms >= stamp_ms) or max(number) > NUMBER_MAX or size > SIZE_MAX:
        return None
    return _Object(name, folder, file, stamp_ms, parent_ms, number, size)


def _follows(delta: _Object, copy: Copy) -> bool:
    """Whether a delta may follow a copy, as their names say."""
    is_later = delta.number[1:] > (copy.generation, copy.sequence)
    return is_later and delta.number[0] == copy.epoch and len(copy.before) < DELTAS_MAX


def _spare(copies: list[Copy], found: list[_Object]) -> list[_Object]:
    """What may go where there is no room, the last one first: what is no copy, then copies from the oldest one on."""
    newest = {name for copy in copies[:1] for name in (copy.name, *copy.before)}
    whole = {copy.name for copy in copies}
    spare = [one for one in found if one.name not in newest]
    return sorted(spare, key=lambda one: (one.name in whole, one.stamp_ms), reverse=True)


def _file_of(name: str) -> str:
    """The file of a store that an object of a checkpoint holds."""
    return name.rpartition("/")[2].removesuffix(SUFFIX).partition("-")[2].partition(PARENT)[0]


def _stem(file: str) -> str:
    """A file's name without the word that says whether it stands alone."""
    return file.removesuffix(BASE_SUFFIX).removesuffix(DELTA_SUFFIX)


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
