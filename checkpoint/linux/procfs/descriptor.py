"""Read one descriptor of a process from /proc. Source: proc_pid_fd(5), proc_pid_fdinfo(5)."""

from __future__ import annotations

import functools
import os
import re
import socket
from collections.abc import Mapping
from typing import Final

from msgspec import Struct

from checkpoint.linux.procfs.procfs import READ_SIZE, parse_fields

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
        """Its name in reports."""
        return f"fd {self.number}"

    @property
    def fields(self) -> Mapping[str, str]:
        """The fields of fdinfo, the first of several lines of one key."""
        return parse_fields(self.text)

    @property
    def text(self) -> str:
        """The text of fdinfo."""
        return os.fsdecode(self.told)


class Standing(Struct, frozen=True):
    """The questions, besides its fdinfo, that tell whether a descriptor is unchanged.

    Attributes:
        link: where it leads.
        about: its fstat(2).
    """

    link: bool
    about: bool


def head_of(told: bytes) -> re.Match[bytes] | None:
    """The first lines of fdinfo: offset, flags, and of Linux 5.14 mnt_id and inode, which name an open file's file."""
    return _HEAD.match(told)


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
    """Facts that all open files of one of the kernel's own file systems share, in all processes; files there have no names.

    Attributes:
        prefix: of their targets, before the number of the inode; "" where the target says what it is.
        about: of one; its differences (times, permissions that fchmod(2) sets) do not matter.
    """

    prefix: str
    about: os.stat_result

    def target(self, inode: int) -> str:
        """Where the link of the one with this inode leads; "" if it must be read."""
        return f"{self.prefix}:[{inode}]" if self.prefix else ""


@functools.cache
def _nameless() -> Mapping[bytes, _Nameless]:
    """The file systems that programs use most, by the mnt_id of fdinfo: two questions less about each of thousands of sockets.

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
