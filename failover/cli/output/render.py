"""Drawing on a terminal or into a pipe (the only rich import, loaded when something is drawn in colour)."""

from __future__ import annotations

import codecs
import json
import re
import sys
import textwrap
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from checkpoint.sentences import visible
from failover.cli.output import team_tree

if TYPE_CHECKING:
    from rich.console import Console

COLOURS: Final = {"good": "green", "warning": "yellow", "bad": "bold red", "quiet": "dim"}

PICTURE_WIDTH: Final = 108
"""Columns of a terminal that is saved as a picture."""

GAP: Final = "  "
"""Between two columns of a plain table."""

BORDER: Final = 1
PADDING: Final = 2
"""Columns that a framed table takes besides its cells: one on each side of every cell, and its lines."""

BRANCHES: Final = "├└│─`|- "
BELOW: Final = str.maketrans({"├": "│", "└": " ", "─": " ", "`": " ", "-": " "})
"""What stands before a row in a tree, and what stands below that."""
STACKED_INDENT: Final = 3

ASCII: Final = str.maketrans({"└": "`", "├": "|", "─": "-", "–": "-", "…": "~"})
"""For a terminal or a file that is not in UTF-8."""


def spoken(text: str) -> str:
    """The text in characters that standard output has, and without orders to a terminal."""
    text = visible(text)
    encoding = codecs.lookup(getattr(sys.stdout, "encoding", None) or "ascii").name
    return text if encoding.startswith("utf") else text.translate(ASCII).encode(encoding, "replace").decode(encoding)


def room() -> int:
    """Columns of the terminal; as many as are wanted where no person looks."""
    return _console().width if is_terminal() else sys.maxsize


def is_terminal() -> bool:
    """Whether standard output is looked at by a person."""
    return sys.stdout.isatty()


def json_text(value: Any) -> str:
    """One JSON object on one line; bytes as hexadecimal."""
    return json.dumps(
        value, ensure_ascii=False, default=lambda odd: odd.hex() if isinstance(odd, bytes | bytearray) else str(odd)
    )


def as_json(value: Any) -> None:
    """Print one JSON object on a line of its own, at once."""
    print(json_text(value), flush=True)


def plain_table(columns: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Columns aligned by spaces; a column that is empty throughout is left out."""
    cells = [tuple(columns), *(tuple(line) for line in lines)]
    kept = [index for index in range(len(columns)) if any(line[index] for line in cells[1:])]
    widths = {index: max(width_of(line[index]) for line in cells) for index in kept}
    return "\n".join(GAP.join(_padded(line[index], widths[index]) for index in kept).rstrip() for line in cells)


def width_of(text: str) -> int:
    """Columns that a text takes on a terminal: East Asian characters take two, combining ones none."""
    if text.isascii():
        return len(text)
    return sum(0 if unicodedata.combining(one) else 2 if unicodedata.east_asian_width(one) in "WF" else 1 for one in text)


def _padded(text: str, width: int) -> str:
    return text + " " * (width - width_of(text))


def table(columns: Sequence[str], lines: Sequence[Sequence[str]], title: str = "") -> None:
    """Print a table: framed on a terminal, aligned elsewhere."""
    lines = [tuple(map(spoken, line)) for line in lines]
    if is_terminal():
        console = _console()
        console.print(_drawn(console.width, columns, [(line, "") for line in lines], title))
        return
    if title:
        print(title)
    print(plain_table(columns, lines))


def painted(columns: Sequence[str], rows: Sequence[team_tree.Row], title: str) -> None:
    """Print a table whose lines have moods: framed and coloured on a terminal, aligned elsewhere."""
    if is_terminal():
        _console().print(_painted(columns, rows, title))
    else:
        print(spoken(f"{title}\n{plain_table(columns, [row.cells for row in rows])}"), flush=True)


def _painted(columns: Sequence[str], rows: Sequence[team_tree.Row], title: str) -> Any:
    lines = [(tuple(map(spoken, row.cells)), COLOURS[row.mood]) for row in rows]
    return _drawn(_console().width, columns, lines, spoken(title))


@contextmanager
def live_table() -> Iterator[Callable[[Sequence[str], Sequence[team_tree.Row], str], None]]:
    """As `painted`, again and again: in place on a terminal, one below the other elsewhere. Ctrl-C ends the body quietly."""
    with suppress(KeyboardInterrupt):
        if not is_terminal():
            yield painted
            return
        from rich.live import Live

        with Live(console=_console(), auto_refresh=False) as live:
            yield lambda columns, rows, title: live.update(_painted(columns, rows, title), refresh=True)


def tree(status: dict[str, Any]) -> None:
    """Print the team once."""
    if is_terminal():
        _console().print(_rich_tree(status))
    else:
        print(spoken(plain_tree(status)))


def plain_tree(status: dict[str, Any]) -> str:
    """The team as aligned text."""
    lines = [plain_table(team_tree.COLUMNS, [row.cells for row in team_tree.rows(status)])]
    lines += team_tree.promises(status)
    lines += team_tree.kept(status)
    lines += team_tree.memory(status)
    lines += team_tree.ready_copies(status)
    if status.get("fencing"):
        lines.append(f"fencing: {status['fencing']}")
    if status.get("rights"):
        lines.append(f"rights: {status['rights']}")
    return "\n".join([*lines, *(f"note: {line}" for line in team_tree.remarks(status))])


def live_tree() -> AbstractContextManager[Callable[[dict[str, Any]], None]]:
    """A picture that is drawn again and again: in place on a terminal, one below the other elsewhere."""
    if is_terminal():
        return _LiveTree()
    return nullcontext(lambda status: print(spoken(plain_tree(status)), end="\n\n", flush=True))


class _LiveTree:
    """The team, redrawn in place."""

    def __enter__(self) -> Callable[[dict[str, Any]], None]:
        from rich.live import Live

        self._live = Live(console=_console(), auto_refresh=False)
        self._live.__enter__()
        return lambda status: self._live.update(_rich_tree(status), refresh=True)

    def __exit__(self, *reason: Any) -> None:
        self._live.__exit__(*reason)


class LiveBoard:
    """A table and a progress bar that are redrawn in place, with lines of text that scroll above them. For terminals."""

    def __enter__(self) -> LiveBoard:
        from rich.live import Live

        self._live = Live(console=_console(), auto_refresh=False, transient=True)
        self._live.__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._live.__exit__(*reason)

    def say(self, text: str) -> None:
        """Let a line scroll by above the table."""
        self._live.console.print(text, markup=False)

    def draw(self, columns: Sequence[str], lines: Sequence[Sequence[str]], share: float, caption: str) -> None:
        """Redraw; ``share`` is the part of the whole that is done, 0 to 1."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        bar = Table.grid(padding=(0, 1))
        bar.add_row(ProgressBar(total=1.0, completed=min(share, 1.0), width=40), f"{min(share, 1.0):4.0%}", caption)
        self._live.update(Group(_drawn(self._live.console.width, columns, [(line, "") for line in lines]), bar), refresh=True)


def save_picture(path: str, command: str, lines: Sequence[str], columns: Sequence[str], cells: Sequence[Sequence[str]]) -> None:
    """Write the content of a terminal, some lines and a table, as an SVG picture."""
    import io

    from rich.console import Console
    from rich.text import Text

    console = Console(record=True, file=io.StringIO(), width=PICTURE_WIDTH, force_terminal=True, highlight=False)
    console.print(Text(f"$ {command}", style="bold"))
    for line in lines:
        console.print(Text(line))
    console.print(_drawn(console.width, columns, [(line, "") for line in cells]))
    picture_text = re.sub(r"@font-face \{.*?\}\s*", "", console.export_svg(title=command), flags=re.DOTALL)  # no fonts from afar
    Path(path).write_text(picture_text)


def _console() -> Console:
    from rich.console import Console

    return Console(highlight=False)


def _rich_tree(status: dict[str, Any]) -> Any:
    from rich.console import Group
    from rich.text import Text

    lines = [(tuple(map(spoken, row.cells)), COLOURS[row.mood]) for row in team_tree.rows(status)]
    parts = [_drawn(_console().width, team_tree.COLUMNS, lines, f"team {status.get('team') or ''}".strip())]
    parts += [Text(spoken(line), style="bold") for line in team_tree.promises(status)]
    parts += [Text(spoken(line)) for line in team_tree.kept(status)]
    parts += [Text(spoken(line), style="dim") for line in (*team_tree.memory(status), *team_tree.ready_copies(status))]
    if status.get("fencing"):
        parts.append(Text(spoken(f"fencing: {status['fencing']}"), style="dim"))
    if status.get("rights"):
        parts.append(Text(spoken(f"rights: {status['rights']}"), style="dim"))
    return Group(*parts, *(Text(spoken(line), style="yellow") for line in team_tree.remarks(status)))


def _drawn(width: int, columns: Sequence[str], lines: Sequence[tuple[Sequence[str], str]], title: str = "") -> Any:
    """A framed table whose cells break between words only; row below row where not even the words fit. Nothing is cut off."""
    from rich import box
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    kept = [index for index in range(len(columns)) if any(line[index] for line, _ in lines)]
    cells = [[columns[index], *(line[index] for line, _ in lines)] for index in kept]
    widths = _widths(cells, width - BORDER - (BORDER + PADDING) * len(kept))
    if widths is None:
        told = [Text(told, style=style) for line, style in lines for told in _stacked(columns, line, width)]
        return Group(*([Text(title, style="italic")] if title else []), *told)
    drawn = Table(title=title or None, title_justify="left", box=box.ROUNDED, border_style="dim", header_style="bold")
    for index, column_width in zip(kept, widths, strict=True):
        drawn.add_column(columns[index], width=column_width, overflow="fold")
    for line, style in lines:
        drawn.add_row(*(Text(line[index], style=style) for index in kept))
    return drawn


def _widths(cells: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """Of each column, so that all fit: the widest give way first, down to their longest word; the first column, a name, never.

    None where that is not enough.
    """
    widths = [max(map(width_of, column)) for column in cells]
    least = [max((width_of(word) for cell in column for word in cell.split()), default=0) for column in cells]
    least[:1] = widths[:1]
    while sum(widths) > room:
        able = [index for index, wide in enumerate(widths) if wide > least[index]]
        if not able:
            return None
        widths[max(able, key=widths.__getitem__)] -= 1
    return widths


def _stacked(columns: Sequence[str], cells: Sequence[str], width: int) -> list[str]:
    """One row for a narrow terminal: its name, and below it, inside the lines of a tree, the known values with their columns."""
    told = ", ".join(f"{column} {cell}".strip() for column, cell in zip(columns[1:], cells[1:], strict=True) if cell.strip(" -–"))
    branch = cells[0][: len(cells[0]) - len(cells[0].lstrip(BRANCHES))]
    below = branch.translate(BELOW) + " " * (STACKED_INDENT if branch else 2 * STACKED_INDENT - 1)
    return [cells[0], *textwrap.wrap(told, max(width, width_of(below) + 1), initial_indent=below, subsequent_indent=below)]
