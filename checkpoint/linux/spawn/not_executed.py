"""Why a program was not executed, in words with the cure: found out in the child, with its rights and in its directory.

Source: execve(2), ENOENT, EACCES and ENOEXEC.
"""

from __future__ import annotations

import errno
import os
from typing import Final

FIRST_LINE_SIZE: Final = 256
"""Bytes of a script's first line: the kernel reads no more of it."""

INTERPRETERS: Final = {".py": "python3", ".sh": "sh"}


def explained(error: OSError, name: str, path: str) -> OSError:
    """The same error with a sentence that says what is wrong with ``name``, and the command that would work.

    Args:
        path: the child's PATH.
    """
    found = name if "/" in name else os.fsdecode(error.filename or name)
    if "/" not in name and not os.path.lexists(found):
        return FileNotFoundError(errno.ENOENT, f"no directory of its PATH has {name}{_here(name)} (PATH is {path})")
    return OSError(error.errno, f"{error.strerror}{_because(error, found)}")


def _because(error: OSError, found: str) -> str:
    if error.errno == errno.ENOENT and os.path.lexists(found):
        return f": the file is there, but not its interpreter{_interpreter(found)}"
    if error.errno == errno.EACCES and os.path.isdir(found):
        return ": it is a directory"
    if error.errno == errno.EACCES and os.path.isfile(found):
        return f": it is not executable; start it by {_by_interpreter(found)}, or chmod +x {found}"
    if error.errno == errno.ENOEXEC:
        return f": it does not begin with #!INTERPRETER, and is no program of this machine; start it by {_by_interpreter(found)}"
    return ""


def _here(name: str) -> str:
    """How a file of the current directory is started, which is not looked into."""
    if not os.path.isfile(name):
        return ""
    how = f"./{name}" if os.access(name, os.X_OK) else _by_interpreter(name)
    return f"; start the one in {os.getcwd()} by {how}"


def _by_interpreter(name: str) -> str:
    return f"{INTERPRETERS.get(os.path.splitext(name)[1], 'INTERPRETER')} {name}"


def _interpreter(name: str) -> str:
    """The one that a script names."""
    try:
        with open(name, "rb") as file:
            mark, _, line = file.readline(FIRST_LINE_SIZE).partition(b"#!")
    except OSError:
        return ""
    words = line.split()
    return f" {os.fsdecode(words[0])}" if not mark and words else ""
