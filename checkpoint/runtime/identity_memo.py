"""Remember the last result of a computation, as long as its inputs are the very same objects.

Most inspected state has not changed since the last capture, and its readers then return the same objects. Comparing identities
takes no time; computing the meaning of hundreds of mappings again takes longer than a freeze.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Generic, TypeVar

_Result = TypeVar("_Result")


class Memo(Generic[_Result]):
    """One result, and its arguments. These are never changed in place."""

    def __init__(self) -> None:
        self._last: tuple[tuple[object, ...], _Result] | None = None

    def of(self, *things: object, make: Callable[[], _Result]) -> _Result:
        """The result for these things: the last one where they are the same objects, otherwise what ``make`` answers."""
        if self._last is None or len(self._last[0]) != len(things) or not all(map(operator.is_, self._last[0], things)):
            self._last = things, make()
        return self._last[1]

    def forget(self) -> None:
        """Work it out anew the next time."""
        self._last = None
