"""What a process has open, as /proc tells it. Source: proc_pid_fd(5), proc_pid_fdinfo(5)."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import socket
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import Struct

from checkpoint.errors import ProcessGoneError
from checkpoint.linux import abi, procfs
from checkpoint.linux.own_calls import FIRST_ARGUMENT, NUMBER, RESULT_TO, ROW_SIZE, OwnCalls, row
from checkpoint.linux.procfs import READ_SIZE, parse_fields
from checkpoint.linux.spokesman import pidfd_of

if TYPE_CHECKING:
    from checkpoint.linux.kept_descriptors import KeptTexts

_HEAD: Final = re.compile(rb"pos:\s*(\d+)\nflags:\s*(\d+)\n(?:mnt_id:\s*(\d+)\nino:\s*(\d+)\n)?")

BLOCK_SIZE: Final = 512
"""Bytes of what stat(2) counts as a block."""


class Descriptor(Struct, frozen=True):
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


def descriptors(pid: int, kept: KeptTexts | None = None) -> tuple[Descriptor, ...]:
    """Every open descriptor, in order of number.

    Args:
        kept: of a process that is looked at again and again.
    """
    if kept is not None and kept.are_there():
        if (same := kept.as_before()) is not None:
            return same
        numbers, is_asked = kept.numbers, True
    else:
        numbers, is_asked = descriptor_numbers(pid), False
    with _opened(pid, "fd") as links, _opened(pid, "fdinfo") as texts:
        if kept is None:
            return tuple(found for number in numbers if (found := _descriptor(number, links, texts)) is not None)
        return kept.every(numbers, links, texts, is_asked=is_asked)


def descriptors_to(pid: int, target: str) -> tuple[Descriptor, ...]:
    """Those that lead there; of the others nothing more is read."""
    numbers = [number for number in descriptor_numbers(pid) if _target(pid, number) == target]
    return tuple(found for number in numbers if (found := descriptor(pid, number)) is not None)


def _target(pid: int, number: int) -> str:
    """Where it leads; "" when it was closed meanwhile."""
    try:
        return os.readlink(f"/proc/{pid}/fd/{number}")
    except FileNotFoundError:
        return ""


def descriptor_numbers(pid: int) -> list[int]:
    """The numbers of what is open; of a thread too, by its id.

    Raises:
        ProcessGoneError: there is none.
        ProbeError: we may not.
    """
    try:
        return sorted(map(int, os.listdir(f"/proc/{pid}/fd")))
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"cannot list descriptors: there is no process {pid}") from error
    except PermissionError as error:
        what = f"cannot list descriptors of pid {pid}: not permitted"
        raise procfs.denied(pid, f"{what}; run as the same user or with CAP_SYS_PTRACE") from error


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
        what = f"cannot list descriptors of pid {pid}: not permitted"
        raise procfs.denied(pid, f"{what}; run as the same user or with CAP_SYS_PTRACE") from error
    try:
        yield directory
    finally:
        os.close(directory)


class Standing(Struct, frozen=True):
    """What must be asked, besides its fdinfo, to know that a descriptor is what it was.

    Attributes:
        link: where it leads.
        about: its fstat(2).
    """

    link: bool
    about: bool


def head_of(told: bytes) -> re.Match[bytes] | None:
    """What the first lines of fdinfo say: offset, flags, and of Linux 5.14 mnt_id and inode, which name an open file's file."""
    return _HEAD.match(told)


def _descriptor(number: int, links: int, texts: int) -> Descriptor | None:
    """One descriptor, by the directories fd and fdinfo of its process."""
    found = standing_of(number, links, texts)
    return found[0] if found else None


def standing_of(number: int, links: int, texts: int) -> tuple[Descriptor, Standing] | None:
    """The same, and what must be asked of it the next time."""
    name = str(number)
    try:
        told = _read(name, texts)
        head = _HEAD.match(told)
        alike = _nameless().get(head[3]) if head else None
        standing = Standing(link=alike is None or not alike.prefix, about=alike is None)
        if head is None or alike is None:
            target, about = os.readlink(name, dir_fd=links), os.stat(name, dir_fd=links)
            inode = about.st_ino
        else:
            inode, about = int(head[4]), alike.about
            target = alike.target(inode) or os.readlink(name, dir_fd=links)
            if not alike.prefix and inode != about.st_ino:  # one that has an inode of its own
                about, standing = os.stat(name, dir_fd=links), Standing(link=True, about=True)
    except (FileNotFoundError, ProcessLookupError):
        return None
    return _made(number, target, told, head, inode, about), standing


def _made(number: int, target: str, told: bytes, head: re.Match[bytes] | None, inode: int, about: os.stat_result) -> Descriptor:
    return Descriptor(
        number=number,
        target=target,
        offset=int(head[1]) if head else 0,
        flags=int(head[2], 8) if head else 0,
        mode=about.st_mode,
        device=about.st_dev,
        rdev=about.st_rdev,
        inode=inode,
        size=about.st_size,
        mtime_ns=about.st_mtime_ns,
        links=about.st_nlink,
        told=told,
        uid=about.st_uid,
        gid=about.st_gid,
        stored=about.st_blocks * BLOCK_SIZE,
    )


class _Nameless(Struct, frozen=True):
    """What all open files of one of the kernel's own file systems have in common, whoever has them; nobody can name a file there.

    Attributes:
        prefix: of their targets, before the number of the inode; "" where the target says what it is.
        about: of one; what differs there (times, permissions that fchmod(2) sets) matters to nobody.
    """

    prefix: str
    about: os.stat_result

    def target(self, inode: int) -> str:
        """Where the link of the one with this inode leads; "" if it must be read."""
        return f"{self.prefix}:[{inode}]" if self.prefix else ""


@functools.cache
def _nameless() -> Mapping[bytes, _Nameless]:
    """Those file systems that programs use most, by the mnt_id of fdinfo: two questions less about each of thousands of sockets.

    None before Linux 5.14, whose fdinfo does not tell inodes. These mounts are there from the machine's start to its end.
    """
    ours = [*os.pipe(), os.eventfd(0), *(one.detach() for one in socket.socketpair())]
    found = {}
    try:
        for number in ours:
            with open(f"/proc/self/fdinfo/{number}", "rb") as file:
                head = _HEAD.match(file.read())
            if head and head[3]:
                prefix, _, rest = os.readlink(f"/proc/self/fd/{number}").partition(":")
                found[head[3]] = _Nameless(prefix if rest == f"[{int(head[4])}]" else "", os.fstat(number))
    finally:
        for number in ours:
            os.close(number)
    return found


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


_LENT: Final[dict[int, int]] = {}
"""By pid: pidfds of processes that are asked for many copies just now; `NOT_YET` until there is a first one."""
NOT_YET: Final = -1


@contextlib.contextmanager
def lending(pid: int) -> Iterator[None]:
    """Have every `copy_of` of this process in the body go by one and the same pidfd; that is opened when it is needed."""
    assert pid not in _LENT, "one at a time"
    _LENT[pid] = NOT_YET
    try:
        yield
    finally:
        pidfd = _LENT.pop(pid)
        if pidfd != NOT_YET:
            os.close(pidfd)


def _lent(pid: int) -> int:
    """The pidfd that is lent for a process."""
    if _LENT[pid] == NOT_YET:
        _LENT[pid] = pidfd_of(pid)
    return _LENT[pid]


class Copier:
    """Takes copies of the same descriptors again and again, and gives them back: the tables of calls for that are made once.

    Attributes:
        numbers: the descriptors.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        self.numbers = tuple(numbers)
        self._taking, self._closing = OwnCalls(len(numbers)), OwnCalls(len(numbers))
        self._closing.entries[:, NUMBER] = row("close")[NUMBER]
        self._taking.entries[:] = row("pidfd_getfd")
        self._taking.entries[:, FIRST_ARGUMENT + 1] = numbers
        to = self._closing.address_of(0, FIRST_ARGUMENT)  # what is had is what is closed; an error is no descriptor
        self._taking.entries[:, RESULT_TO] = to + ROW_SIZE * np.arange(len(numbers), dtype=np.uint64)
        self._copies = self._closing.entries[:, FIRST_ARGUMENT].view(np.int64)

    @contextlib.contextmanager
    def taken(self, pid: int) -> Iterator[Sequence[int]]:
        """Descriptors of ours for the same open files, for the body, in the same order; negative where one cannot be had."""
        if pid not in _LENT:
            with lending(pid), self.taken(pid) as copies:
                yield copies
            return
        try:
            pidfd = _lent(pid)
        except OSError:  # it has been killed, or we have no descriptor left
            yield [NOT_YET] * len(self.numbers)
            return
        self._taking.entries[:, FIRST_ARGUMENT] = pidfd
        self._taking.run()
        try:
            yield self._copies.tolist()
        finally:
            self._closing.run()


@contextlib.contextmanager
def copy_of(pid: int, number: int) -> Iterator[int]:
    """A descriptor of ours for the same open file, for the body.

    Raises:
        OSError: it was closed meanwhile, it is opened with O_PATH, or we may not.
    """
    if pid not in _LENT:
        with lending(pid), copy_of(pid, number) as descriptor:
            yield descriptor
        return
    descriptor = abi.pidfd_getfd(_lent(pid), number)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
