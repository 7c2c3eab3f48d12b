"""Make deleted files again inside a vessel, under a temporary name in their own directory where that is possible.

Where that directory is gone, or cannot be written any more (a file system that has become read-only), another one serves: for a
file without a name only the content counts, not the place.
"""

from __future__ import annotations

import os
import secrets
import stat
from typing import Final

from checkpoint.errors import RestoreError
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable

OTHER_PLACES: Final = ("/var/tmp", "/tmp", "/dev/shm")
O_PATH: Final = 0o10000000
AT_REMOVEDIR: Final = 0x200
NAME_MAX: Final = 50
"""Characters of its own name that another one begins with: a file system takes 255 bytes."""


def make_file(table: CallTable, path: str, mode: int, *, was_born_so: bool = False) -> int:
    """Make an empty regular file: a descriptor that reads and writes.

    Args:
        was_born_so: it never had a name (O_TMPFILE), and may be given one.
    """
    directory = os.path.dirname(path)
    if was_born_so and os.access(directory, os.W_OK):
        return table.open(directory, os.O_TMPFILE | os.O_RDWR, mode)
    name = _name_for(path)
    made = table.open(name, os.O_CREAT | os.O_EXCL | os.O_RDWR, mode)
    table.call(f"unlink {name}", "unlinkat", AT_FDCWD, table.place_path(name), 0)
    return made


def make_node(table: CallTable, path: str, mode: int, rdev: int = 0) -> int:
    """Make a named pipe or device: a descriptor that leads to it (O_PATH), and opens nothing.

    Args:
        mode: its type included.
    """
    name = _name_for(path)
    place = table.place_path(name)
    table.call(f"make {name}", "mknodat", AT_FDCWD, place, mode, _encoded(rdev))
    made = table.open(name, O_PATH | os.O_NOFOLLOW)
    set_mode(table, made, f"the mode of {name}", mode)
    table.call(f"unlink {name}", "unlinkat", AT_FDCWD, place, 0)
    return made


def make_directory(table: CallTable, path: str, mode: int) -> int:
    """Make a directory: a descriptor that leads to it (O_PATH)."""
    name = _name_for(path)
    place = table.place_path(name)
    table.call(f"make the directory {name}", "mkdirat", AT_FDCWD, place, stat.S_IMODE(mode))
    made = table.open(name, O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW)
    set_mode(table, made, f"the mode of {name}", mode)
    table.call(f"remove the directory {name}", "unlinkat", AT_FDCWD, place, AT_REMOVEDIR)
    return made


def make_link(table: CallTable, path: str, target: str) -> int:
    """Make a symbolic link: a descriptor that leads to it itself (O_PATH)."""
    name = _name_for(path)
    place = table.place_path(name)
    table.call(f"make the link {name}", "symlinkat", table.place_path(target), AT_FDCWD, place)
    made = table.open(name, O_PATH | os.O_NOFOLLOW)
    table.call(f"unlink {name}", "unlinkat", AT_FDCWD, place, 0)
    return made


def set_mode(table: CallTable, made: int, what: str, mode: int) -> None:
    """Give what a descriptor leads to (O_PATH) its mode, from which the umask took: by name it could be another's by now."""
    table.call(f"set {what}", "fchmodat", AT_FDCWD, table.place_path(f"/proc/self/fd/{made}"), stat.S_IMODE(mode))


def _name_for(path: str) -> str:
    """A name that is free: its own, or one like it.

    Raises:
        RestoreError: no directory takes it.
    """
    directory, own = os.path.split(path)
    for place in (directory, *OTHER_PLACES):
        if os.path.isdir(place) and os.access(place, os.W_OK):
            name = os.path.join(place, own)
            return f"{os.path.join(place, own[:NAME_MAX])}.{secrets.token_hex(6)}" if os.path.lexists(name) else name
    raise RestoreError(f"cannot make {path} again, which has no name: no directory takes it; make {OTHER_PLACES[0]} writable")


def _encoded(rdev: int) -> int:
    """As mknod(2) takes it: new_encode_dev() of linux/kdev_t.h."""
    major, minor = os.major(rdev), os.minor(rdev)
    return minor & 0xFF | major << 8 | (minor & ~0xFF) << 12
