"""A function whose state survives: a generator that yields where a commit may be made, or any function that commits by itself.

@failover.resumable
def survey(state: Survey) -> Iterator[None]:
    while state.leg < 10:
        fly(state.leg)
        state.leg += 1
        yield

survey(Survey())
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any, Protocol, TypeVar, overload

from failover.errors import TaskError
from failover.kept_state.api import PROCESS, commit, resume

S = TypeVar("S")

Plain = Callable[[S], Iterator[None] | None]
Awaited = Callable[[S], AsyncIterator[None] | Coroutine[Any, Any, None]]


class _Decorator(Protocol):
    """The decorator that ``resumable(name=…)`` returns."""

    @overload
    def __call__(self, function: Awaited[S], /) -> Callable[[S], Coroutine[Any, Any, S]]: ...
    @overload
    def __call__(self, function: Plain[S], /) -> Callable[[S], S]: ...


@overload
def resumable(function: Awaited[S], /) -> Callable[[S], Coroutine[Any, Any, S]]: ...
@overload
def resumable(function: Plain[S], /) -> Callable[[S], S]: ...
@overload
def resumable(*, name: str) -> _Decorator: ...
def resumable(function: Any = None, /, *, name: str = "") -> Any:
    """Make a function that is called with its first state and goes on from the last commit instead, where there is one.

    Each ``yield`` is a commit, and so is the end. A function that does not yield calls `failover.commit` where it stands well.
    The function begins anew each time: all that must survive is in the state. Coroutines and asynchronous generators likewise.

    Args:
        name: of the component; the function's name unless given.

    Returns:
        The function; it answers the state after its end.
    """

    if function is not None and not callable(function):
        raise TaskError(f"@failover.resumable({function!r}) is above no function: write @failover.resumable(name={function!r})")

    def made(chosen: Callable[[Any], Any]) -> Callable[[Any], Any]:
        title = name or chosen.__name__
        if inspect.iscoroutinefunction(chosen) or inspect.isasyncgenfunction(chosen):
            return functools.wraps(chosen)(functools.partial(_run_async, chosen, title))
        return functools.wraps(chosen)(functools.partial(_run, chosen, title))

    return made if function is None else made(function)


def _run(function: Callable[[S], Iterator[None] | None], name: str, default: S) -> S:
    state = resume(name, default=default)
    try:
        for _ in function(state) or ():
            commit()
        commit()
    finally:
        PROCESS.release()
    return state


async def _run_async(function: Awaited[S], name: str, default: S) -> S:
    state = resume(name, default=default)
    try:
        outcome = function(state)
        if isinstance(outcome, AsyncIterator):
            async for _ in outcome:
                commit()
        else:
            await outcome
        commit()
    finally:
        PROCESS.release()
    return state
