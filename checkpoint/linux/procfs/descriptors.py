"""Read all open descriptors of a process from /proc. Source: proc_pid_fd(5), proc_pid_fdinfo(5)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from checkpoint.errors import ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, NUMBER, RESULT_TO, ROW_SIZE, OwnCalls, row
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor, standing_of
from checkpoint.linux.procfs.descriptor_cache import KeptTexts
from checkpoint.linux.procfs.live_thread import pidfd_of


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
    """The descriptors that lead there; of the others nothing more is read."""
    numbers = [number for number in descriptor_numbers(pid) if _target(pid, number) == target]
    return tuple(found for number in numbers if (found := descriptor(pid, number)) is not None)


def _target(pid: int, number: int) -> str:
    """Where it leads; "" when it was closed meanwhile."""
    try:
        return os.readlink(f"/proc/{pid}/fd/{number}")
    except FileNotFoundError:
        return ""


def descriptor_numbers(pid: int) -> list[int]:
    """The numbers of open descriptors; of a thread too, by its id.

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


def _descriptor(number: int, links: int, texts: int) -> Descriptor | None:
    """One descriptor, by the directories fd and fdinfo of its process."""
    found = standing_of(number, links, texts)
    return found[0] if found else None


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
        to = self._closing.address_of(0, FIRST_ARGUMENT)  # we close exactly the ones that we got; an error is no descriptor
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
