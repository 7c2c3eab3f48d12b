"""Items that programs added with ``keep = true``: written to ``board.toml`` of the state directory, added again after a reboot.

Programs add items without the agent: it looks at the files of the board once a second. An item that is added in the last second
before a power cut may be lost.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import tomllib
from pathlib import Path
from typing import Final

import msgspec
from msgspec.structs import replace

from checkpoint.errors import UNDECODABLE
from checkpoint.store.whole_file import write_whole
from failover.boards.directory import OWN_NAME, PRIVATE_NAME
from failover.config.board import BoardConfig, as_toml, board_of
from failover.core.board import layout
from failover.core.board.announcements import item_of
from failover.core.board.items import BLOCK_SIZE_MAX, Board, Item
from failover.core.board.layout import ADDED, KEPT
from failover.errors import FailoverError

FILE_NAME: Final = "board.toml"
BEFORE_NAME: Final = "board.toml.before"
"""As the file was before the agent, after its start, left items out for the first time: they had no room, or were not read."""
LOOK_S: Final = 1.0
HEADING: Final = (
    "# Items that programs of this robot added with keep = true. The agent writes this file, and reads it after a reboot.\n\n"
)

log = logging.getLogger("failover.lanes")


def read(state: Path) -> tuple[Item, ...]:
    """The items that were kept; none, with a line in the log, where the file cannot be read."""
    path = state / FILE_NAME
    try:
        table = tomllib.loads(path.read_text()).get("board", {})
        items = board_of(msgspec.convert(table, BoardConfig), lambda keys: f"{path}: {'.'.join(keys)}").items
    except FileNotFoundError:
        return ()
    except (OSError, *UNDECODABLE, FailoverError) as error:
        log.warning("items that were to be kept over a reboot are not added: %s: %s", path, error)
        return ()
    return tuple(replace(item, keep=True) for item in items)


def write(state: Path, items: tuple[Item, ...]) -> None:
    """Keep these items, and no others. The file is whole at any instant.

    Raises:
        OSError: it cannot be written.
    """
    write_whole(state / FILE_NAME, (HEADING + as_toml(Board(items))).encode(), mode=0o666)


def found_in(place: Path) -> tuple[Item, ...]:
    """The items of a board's own and private file that are to be kept, in the order in which they were added.

    Raises:
        BoardError, OSError: a file cannot be read.
    """
    items = []
    for name, shared in ((OWN_NAME, True), (PRIVATE_NAME, False)):
        with (place / name).open("rb") as file:
            content = file.read(BLOCK_SIZE_MAX)
        for record in layout.read_records(content, layout.read_header(content)):
            if record.flags & (KEPT | ADDED) == KEPT | ADDED:
                items.append(item_of(record, shared=shared))
    return tuple(items)


def _names(items: tuple[Item, ...]) -> set[str]:
    return {item.name for item in items}


def _keep_before(state: Path) -> None:
    """Keep the file as it is beside the one that will be written."""
    before = state / BEFORE_NAME
    before.unlink(missing_ok=True)
    with contextlib.suppress(FileNotFoundError):  # there is none yet
        os.link(state / FILE_NAME, before)


class Keeper:
    """Writes the file whenever other items are to be kept."""

    def __init__(self, place: Path, state: Path) -> None:
        self._place, self._state = place, state
        self._kept = read(state)
        self._generations: tuple[bytes, ...] = ()
        self._has_written = False
        self._told = ""

    async def watch(self) -> None:
        """Look once a second, for as long as the agent lives."""
        while True:
            await asyncio.sleep(LOOK_S)
            if self._now() != self._generations:
                await asyncio.to_thread(self.look)

    def look(self) -> None:
        """Write what is to be kept now, if it is something else than before. What fails is tried again at the next look."""
        generations = self._now()
        try:
            items = found_in(self._place)
            if items != self._kept:
                if not self._has_written and not (self._kept and _names(self._kept) <= _names(items)):
                    _keep_before(self._state)
                write(self._state, items)
                self._has_written = True
        except (FailoverError, OSError) as error:
            if str(error) != self._told:
                self._told = str(error)
                log.warning("items to be kept over a reboot are not written to %s: %s", self._state / FILE_NAME, error)
        else:
            self._kept, self._generations, self._told = items, generations, ""

    def _now(self) -> tuple[bytes, ...]:
        found = []
        for name in (OWN_NAME, PRIVATE_NAME):
            with contextlib.suppress(OSError), (self._place / name).open("rb") as file:
                found.append(os.pread(file.fileno(), 8, layout.GENERATION_AT))
        return tuple(found)
