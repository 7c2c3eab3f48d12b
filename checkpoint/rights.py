"""What each thread of a snapshot may: those that may something else than their first one stand in a resource of their own kind.

`checkpoint.resources.thread_rights` makes that; here it is read, also by those who have nothing to do with tracing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from checkpoint.model import Credentials, Fact, Member, Resource, Snapshot

KIND: Final = "thread_rights"


def everybodys(outline: Snapshot) -> Iterator[Credentials]:
    """The rights of every thread of every process."""
    processes: tuple[Snapshot | Member, ...] = (outline, *outline.members)
    for one in processes:
        first = one.process.credentials
        yield first
        yield from (of_thread(one.resources, thread.tid, first) for thread in one.threads)


def of_thread(resources: Iterable[Resource], tid: int, first: Credentials) -> Credentials:
    """The rights of a thread: its own, or those of the first."""
    for held in resources:
        threads = held.facts["threads"] if held.kind == KIND else []
        assert isinstance(threads, list)
        for one in threads:
            assert isinstance(one, list)
            if one[0] == tid:
                user, group, groups, capabilities = (_numbers(fact) for fact in one[1:5])
                return Credentials(_four(user), _four(group), groups, _five(capabilities), bool(one[5]), first.securebits)
    return first


def _numbers(fact: Fact) -> tuple[int, ...]:
    assert isinstance(fact, list)
    numbers = tuple(number for number in fact if isinstance(number, int))
    assert len(numbers) == len(fact)
    return numbers


def _four(numbers: tuple[int, ...]) -> tuple[int, int, int, int]:
    real, effective, saved, of_files = numbers
    return real, effective, saved, of_files


def _five(numbers: tuple[int, ...]) -> tuple[int, int, int, int, int]:
    inheritable, permitted, effective, bounding, ambient = numbers
    return inheritable, permitted, effective, bounding, ambient
