"""Receives the files that other robots' programs need, at their future standby: which are here, which lack, which arrive.

A file is here when the one at its path has the very content, or when that content was brought before
(`checkpoint.store.content_store`). A server runs nothing, and its own files help no program: it keeps every file.
"""

from __future__ import annotations

import asyncio
import logging
import os
import stat
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Final

from msgspec import Struct

from agent.system.threads import to_its_end
from agent.worker.replication.transfer import Refusal
from checkpoint.errors import StoreError
from checkpoint.snapshot.required_files import Need
from checkpoint.store.content_store import DIGEST_SIZE, digest_of_file
from checkpoint.store.contract import SnapshotStore
from failover.core.wire.messages import Belonging, Belongings, Content, Lacking

PATH_MAX: Final = 4096
"""Source: limits.h."""

NAMED: Final = 3
"""Files that a sentence names; of more it says how many."""

DIGESTS_KEPT: Final = 4096

ASKING_S: Final = 60.0
"""Files that a peer names within this time count as one asking: all parts of one come in seconds."""

MB: Final = 10**6

log = logging.getLogger("failover.belongings")


class Limits(Struct, frozen=True):
    """The limits that this robot's operator sets.

    Attributes:
        bring: files are brought here at all.
        size_max: bytes of all that is brought for one component.
        runs: this member runs programs, so that its own files count.
    """

    bring: bool = True
    size_max: int = 10**9
    runs: bool = True


class Stock:
    """The files here, and the `Desk` for contents that come in. One for an agent; lives in its loop, reads files in threads."""

    def __init__(self, store: SnapshotStore, limits: Limits, robot: str, admits: Callable[[str, str], str]) -> None:
        """
        Args:
            robot: own name, for the sentences.
            admits: told a component and a peer: why nothing of it is taken from there, "" if it is.
        """
        self._store = store
        self._limits = limits
        self._robot = robot
        self._admits_component = admits
        self._awaited: dict[str, dict[bytes, int]] = {}
        self._named: dict[tuple[str, str], dict[bytes, tuple[Belonging, float]]] = {}

    async def compare(self, peer: str, asked: Belongings) -> Lacking:
        """Answer which of a program's files are lacking here; from then on that peer may offer them."""
        if reason := self._admits_component(asked.component, peer):
            return Lacking(asked.number, (), reason)
        if strange := next((file for file in asked.files if not is_plausible(file)), None):
            return Lacking(
                asked.number, (), f"{strange.path[:PATH_MAX]!r} of {strange.size} bytes is no file that could be brought"
            )
        elsewhere = await asyncio.to_thread(self._not_in_place, asked.files)
        lacking = [file for file in elsewhere if not self._is_kept(file)]
        if reason := self._hindrance(self._all_named(peer, asked.component, elsewhere), lacking):
            return Lacking(asked.number, (), reason)
        awaited = {file.digest: file.size for file in lacking}
        self._awaited.setdefault(peer, {}).update(awaited)
        return Lacking(asked.number, tuple(awaited))

    def _not_in_place(self, files: Iterable[Belonging]) -> list[Belonging]:
        return [file for file in files if not (self._limits.runs and is_in_place(file))]

    def _all_named(self, peer: str, component: str, files: Iterable[Belonging]) -> list[Belonging]:
        """These, and the files named in the same asking: it may come in several messages."""
        now_s = time.monotonic()
        known = self._named.setdefault((peer, component), {})
        known |= {file.digest: (file, now_s) for file in files}
        self._named[peer, component] = {key: one for key, one in known.items() if now_s - one[1] < ASKING_S}
        return [file for file, _ in self._named[peer, component].values()]

    def _is_kept(self, file: Belonging) -> bool:
        return bool(file.digest) and self._store.contents.hold(file.digest, file.size)

    def _hindrance(self, elsewhere: list[Belonging], lacking: list[Belonging]) -> str:
        """Why the lacking files cannot be brought; "" if they can."""
        if not lacking:
            return ""
        if not self._limits.bring:
            return f"{self._robot} lacks {named(lacking)} and takes no files of programs: install them there, or set bring = true"
        if undigested := [file for file in lacking if not file.digest]:
            told = named(undigested)
            return f"{self._robot} lacks {told}, which failover cannot bring: too large, or not readable; install them there"
        size = sum({file.digest: file.size for file in elsewhere}.values())
        if size > self._limits.size_max:
            largest = sorted(elsewhere, key=lambda file: -file.size)
            limit = f"bring_size = {size_told(self._limits.size_max)} there"
            return f"its files that {self._robot} lacks are {size_told(size)} ({named(largest)}), over {limit}"
        return ""

    def lost(self, peer: str) -> None:
        """The link to a peer is gone; it will ask again."""
        self._awaited.pop(peer, None)
        self._named = {key: named for key, named in self._named.items() if key[0] != peer}

    # As a desk (`agent.worker.replication.transfer.Desk`)

    def admits(self, peer: str, offer: Content) -> None:
        """Take files that were said to be lacking, and no others."""
        if self._awaited.get(peer, {}).get(offer.digest) != offer.size:
            raise Refusal("this robot has not asked for that file")

    def make_room(self, size: int) -> None:
        """As for a snapshot."""
        try:
            self._store.make_room(size)
        except StoreError as error:
            log.warning("%s", error)

    async def take(self, peer: str, offer: Content, descriptor: int) -> None:
        """Keep it; its digest is right."""
        await to_its_end(self._store.contents.put, descriptor, offer.digest, own=True)
        self._awaited.get(peer, {}).pop(offer.digest, None)

    def not_taken(self, peer: str, offer: Content, why: str) -> None:
        """Its sender has been told."""


def is_plausible(file: Belonging) -> bool:
    """Whether it can be looked for: an absolute path without detours, a size, a digest or none."""
    path = file.path
    is_path = path.startswith("/") and len(path) <= PATH_MAX and "\0" not in path and ".." not in path.split("/")
    return is_path and file.size >= 0 and len(file.digest) in (0, DIGEST_SIZE)


def is_in_place(file: Belonging | Need) -> bool:
    """Whether the file at the path here has the content; where that is not known, whether it is as long."""
    if not file.exact:
        return os.path.lexists(file.path)
    try:
        about = os.stat(file.path)
        if not stat.S_ISREG(about.st_mode) or about.st_size != file.size:
            return False
        version = (about.st_dev, about.st_ino, about.st_mtime_ns, about.st_ctime_ns)
        return not file.digest or _digest(file.path, version) == file.digest
    except OSError:
        return False


@lru_cache(maxsize=DIGESTS_KEPT)
def _digest(path: str, version: tuple[int, int, int, int]) -> bytes:  # part of the key
    return digest_of_file(path)


def named(files: Iterable[Belonging]) -> str:
    """A few of them by name and size, for a sentence."""
    listed = list(files)
    told = ", ".join(f"{file.path} ({size_told(file.size)})" for file in listed[:NAMED])
    return told + (f" and {len(listed) - NAMED} more" if len(listed) > NAMED else "")


def size_told(size: int) -> str:
    """A size as people say it."""
    return f"{size / MB:.1f} MB" if size >= MB // 10 else f"{size} bytes"
