"""The table ``[board]`` of team.toml: read as `failover.core.board.items.Board`, and written.

::

    [board]
    group = "robots"
    [board.items.ball]
    type = { x = "f4", y = "f4", seen = "u4" }
    period = 2
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Final

import msgspec

from failover.errors import FileMistakeError, ItemError

if TYPE_CHECKING:
    from failover.core.board.item_types import Type
    from failover.core.board.items import Board, Item

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_HEADER: Final = re.compile(r"\s*\[\[?\s*(?P<table>[^\]]*?)\s*\]")
_BOARD: Final = re.compile(r"""(?:board|"board"|'board')\s*(?:\.|$)""")


@dataclass(frozen=True, slots=True)
class ItemConfig:
    """One item; the keys are those of `failover.core.board.items.Item`, which checks them."""

    type: str | dict[str, Any] = ""
    size: int = 0
    shared: bool | tuple[str, ...] = True
    period: int = 1
    phase: int = 0
    robots: tuple[str, ...] = ("*",)
    bound_ms: float = 0
    banks: int = 2
    writer: str = ""
    user: str = ""
    transmit: bool = True
    urgent: bool = False
    finite: bool = False


@dataclass(frozen=True, slots=True)
class BoardConfig:
    """The table. ``group``: the Unix group whose members may write the board of their robot; "" leaves it to the agent's user."""

    group: str = ""
    items: dict[str, ItemConfig] = field(default_factory=dict)


def board_of(config: BoardConfig, place: Callable[[tuple[str, ...]], str]) -> Board:
    """The board that a table declares, its items numbered in the order of the file.

    Args:
        place: "file:line: key" of a key, for messages.

    Raises:
        FileMistakeError: an item is not possible; names file, line and cure.
    """
    from failover.core.board.items import Board, Item  # here: a team without a board does not load it

    items = []
    for name, said in config.items.items():
        keys = {key: value for key, value in asdict(said).items() if key != "type"}
        try:
            items.append(Item(name, said.type or None, **keys))
        except ItemError as error:
            at = ("board", "items", name, error.key) if error.key not in ("", "name") else ("board", "items", name)
            raise FileMistakeError(f"{place(at)}: {error}") from error
    try:
        return Board(tuple(items), config.group)
    except ItemError as error:
        raise FileMistakeError(f"{place(('board',))}: {error}") from error


# --- Writing ---------------------------------------------------------------------------------------------------------


def as_toml(board: Board) -> str:
    """The table of a board, each item with the keys that differ from their defaults."""
    lines = ["[board]"] + ([f"group = {_value(board.group)}"] if board.group else [])
    for item in board.items:
        lines += ["", *item_as_toml(item)]
    return "\n".join(lines) + "\n"


def item_as_toml(item: Item) -> list[str]:
    """The lines of one item."""
    from failover.core.board.item_types import Opaque

    kind = item.layout
    lines = [f"[board.items.{_key(item.name)}]"]
    lines += [f'type = "{kind.kind}"', f"size = {kind.size}"] if isinstance(kind, Opaque) else [f"type = {_type(kind)}"]
    for one in fields(ItemConfig):
        said = getattr(item, one.name)
        if one.name not in ("type", "size") and said != one.default:
            lines.append(f"{one.name} = {_value(said)}")
    return lines


def _type(kind: Type) -> str:
    """A type in TOML: a struct as a table, anything else as its text."""
    from failover.core.board.item_types import Record, canonical

    if isinstance(kind, Record):
        return "{ " + ", ".join(f"{_key(name)} = {_type(inner)}" for name, inner in kind.fields) + " }"
    return f'"{canonical(kind)}"'


def _value(said: object) -> str:
    if isinstance(said, str | bool):
        return msgspec.json.encode(said).decode()
    if isinstance(said, tuple):
        return "[" + ", ".join(map(_value, said)) + "]"
    return repr(said)


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else msgspec.json.encode(name).decode()


def text_of_board(text: str) -> str:
    """The lines of a team file that belong to ``[board]``, with the comments right above each of its tables, as they stand."""
    found: list[str] = []
    above: list[str] = []
    inside = False
    for line in text.splitlines():
        header = _HEADER.match(line)
        if header is not None:
            inside = _BOARD.match(header["table"]) is not None
            found += [*above, line] if inside else []
            above = []
        elif not line.strip() or line.lstrip().startswith("#"):
            above.append(line)
        else:
            found += [*above, line] if inside else []
            above = []
    return "\n".join(found).strip("\n") + "\n" if found else ""
