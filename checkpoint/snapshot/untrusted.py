"""Turn errors from untrusted snapshot facts into one error class: facts may be missing, of another type, or out of range.

Each kind of resource reads its own facts as they should be. Where a fact is wrong, Python raises an error of any class; this
module turns it into one that says so, so that the snapshot is refused and no process ends because of it.
"""

from __future__ import annotations

import contextlib
import logging
import struct
from collections.abc import Iterator
from typing import Final

from checkpoint.errors import CheckpointError, FormatError
from checkpoint.sentences import in_words

NOT_UNDERSTOOD: Final = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    OSError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)
"""Errors that a fact of the wrong type or value causes."""

log = logging.getLogger("failover.foreign")


@contextlib.contextmanager
def facts(what: str) -> Iterator[None]:
    """Read, and act upon, the facts of a snapshot.

    Args:
        what: the act, for a sentence: "restore /lab/a".

    Raises:
        FormatError: a fact is not understood. Perhaps that is our mistake: the place is logged.
    """
    try:
        yield
    except CheckpointError:
        raise
    except NOT_UNDERSTOOD as error:
        log.warning("cannot %s", what, exc_info=error)
        raise FormatError(sentence(what, error)) from error


def sentence(what: str, error: Exception) -> str:
    """The sentence that something cannot be done, and why: a refusal of the kernel may be this machine's fault, too."""
    if isinstance(error, OSError):
        cure = "if this machine lacks nothing for that, take a new snapshot: this one asks too much"
        return f"cannot {what}: {in_words(error)}; {cure}"
    return (
        f"cannot {what}: its snapshot says something that this version does not understand ({type(error).__name__}: {error}); "
        "use the version that captured it, or take a new snapshot"
    )
