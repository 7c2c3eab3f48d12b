"""What each thread of a snapshot may: those that may something else than their first one stand in a resource of their own kind.

`checkpoint.resources.thread_rights` makes that; here it is read, also by those who have nothing to do with tracing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from checkpoint.errors import FormatError
from checkpoint.model import Credentials, Fact, Resource, Snapshot

KIND: Final = "thread_rights"
CONFINED: Final = "seccomp"
"""The kind of resource of `checkpoint.resources.seccomp`."""
MALFORMED: Final = "the rights of its threads are told in a way that this version does not know: use the version that captured it"


def everybodys(outline: Snapshot) -> Iterator[Credentials]:
    """The rights of every thread of every process."""
    for one in outline.processes:
        first = one.process.credentials
        yield first
        yield from (of_thread(one.resources, thread.tid, first) for thread in one.threads)


def could_gain(outline: Snapshot) -> bool:
    """Whether a thread has filters of seccomp(2), and gets new rights by an execve(2) all the same: only root's program may.

    Source: seccomp(2), on PR_SET_NO_NEW_PRIVS: a set-user-ID program could be kept from giving its rights up.

    Raises:
        FormatError: as `of_thread`.
    """
    return any(
        not of_thread(one.resources, tid, one.process.credentials).no_new_privs
        for one in outline.processes
        for tid in _filtered(one.resources)
    )


def _filtered(resources: Iterable[Resource]) -> Iterator[int]:
    """The ids of threads that have filters; of strict mode nobody is born who has other rights."""
    for held in resources:
        for fact in _listed(held.facts.get("threads")) if held.kind == CONFINED else ():
            match _listed(fact):
                case [int(tid), _, list(filters), *_]:
                    yield from (tid,) if filters else ()
                case _:
                    raise FormatError(MALFORMED)


def of_thread(resources: Iterable[Resource], tid: int, first: Credentials) -> Credentials:
    """The rights of a thread: its own, or those of the first.

    Raises:
        FormatError: they are told in another way than we know.
    """
    for held in resources:
        for one in _listed(held.facts.get("threads")) if held.kind == KIND else ():
            match _listed(one):
                case [number, user, group, groups, capabilities, no_new_privs, *_] if number == tid:
                    ids = _four(_numbers(user)), _four(_numbers(group)), _numbers(groups)
                    return Credentials(*ids, _five(_numbers(capabilities)), bool(no_new_privs), first.securebits)
                case [number, *_] if number == tid:
                    raise FormatError(MALFORMED)
    return first


def _listed(fact: Fact) -> list[Fact]:
    if not isinstance(fact, list):
        raise FormatError(MALFORMED)
    return fact


def _numbers(fact: Fact) -> tuple[int, ...]:
    numbers = tuple(number for number in _listed(fact) if isinstance(number, int))
    if len(numbers) != len(_listed(fact)):
        raise FormatError(MALFORMED)
    return numbers


def _four(numbers: tuple[int, ...]) -> tuple[int, int, int, int]:
    if len(numbers) != 4:
        raise FormatError(MALFORMED)
    real, effective, saved, of_files = numbers
    return real, effective, saved, of_files


def _five(numbers: tuple[int, ...]) -> tuple[int, int, int, int, int]:
    if len(numbers) != 5:
        raise FormatError(MALFORMED)
    inheritable, permitted, effective, bounding, ambient = numbers
    return inheritable, permitted, effective, bounding, ambient
