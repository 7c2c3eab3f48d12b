"""What a target is: one decoder that bytes of others reach, with valid examples, and what it may answer."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from msgspec import Struct

from agent.errors import AgentError
from checkpoint.errors import CheckpointError
from failover.errors import FailoverError
from tests.fuzz.mutation import Form

SENTENCES: Final = (AgentError, CheckpointError, FailoverError)
"""A refusal in words: what a decoder may raise."""


class Decoder(Struct, frozen=True):
    """A decoder, ready to be called.

    Attributes:
        seeds: valid contents; `call` takes each of them without a refusal.
        call: raises nothing but `refusals`.
    """

    seeds: Sequence[bytes]
    call: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...] = SENTENCES


class Target(Struct, frozen=True):
    """A decoder by name.

    Attributes:
        bytes_of: whose bytes reach it, and where: for people.
        needs: a library that may be missing.
    """

    name: str
    bytes_of: str
    made: Callable[[], Decoder]
    form: Form = "bytes"
    needs: str = ""


TARGETS: Final[dict[str, Target]] = {}


def target(bytes_of: str, form: Form = "bytes", needs: str = "") -> Callable[[Callable[[], Decoder]], Callable[[], Decoder]]:
    """Put a function that makes a decoder into the table; its name is the target's."""

    def put(made: Callable[[], Decoder]) -> Callable[[], Decoder]:
        name = made.__name__.replace("_", "-")
        assert name not in TARGETS, f"two targets are called {name}"
        TARGETS[name] = Target(name, bytes_of, made, form, needs)
        return made

    return put


@contextmanager
def scratch_root() -> Iterator[None]:
    """Have a place in memory for the files of targets, in this process and its children; it goes at the end."""
    global _root
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else tempfile.gettempdir()
    _root = Path(memory, f"failover-fuzz-{os.getpid()}-{time.monotonic_ns()}")
    try:
        yield
    finally:
        shutil.rmtree(_root, ignore_errors=True)


def scratch() -> Path:
    """A directory of its own for a target, inside of `scratch_root`."""
    assert _root is not None, "only inside of scratch_root"
    _root.mkdir(mode=0o700, exist_ok=True)
    return Path(tempfile.mkdtemp(dir=_root))


_root: Path | None = None
