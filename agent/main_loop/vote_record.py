"""Vote record: the facts that the agent must not forget, durable before anything that depends on them leaves the machine.

One small file, ``ballot``: a line of JSON and a line with its digest. The agent writes it aside, syncs it, renames it, and syncs
the directory, so a power cut leaves the old content or the new, never a mixture. Besides the core's own record it holds the boot
counter, which distinguishes this life of the agent from every earlier one.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
from pathlib import Path
from typing import Final

import msgspec

from agent.errors import BallotError
from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole

FILE_NAME: Final = "ballot"
RESERVE_NAME: Final = "ballot.reserve"
RESERVE_SIZE: Final = 64 << 10
"""Bytes kept for the vote record of a full disk: a vote needs a few hundred, and a takeover cannot wait for an administrator."""
FULL: Final = (errno.ENOSPC, errno.EDQUOT)
VERSION: Final = 1
SIZE_LIMIT: Final = 4 << 20
"""Bytes; a record of ten thousand components is under a tenth of it."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the file.

    Attributes:
        boot: lives of this agent so far; grows by one at each start.
        core: the record that `failover.core` asked to keep, as it encoded it.
    """

    version: int
    robot: str
    boot: int
    core: bytes = b""


class VoteRecordFile:
    """The file of one robot. One thread at a time."""

    def __init__(self, directory: Path, robot: str) -> None:
        self._directory = directory
        self._path = directory / FILE_NAME
        self._record = Record(VERSION, robot, 0)

    @property
    def record(self) -> Record:
        """The record that is durable now."""
        return self._record

    def open(self) -> Record:
        """Read the record of an earlier life and begin a new one: the boot counter is raised, durably.

        Raises:
            BallotError: the file is unreadable, altered, or another robot's; or the directory cannot be written.
        """
        self._take(self._read())
        self._write(msgspec.structs.replace(self._record, boot=self._record.boot + 1))
        return self._record

    def _take(self, found: Record | None) -> None:
        if found is not None:
            if found.robot != self._record.robot:
                raise BallotError(
                    f"cannot start as {self._record.robot}: {self._path} belongs to {found.robot}; give each robot a "
                    "state_directory of its own, or the robot its old name"
                )
            self._record = found

    def read(self) -> Record:
        """The record of an earlier life, without beginning a new one; an empty one where there is none. `keep` changes it then.

        Raises:
            BallotError: the file is unreadable, altered, or another robot's.
        """
        self._take(self._read())
        return self._record

    def outlive(self, boot: int) -> None:
        """Count lives from this one on: the team remembers it, and this file does not. The next `open` is the one after it.

        Raises:
            BallotError: it could not be written; the old record stands.
        """
        self._write(msgspec.structs.replace(self._record, boot=boot))

    def keep(self, core: bytes) -> None:
        """Make the core's record durable. Returns when it would survive a power cut.

        Raises:
            BallotError: it could not be written; the old record stands.
        """
        if core != self._record.core:
            self._write(msgspec.structs.replace(self._record, core=core))

    def _read(self) -> Record | None:
        try:
            with self._path.open("rb") as file:
                content = file.read(SIZE_LIMIT)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise BallotError(f"cannot read {self._path}: {error.strerror}; the agent needs it to know its epochs") from error
        body, _, rest = content.partition(b"\n")
        try:
            if rest.strip().decode() != _digest(body):
                raise BallotError(_altered(self._path, "its digest does not fit"))
            record = msgspec.json.decode(body, type=Record)
        except UNDECODABLE as error:
            raise BallotError(_altered(self._path, str(error))) from error
        if record.version != VERSION:
            raise BallotError(f"cannot read {self._path}: it is of version {record.version}, this agent reads {VERSION}")
        return record

    def _write(self, record: Record) -> None:
        body = msgspec.json.encode(record)
        try:
            self._write_whole(body + b"\n" + _digest(body).encode() + b"\n")
        except OSError as error:
            raise BallotError(
                f"cannot write an epoch to {self._path}: {error.strerror}; "
                "until then this robot gives no vote and takes nothing over"
            ) from error
        self._record = record
        self._take_reserve()

    def _write_whole(self, content: bytes) -> None:
        """Write durably, if need be into the room that was kept for this."""
        try:
            write_whole(self._path, content, lasts="name")
        except OSError as error:
            if error.errno not in FULL or not self._give_reserve():
                raise
            write_whole(self._path, content, lasts="name")

    def _give_reserve(self) -> bool:
        """The disk is full: let the room go that was kept; False if there is none."""
        try:
            (self._directory / RESERVE_NAME).unlink()
        except OSError:
            return False
        return True

    def _take_reserve(self) -> None:
        """Keep some room, if there is any."""
        path = self._directory / RESERVE_NAME
        if path.exists():
            return
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, RESERVE_SIZE)
            except OSError:
                path.unlink()  # an empty one would be no reserve
            finally:
                os.close(descriptor)


def _digest(body: bytes) -> str:
    return hashlib.blake2b(body, digest_size=16).hexdigest()


def _altered(path: Path, why: str) -> str:
    return (
        f"cannot trust {path}: {why}. It holds the epochs this robot promised to honour; restore it, or, if the team agrees that "
        "this robot starts as new, remove the file and its snapshots"
    )
