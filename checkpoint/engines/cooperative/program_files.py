"""Find the files from which a cooperating program is started again: the file that its command names, and the files beside it.

* For a script of an interpreter: the script, the files of its kind beside it (``*.py`` beside ``main.py``), and the whole
  packages there (folders with an ``__init__.py``). The interpreter and its installed packages do not belong to the program.
* For any other program: its executable, and the files from the executable's directory or below that it has mapped.

Files in the system's own directories are installed, and belong to no program.

In a snapshot they are a resource of kind "program" with the fact ``files``: a list of [path, size, digest, mode]. The first one
is the file that is started. The resource is absent where there are more than `FILES_MAX` files.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath
from typing import Final

from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.user_rights import eyes_for, seeing_as
from checkpoint.model import Fact, Resource
from checkpoint.resources.files.regular import digest_at
from checkpoint.snapshot.credentials import Owner

KIND: Final = "program"

FILES_MAX: Final = 500
"""Each snapshot names them all; a program with more files must be installed by its operator."""

SYSTEM: Final = ("/usr", "/bin", "/sbin", "/lib", "/lib64", "/etc", "/proc", "/sys", "/dev", "/run")
INTERPRETERS: Final = ("python", "pypy", "node", "ruby", "perl", "lua", "sh", "bash", "dash")
"""How the names of executables begin that run other files."""

CACHE: Final = "__pycache__"


def describe(pid: int, component: str, arguments: Sequence[str], directory: str, owner: Owner | None = None) -> Resource | None:
    """The files of a running program, None where there are none, or too many.

    Args:
        arguments, directory: as it was started.
        owner: whose it is: it chooses its arguments, and shall not have us read for it what that user may not read.
    """
    try:
        with seeing_as(eyes_for(pid, owner)):
            entry, listed = _listed(pid, arguments, directory)
            paths = list(dict.fromkeys((entry, *listed)))
            if not entry or len(paths) > FILES_MAX:
                return None
            files: list[Fact] = [fact for path in paths if (fact := _fact(pid, path)) is not None]
    except (OSError, ProbeError, ProcessGoneError):
        return None  # it has ended, or may not be looked at: it is captured all the same
    is_told = bool(files) and isinstance(files[0], list) and files[0][0] == entry
    return Resource(KIND, component, {"files": files}) if is_told else None


def open_file(pid: int, path: str, owner: Owner | None = None) -> int:
    """A descriptor of one of them, as the program sees paths. Raises OSError, ProbeError, ProcessGoneError.

    Args:
        owner: as for `describe`.
    """
    with seeing_as(eyes_for(pid, owner)):
        return os.open(_seen(pid, path), os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)


def is_of_the_system(path: str) -> bool:
    """Whether a file is installed, and belongs to no program."""
    return any(path.startswith(place + "/") for place in SYSTEM)


def _seen(pid: int, path: str) -> str:
    return f"{procfs.outlook(pid)}{path}"


def _listed(pid: int, arguments: Sequence[str], directory: str) -> tuple[str, Iterator[str]]:
    """The file that is started, "" if it is installed; and the files beside it."""
    executable = os.readlink(f"/proc/{pid}/exe")
    name = PurePosixPath(executable).name
    if not any(name == one or name.rstrip("0123456789.") == one for one in INTERPRETERS):
        own = "" if is_of_the_system(executable) else executable
        return own, _mapped_below(pid, os.path.dirname(executable))
    entry = _script(pid, arguments, directory)
    return entry, _beside(pid, entry) if entry else iter(())


def _script(pid: int, arguments: Sequence[str], directory: str) -> str:
    """The file that an interpreter was told to run; "" if it is none, or installed."""
    for index, word in enumerate(arguments[1:], start=1):
        if word == "-c":
            return ""
        if word == "-m":
            module = os.path.join(directory, *arguments[index + 1 : index + 2]).replace(".", "/")
            found = next((path for path in (module + ".py", module + "/__main__.py") if _is_file(pid, path)), "")
            return "" if is_of_the_system(found) else found
        path = os.path.normpath(os.path.join(directory, word))
        if not word.startswith("-") and _is_file(pid, path):
            return "" if is_of_the_system(path) else path
    return ""


def _is_file(pid: int, path: str) -> bool:
    return os.path.isfile(_seen(pid, path))


def _beside(pid: int, entry: str) -> Iterator[str]:
    """The files of its kind, and packages, in the directory of a script; of a package's module, in that of the package."""
    suffix, folder = PurePosixPath(entry).suffix, os.path.dirname(entry)
    while suffix and os.path.isfile(_seen(pid, f"{folder}/__init__{suffix}")):
        folder = os.path.dirname(folder)
    for found in sorted(os.scandir(_seen(pid, folder)), key=lambda one: one.name):
        if found.is_file(follow_symlinks=False) and suffix and found.name.endswith(suffix):
            yield f"{folder}/{found.name}"
        elif found.name.startswith("."):
            continue
        elif found.is_dir(follow_symlinks=False) and suffix and os.path.isfile(f"{found.path}/__init__{suffix}"):
            yield from _package(pid, f"{folder}/{found.name}")


def _package(pid: int, folder: str) -> Iterator[str]:
    """All regular files below; no more than can be told."""
    count = 0
    for place, folders, names in os.walk(_seen(pid, folder)):
        folders[:] = sorted(one for one in folders if one != CACHE and not one.startswith("."))
        below = place.removeprefix(procfs.outlook(pid))
        for name in sorted(names):
            if stat.S_ISREG(os.lstat(f"{place}/{name}").st_mode):
                yield f"{below}/{name}"
                count += 1
        if count > FILES_MAX:
            return


def _mapped_below(pid: int, folder: str) -> Iterator[str]:
    for line in procfs.parse_maps(procfs.read_text(pid, "maps")):
        if line.has_file and line.name.startswith(folder + "/") and not line.name.endswith(procfs.DELETED):
            yield line.name


def _fact(pid: int, path: str) -> Fact | None:
    seen = _seen(pid, path)
    try:
        descriptor = os.open(seen, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
        about = os.fstat(descriptor)  # of what may be opened: a digest may be remembered from other eyes
        os.close(descriptor)
    except OSError:
        return None  # deleted since, or closed to the program
    if not stat.S_ISREG(about.st_mode):
        return None
    digest = digest_at(seen, (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns))
    return [path, about.st_size, digest, 0o755 if about.st_mode & 0o100 else 0o644] if digest else None
