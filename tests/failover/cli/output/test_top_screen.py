"""The full screen by itself: what others wrote is text on it, neither markup nor an order to the terminal."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("textual")

from textual.widgets import DataTable, Static
from textual.widgets._toast import Toast

from failover.cli.output import task_tree
from failover.cli.output.top_screen import Picture, Story, Top
from failover.errors import AgentRefusedError
from tests.failover.cli.output.test_task_tree import STATUS

HOSTILE = "[/red] \x1b]0;mine\x07 \x9b2J [@click=quit]"
HARMLESS = r"[/red] \x1b]0;mine\x07 \x9b2J [@click=quit]"
WAITS = 300
"""Looks at the screen, a tenth of a second apart."""


class Source:
    """An agent whose every word is hostile."""

    def pictures(self) -> Iterator[Picture]:
        known: dict[str, Any] = dict(STATUS)
        components = [{**one, "notes": [HOSTILE], "reasons": [HOSTILE]} for one in known["components"]]
        status: dict[str, Any] = {"team": HOSTILE, **known, "components": components, "promise": HOSTILE}
        status["peers"] = [{**peer, "lane": HOSTILE} for peer in known["peers"]]
        yield Picture(status, task_tree.robots("robot1", (), status, {}))
        time.sleep(1)

    def story(self, component: str) -> str:
        return HOSTILE

    def order(self, verb: str, component: str, epoch: int) -> str:
        if verb == "stop":
            raise AgentRefusedError(HOSTILE)
        return HOSTILE


def test_what_others_wrote_is_text_on_the_screen() -> None:
    async def look() -> None:
        app = Top(Source())
        async with app.run_test(size=(120, 40), notifications=True) as pilot:
            table = app.query_one(DataTable)
            for _ in range(WAITS):
                if table.row_count:
                    break
                await pilot.pause(0.1)
            table.move_cursor(row=1)
            for key in ("h", "x"):
                await pilot.press(key, "y")
                await pilot.pause(0.3)
            assert HARMLESS in "".join(str(toast.render()) for toast in app.screen.query(Toast))
            texts = [str(one.content) for one in app.screen.query(Static)]
            texts += [str(cell) for row in range(table.row_count) for cell in table.get_row_at(row)]
            await pilot.press("enter")
            for _ in range(WAITS):
                if isinstance(app.screen, Story):
                    break
                await pilot.pause(0.1)
            texts += [str(one.content) for one in app.screen.query(Static)]
            assert sum(HARMLESS in text for text in texts) >= 3, texts
            assert not [text for text in texts if "\x1b" in text or "\x9b" in text]

    asyncio.run(look())
