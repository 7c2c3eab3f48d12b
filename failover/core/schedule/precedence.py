"""The order in which programs resume that run after one another: predecessors first. Pure.

A task that resumed before its predecessor would find none that runs, and go on at its deadline with what there is.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping


def awaited(name: str, after: Mapping[str, Collection[str]], resuming: Collection[str]) -> frozenset[str]:
    """Those that are to run before one goes on.

    Args:
        after: of each task, its predecessors. A task that would run after itself waits for none of its circle.
        resuming: those that do not run yet, and soon will.

    Returns:
        Its predecessors among these, also by way of others.
    """
    before = _before(name, after)
    if name in before:
        before = frozenset(one for one in before if name not in _before(one, after))
    return before & frozenset(resuming)


def _before(name: str, after: Mapping[str, Collection[str]]) -> frozenset[str]:
    found: set[str] = set()
    ahead = list(after.get(name, ()))
    while ahead:
        one = ahead.pop()
        if one not in found:
            found.add(one)
            ahead += after.get(one, ())
    return frozenset(found)
