"""Address a unix socket by a path of any length."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

PATH_SIZE_MAX: Final = 107
"""Bytes of a path that fit a socket's address, and its final NUL. Source: unix(7), sun_path."""


@contextmanager
def address_of(path: Path) -> Iterator[str]:
    """The address to bind or connect a socket to, so that it lies at ``path``; valid inside the body.

    A path that is too long for an address is reached through a descriptor of its directory.

    Raises:
        OSError: such a path's directory cannot be opened; or its last part alone is too long.
    """
    if len(os.fsencode(path)) <= PATH_SIZE_MAX:
        yield str(path)
        return
    directory = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{directory}/{path.name}"
    finally:
        os.close(directory)
