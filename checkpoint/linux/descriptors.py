"""What a process has open, as /proc tells it. Source: proc_pid_fd(5), proc_pid_fdinfo(5)."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs import READ_SIZE, parse_fields

_HEAD: Final = re.compile(rb"pos:\s*(\d+)\nflags:\s*(\d+)\n")

BLOCK_SIZE: Final = 512
"""Bytes of what stat(2) counts as a block."""


@dataclass(frozen=True, slots=True)
class Descriptor:
    """One open descriptor.

    Attributes:
        target: where /proc/PID/fd/N leads, in the kernel's words: a path, "pipe:[123]", "anon_inode:[eventpoll]" …
        offset, flags: of fdinfo; flags hold O_CLOEXEC too.
        mode, device, rdev, inode, size, mtime_ns, uid, gid: of fstat(2).
        stored: bytes of it that are no holes, as fstat(2) tells blocks.
        told: everything that fdinfo says, unread.
    """

    number: int
    target: str
    offset: int
    flags: int
    mode: int
    device: int
    rdev: int
    inode: int
    size: int
    mtime_ns: int
    links: int
    told: bytes
    uid: int
    gid: int
    stored: int

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"fd {self.number}"

    @property
    def fields(self) -> Mapping[str, str]:
        """What fdinfo says, the first of several lines of one key."""
        return parse_fields(self.text)

    @property
    def text(self) -> str:
        """What fdinfo says."""
        return os.fsdecode(self.told)


def descriptors(pid: int) -> tuple[Descriptor, ...]:
    """Every open descriptor, in order of number."""
    numbers = _numbers(pid)
    with _opened(pid, "fd") as links, _opened(pid, "fdinfo") as texts:
        return tuple(found for number in numbers if (found := _descriptor(number, links, texts)) is not None)


def descriptors_to(pid: int, target: str) -> tuple[Descriptor, ...]:
    """Those that lead there; of the others nothing more is read."""
    numbers = [number for number in _numbers(pid) if _target(pid, number) == target]
    return tuple(found for number in numbers if (found := descriptor(pid, number)) is not None)


def _target(pid: int, number: int) -> str:
    """Where it leads; "" when it was closed meanwhile."""
    try:
        return os.readlink(f"/proc/{pid}/fd/{number}")
    except FileNotFoundError:
        return ""


def _numbers(pid: int) -> list[int]:
    try:
        return sorted(map(int, os.listdir(f"/proc/{pid}/fd")))
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"cannot list descriptors: there is no process {pid}") from error
    except PermissionError as error:
        raise ProbeError(
            f"cannot list descriptors of pid {pid}: not permitted; run as the same user or with CAP_SYS_PTRACE"
        ) from error


def descriptor(pid: int, number: int) -> Descriptor | None:
    """One open descriptor; None when it was closed meanwhile."""
    with _opened(pid, "fd") as links, _opened(pid, "fdinfo") as texts:
        return _descriptor(number, links, texts)


@contextlib.contextmanager
def _opened(pid: int, name: str) -> Iterator[int]:
    """A directory of /proc/PID, for the body: its files are reached faster than by their whole paths."""
    try:
        directory = os.open(f"/proc/{pid}/{name}", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"cannot list descriptors: there is no process {pid}") from error
    except PermissionError as error:
        raise ProbeError(
            f"cannot list descriptors of pid {pid}: not permitted; run as the same user or with CAP_SYS_PTRACE"
        ) from error
    try:
        yield directory
    finally:
        os.close(directory)


def _descriptor(number: int, links: int, texts: int) -> Descriptor | None:
    """One descriptor, by the directories fd and fdinfo of its process."""
    name = str(number)
    try:
        target = os.readlink(name, dir_fd=links)
        about = os.stat(name, dir_fd=links)
        told = _read(name, texts)
    except (FileNotFoundError, ProcessLookupError):
        return None
    head = _HEAD.match(told)
    return Descriptor(
        number=number,
        target=target,
        offset=int(head[1]) if head else 0,
        flags=int(head[2], 8) if head else 0,
        mode=about.st_mode,
        device=about.st_dev,
        rdev=about.st_rdev,
        inode=about.st_ino,
        size=about.st_size,
        mtime_ns=about.st_mtime_ns,
        links=about.st_nlink,
        told=told,
        uid=about.st_uid,
        gid=about.st_gid,
        stored=about.st_blocks * BLOCK_SIZE,
    )


def _read(name: str, directory: int) -> bytes:
    """A file that the kernel writes whole into a buffer that is large enough."""
    descriptor = os.open(name, os.O_RDONLY | os.O_CLOEXEC, dir_fd=directory)
    try:
        told = os.read(descriptor, READ_SIZE)
        while len(told) % READ_SIZE == 0 and (more := os.read(descriptor, READ_SIZE)):
            told += more
        return told
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def copy_of(pid: int, number: int) -> Iterator[int]:
    """A descriptor of ours for the same open file, for the body.

    Raises:
        OSError: it was closed meanwhile, it is opened with O_PATH, or we may not.
    """
    pidfd = os.pidfd_open(pid)
    try:
        descriptor = abi.pidfd_getfd(pidfd, number)
    finally:
        os.close(pidfd)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
