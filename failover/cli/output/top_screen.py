"""The full screen of ``failover top`` (the only textual import; it comes with the extra ``tui``)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, Final, Literal, Protocol

from msgspec import Struct
from rich.text import Text
from textual import on, work
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.coordinate import Coordinate
from textual.screen import ModalScreen
from textual.widgets import DataTable, Footer, Input, Static
from textual.worker import get_current_worker

from checkpoint.sentences import visible
from failover.cli.output import team_tree
from failover.cli.output.task_tree import Robot
from failover.cli.output.top_table import COLUMNS, ORDERS, Line, lines
from failover.client.health import sight
from failover.errors import FailoverError

COLOURS: Final = {"good": "green", "warning": "yellow", "bad": "bold red", "quiet": "dim"}

RETRY_S: Final = 1.0
"""Between two tries to reach an agent that has gone."""


class Picture(Struct, frozen=True):
    """What is shown. ``status``: see `failover.client.control.STATUS`; ``robots``: with their components and tasks."""

    status: dict[str, Any]
    robots: tuple[Robot, ...]


class Source(Protocol):
    """Where the screen has it from. Called in threads of their own.

    Raises (all methods): FailoverError.
    """

    def pictures(self) -> Iterator[Picture]: ...
    def story(self, component: str) -> str: ...
    def order(self, verb: str, component: str, epoch: int) -> str: ...


class Story(ModalScreen[None]):
    """What was decided about one component, and why."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,enter", "dismiss", "back")]

    def __init__(self, title: str, text: str) -> None:
        super().__init__()
        self._title, self._text = title, text

    def compose(self) -> ComposeResult:
        with VerticalScroll(id="story"):
            yield Static(shown(self._title, "bold"))
            yield Static(shown(self._text), id="told")


class Question(ModalScreen[bool]):
    """Whether an order is meant."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("y", "dismiss(True)", "yes"), Binding("n,escape", "dismiss(False)", "no")]

    def __init__(self, text: str) -> None:
        super().__init__()
        self._text = text

    def compose(self) -> ComposeResult:
        yield Static(shown(f"{self._text}\n\ny: yes   n: no"), id="question")


class Top(App[None]):
    """Robots, components, tasks and notes, live."""

    CSS: ClassVar[str] = """
    #head { height: auto; max-height: 3; }
    #filter { display: none; height: 3; }
    #filter.asked { display: block; }
    #table { height: 1fr; }
    #notes { height: auto; max-height: 30%; }
    #story { margin: 1 2; background: $surface; }
    Question { align: center middle; }
    #question { width: 80%; max-width: 90; height: auto; padding: 1 2; border: round $warning; background: $surface; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter", "story", "why", priority=False),
        Binding("slash", "filter", "filter"),
        Binding("s", "sort", "sort"),
        Binding("h", "order('handover')", "hand over"),
        Binding("b", "order('failback')", "back"),
        Binding("x", "order('stop')", "stop"),
        Binding("escape", "clear", "all", show=False),
        Binding("q", "quit", "quit"),
    ]
    ENABLE_COMMAND_PALETTE = False

    def __init__(self, source: Source) -> None:
        super().__init__()
        self._source = source
        self._picture: Picture | None = None
        self._order, self._wanted = ORDERS[0], ""
        self._lines: list[Line] = []

    def compose(self) -> ComposeResult:
        yield Static("asking the agent …", id="head")
        yield Input(placeholder="part of a name or a state", id="filter")
        yield DataTable(id="table", cursor_type="row")
        with VerticalScroll(id="notes", can_focus=False):
            yield Static("", id="remarks")
        yield Footer()

    def on_mount(self) -> None:
        """Begin to look."""
        self._table.add_columns(*COLUMNS)
        self._table.focus()
        self._look()

    @property
    def _table(self) -> DataTable[Text]:
        return self.query_one("#table", DataTable)

    @work(thread=True, exclusive=True, group="look")
    def _look(self) -> None:
        """Show picture after picture; an agent that goes away is waited for."""
        worker = get_current_worker()
        while not worker.is_cancelled:
            try:
                for picture in self._source.pictures():
                    if worker.is_cancelled:
                        return
                    self.call_from_thread(self._take, picture)
            except FailoverError as error:
                self.call_from_thread(self._head, f"{error}", "bold red")
            time.sleep(RETRY_S)

    # --- what is shown ---

    def _take(self, picture: Picture) -> None:
        self._picture = picture
        self._draw()

    def _draw(self) -> None:
        if (picture := self._picture) is None:
            return
        status = picture.status
        how = f", sorted by {self._order}" + (f", only {self._wanted!r}" if self._wanted else "")
        is_well = team_tree.is_healthy(status)
        head = f"{'healthy' if is_well else 'DEGRADED'}: team {status['team']}, at {status['robot']}{how}"
        self._head(f"{head}. {status.get('promise') or ''}", "green" if is_well else "bold yellow")
        self.query_one("#remarks", Static).update(shown("\n".join(team_tree.remarks(status)), "yellow"))
        self._fill(lines(picture.robots, status, self._order, self._wanted))

    def _head(self, text: str, style: str) -> None:
        self.query_one("#head", Static).update(shown(text, style))

    def _fill(self, found: list[Line]) -> None:
        """Change what is another; the cursor stays where it was, also when lines come and go above it."""
        table, before = self._table, self._lines
        self._lines = found
        if [line.key for line in before] == [line.key for line in found]:
            for row, (old, new) in enumerate(zip(before, found, strict=True)):
                for column, cell in enumerate(new.cells):
                    if old.cells[column] != cell or old.mood != new.mood:
                        table.update_cell_at(Coordinate(row, column), _cell(cell, new), update_width=True)
            return
        at = before[table.cursor_row].key if before and table.cursor_row < len(before) else ""
        table.clear()
        for line in found:
            table.add_row(*(_cell(cell, line) for cell in line.cells), key=line.key)
        keys = [line.key for line in found]
        if at in keys:
            table.move_cursor(row=keys.index(at))

    def _selected(self) -> str:
        """The component of the line under the cursor; says so where it is of none."""
        row = self._table.cursor_row
        name = self._lines[row].component if row < len(self._lines) else ""
        if not name:
            self.notify("choose a component: the arrows move", severity="warning")
        return name

    # --- keys ---

    @on(DataTable.RowSelected)
    def line_chosen(self) -> None:
        """Enter on a line."""
        self.action_story()

    def action_story(self) -> None:
        """Why the component is where it is."""
        if name := self._selected():
            self._ask(lambda: self._source.story(name), lambda told: self.push_screen(Story(name, told)))

    def action_sort(self) -> None:
        """By the next column."""
        self._order = ORDERS[(ORDERS.index(self._order) + 1) % len(ORDERS)]
        self._draw()

    def action_filter(self) -> None:
        """Ask for a part of a name."""
        field = self.query_one("#filter", Input)
        field.add_class("asked")
        field.focus()

    def on_input_changed(self, event: Input.Changed) -> None:
        """Show what fits so far."""
        self._wanted = event.value.strip()
        self._draw()

    def on_input_submitted(self, _: Input.Submitted) -> None:
        """Back to the table, with what fits."""
        self._leave_filter()

    def action_clear(self) -> None:
        """Everything again."""
        self.query_one("#filter", Input).value = ""
        self._leave_filter()

    def _leave_filter(self) -> None:
        self.query_one("#filter", Input).remove_class("asked")
        self._table.focus()

    def action_order(self, verb: str) -> None:
        """Ask whether it is meant, then give the order, on the epoch that is on the screen."""
        name = self._selected()
        if not name or self._picture is None:
            return
        view = next((sight(one) for one in self._picture.status["components"] if one["name"] == name), {})
        epoch = int(view.get("epoch") or 0)

        def answered(is_meant: bool | None) -> None:
            if is_meant:
                self._ask(lambda: self._source.order(verb, name, epoch), self._say)

        self.push_screen(Question(consequence(verb, view)), answered)

    @work(thread=True)
    def _ask(self, question: Callable[[], str], answered: Callable[[str], object]) -> None:
        """Ask the agent beside the screen, and show its answer."""
        try:
            told = question()
        except FailoverError as error:
            self.call_from_thread(self._say, f"{error}", "error")
        else:
            self.call_from_thread(answered, told)

    def _say(self, text: str, severity: Literal["information", "error"] = "information") -> None:
        self.notify(shown(text).plain, severity=severity, timeout=10, markup=False)


def consequence(verb: str, view: Mapping[str, Any]) -> str:
    """What an order will do, as a question."""
    name, robot, standby = view["name"], view.get("primary") or "no robot", view.get("standby") or "no other robot"
    home = view.get("prefer") or view.get("home") or "where it was started"
    freeze = team_tree.microseconds(view.get("freeze_us"))
    return {
        "handover": f"Hand {name} over from {robot} to {standby}? It stands still for its last snapshot (now {freeze}) and the "
        "restore there.",
        "failback": f"Move {name} from {robot} back to {home}?",
        "stop": f"End the program of {name} at {robot}? No robot runs it again.",
    }[verb]


def _cell(text: str, line: Line) -> Text:
    return shown(text, COLOURS[line.mood])


def shown(text: str, style: str = "") -> Text:
    """As it stands: names and what programs said are no markup, and give the terminal no orders."""
    return Text(visible(text), style=style)


def run(source: Source) -> None:
    """Show it until the user has seen enough."""
    Top(source).run()
