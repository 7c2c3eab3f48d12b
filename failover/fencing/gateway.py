"""Reference gateway in front of an actuator: obeys no robot that has been replaced.

A robot that was cut off, or hung, may for an instant still run a program that already runs elsewhere. None of its own clocks and
leases can rule that out for the world outside of it. The controller of the actuator can, because it hears both robots:

    gateway = failover.Gateway("/var/lib/gripper/epoch")
    ...
    with gateway.passing(epoch):        # of the command that came; failover.epoch() at the sender
        move(command)

The rule is the whole protocol: remember the highest epoch that was ever seen, refuse a lower one, and let no other command in
between the question and the move. It needs no agent, and a controller without Python does the same in a few lines.
"""

from __future__ import annotations

import fcntl
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from checkpoint.store.whole_file import write_whole
from failover.errors import GatewayError, StaleEpochError

MAGIC: Final = b"FOEPOCH1"
_RECORD: Final = struct.Struct("<8sQI")
"""Magic, epoch, CRC-32 of both."""

_SUM_SIZE: Final = 4
EPOCH_MAX: Final = (1 << 64) - 1


class Gateway:
    """Refuses the commands of older epochs, also after a power cut. Any thread may ask; one process has the file.

    Attributes:
        newest: the highest epoch that was ever admitted; 0 for none.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """
        Args:
            path: of the file that remembers; made if it is not there, in a directory that is. One a component and actuator.

        Raises:
            GatewayError: it cannot be had, another process has it, or it is damaged.
        """
        self._path = Path(path)
        self._lock = threading.RLock()
        self._held = self._open()
        try:
            self.newest = self._read()
        except GatewayError:
            self.close()
            raise

    @contextmanager
    def passing(self, epoch: int) -> Iterator[None]:
        """Obey a command of this epoch in the body; no other one passes meanwhile, so that none of a later epoch goes before it.

        Raises:
            StaleEpochError, GatewayError: as `admit`; the body is not entered.
        """
        with self._lock:
            self._admit(epoch)
            yield

    def admit(self, epoch: int) -> None:
        """Return where a command of this epoch may be obeyed now, by the only thread that obeys any.

        A new epoch is on the disk before.

        Raises:
            StaleEpochError: another primary has given a command of a later epoch: refuse this one.
            GatewayError: it is no epoch, or a new one cannot be made durable: obey nothing.
        """
        with self._lock:
            self._admit(epoch)

    def _admit(self, epoch: int) -> None:
        if isinstance(epoch, bool) or not isinstance(epoch, int) or not 0 <= epoch <= EPOCH_MAX:
            raise GatewayError(f"{epoch!r} is no epoch: it is a number from 0 to 2**64 - 1; send failover.epoch()")
        if epoch < self.newest:
            raise StaleEpochError(epoch, self.newest)
        if epoch > self.newest:
            self._write(epoch)
            self.newest = epoch

    def reset(self) -> None:
        """Begin anew at 0: an operator's decision, for a component whose team was made anew and counts from the beginning.

        Raises:
            GatewayError: it cannot be made durable.
        """
        with self._lock:
            self._write(0)
            self.newest = 0

    def close(self) -> None:
        """Let another process have the file."""
        if self._held >= 0:
            os.close(self._held)
            self._held = -1

    def __enter__(self) -> Gateway:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> int:
        """Hold the lock that stands beside the file: the file itself is replaced, so a lock on it would not last."""
        lock = self._path.with_name(self._path.name + ".lock")
        try:
            held = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise GatewayError(
                f"cannot use {self._path}: {error.strerror}; give the gateway a directory that it may write"
            ) from error
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(held)
            raise GatewayError(f"cannot use {self._path}: another process has it; one gateway decides for an actuator") from error
        return held

    def _read(self) -> int:
        try:
            content = self._path.read_bytes()
        except FileNotFoundError:
            return 0
        except OSError as error:
            raise GatewayError(f"cannot read {self._path}: {error.strerror}") from error
        if len(content) == _RECORD.size:
            magic, epoch, found = _RECORD.unpack(content)
            if magic == MAGIC and found == zlib.crc32(content[:-_SUM_SIZE]):
                return int(epoch)
        raise GatewayError(
            f"{self._path} is damaged: which epochs are over is not known; remove it when no older program can run any more"
        )

    def _write(self, epoch: int) -> None:
        """The file is the old one or the new one, whenever the power goes."""
        begin = struct.pack("<8sQ", MAGIC, epoch)
        try:
            write_whole(self._path, begin + struct.pack("<I", zlib.crc32(begin)), lasts="name")
        except OSError as error:
            raise GatewayError(
                f"cannot make epoch {epoch} durable in {self._path}: {error.strerror}; nothing is obeyed"
            ) from error
