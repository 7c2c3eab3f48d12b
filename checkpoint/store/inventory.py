"""The content of a store's folders as an opening finds it: leftovers go, every file is verified, only intact ones are used."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from checkpoint.errors import FormatError
from checkpoint.snapshot import format
from checkpoint.snapshot.validity import place
from checkpoint.store.atomic_files import TEMPORARY_PREFIX, WholeFiles
from checkpoint.store.index import FOLDER_PREFIX, SUFFIXES, Entry, file_name, folder_name


def intact_files(root: Path, files: WholeFiles, notice: Callable[[str], None]) -> Iterator[tuple[str, Entry]]:
    """Every intact snapshot, with the component that it is of.

    Args:
        notice: gets a sentence for each file that is not used, and for each leftover.

    Raises:
        OSError: a folder cannot be read.
    """
    for folder in sorted(root.iterdir()):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.name.startswith(TEMPORARY_PREFIX):
                files.remove(path)
                notice(f"{path} had not arrived whole and was removed")
            elif folder.name.startswith(FOLDER_PREFIX) and path.suffix in SUFFIXES:
                yield from _intact(path, files, notice)


def _intact(path: Path, files: WholeFiles, notice: Callable[[str], None]) -> Iterator[tuple[str, Entry]]:
    """The one file, if it is."""
    if why := why_not_ours(path.lstat()):
        notice(f"{path}: {why}; it is not used")
        return
    try:
        header = format.verify(path)
    except FormatError as error:
        files.set_out_of_use(path)
        notice(f"{error}; it is not used")
        return
    if (path.parent.name, path.name) != (folder_name(header.component), file_name(header)):
        notice(f"{path} holds {place(header.position)} of {header.component}, which is not its name; it is not used")
        return
    stored = path.stat()
    told = (header.position, header.parent, header.epoch, stored.st_size, stored.st_mtime, header.contents_size)
    yield header.component, Entry(path, *told)


def why_not_ours(about: os.stat_result) -> str:
    """Why a file or folder of a store may be another user's word; "" if it is ours or root's alone.

    A restore gives a program the rights that its snapshot says.
    """
    if about.st_uid not in (os.geteuid(), 0):
        return f"it belongs to uid {about.st_uid}"
    if stat.S_ISLNK(about.st_mode):
        return "it is a symbolic link"
    return f"others may write to it (mode {stat.S_IMODE(about.st_mode):o})" if about.st_mode & 0o022 else ""
