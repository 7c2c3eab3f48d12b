"""What a process has open, as /proc tells it. Source: proc_pid_fd(5), proc_pid_fdinfo(5)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import parse_fields, read_bytes


@dataclass(frozen=True, slots=True)
class Descriptor:
    """One open descriptor.

    Attributes:
        target: where /proc/PID/fd/N leads, in the kernel's words: a path, "pipe:[123]", "anon_inode:[eventpoll]" …
        offset, flags: of fdinfo; flags hold O_CLOEXEC too.
        mode, device, rdev, inode, size, mtime_ns: of fstat(2).
        fields: everything that fdinfo says.
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
    fields: Mapping[str, str]

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"fd {self.number}"


def descriptors(pid: int) -> tuple[Descriptor, ...]:
    """Every open descriptor, in order of number."""
    return tuple(found for number in _numbers(pid) if (found := descriptor(pid, number)) is not None)


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
    path = f"/proc/{pid}/fd/{number}"
    try:
        target = os.readlink(path)
        about = os.stat(path)
        fields = parse_fields(os.fsdecode(read_bytes(pid, f"fdinfo/{number}")))
    except (FileNotFoundError, ProbeError):
        return None
    return Descriptor(
        number=number,
        target=target,
        offset=int(fields.get("pos", "0")),
        flags=int(fields.get("flags", "0"), 8),
        mode=about.st_mode,
        device=about.st_dev,
        rdev=about.st_rdev,
        inode=about.st_ino,
        size=about.st_size,
        mtime_ns=about.st_mtime_ns,
        links=about.st_nlink,
        fields=fields,
    )
