"""Looks beside the agent, and clients that look: one look at a time, and none for what is not wanted any more."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path
from typing import Any

import pytest

from page.feeds import Feed, Feeds
from page.sessions import Session
from page.surroundings import Around
from page.viewers import People, Viewer

NOWHERE = Path("/nowhere/control.sock")


class Slow:
    """A look that lasts until it is let go."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.go = threading.Event()
        self.at_once = self.most = 0

    def look(self, _status: Any) -> Around:
        self.at_once += 1
        self.most = max(self.most, self.at_once)
        self.begun.set()
        self.go.wait()
        self.at_once -= 1
        return Around()

    def close(self) -> None:
        """Nothing is open."""


def test_a_look_whose_client_has_gone_is_waited_for_by_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        feeds, slow = Feeds(NOWHERE), Slow()
        monkeypatch.setattr(feeds, "_surroundings", slow)
        monkeypatch.setattr(feeds, "_own_view", lambda: asyncio.sleep(0))
        first = asyncio.create_task(feeds.around())
        await asyncio.to_thread(slow.begun.wait)
        first.cancel()
        second = asyncio.create_task(feeds.around())
        for _ in range(100):
            await asyncio.sleep(0)
        assert not first.done() and slow.at_once == 1
        slow.go.set()
        await asyncio.gather(first, second, return_exceptions=True)
        assert first.cancelled() and second.result() == Around() and slow.most == 1

    asyncio.run(run())


def test_a_mistake_of_the_page_ends_no_picture(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        feeds, wake = Feeds(NOWHERE), asyncio.Event()
        monkeypatch.setattr("page.feeds.AgentLink", None)  # it has no open: using it is the mistake
        feed = feeds.take(None, wake)
        await wake.wait()
        assert feed.table["team"]["away"] == "a mistake in the page; see its log"
        monkeypatch.undo()
        while "cannot reach the agent" not in feed.table["team"]["away"]:
            wake.clear()
            await wake.wait()
        await feeds.close()

    asyncio.run(run())
    assert "a mistake in the page" in caplog.text


def test_of_many_rows_that_a_client_looks_at_quickly_the_last_one_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[str] = []

    async def run() -> None:
        viewer = Viewer(Session("anna", None), Feed(None), People(Feeds(NOWHERE)), asyncio.Event(), NOWHERE)
        said = iter(range(30))

        async def look_at(key: str) -> None:
            looked.append(key)

        async def receive() -> str:
            number = next(said, None)
            if number is None:
                await asyncio.Event().wait()
            elif number == 1:
                while not looked:
                    await asyncio.sleep(0)
            await asyncio.sleep(0)
            return json.dumps({"look": f"component:{number}"})

        monkeypatch.setattr(viewer, "_look_at", look_at)
        listening = asyncio.create_task(viewer.listen(receive))
        while "component:29" not in looked:
            await asyncio.sleep(0.01)
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)
        await viewer.close()

    asyncio.run(run())
    assert looked[-1] == "component:29" and len(looked) < 10, looked


def test_a_client_that_reads_slowly_gets_the_newest_story_alone() -> None:
    viewer = Viewer(Session("anna", None), Feed(None), People(Feeds(NOWHERE)), asyncio.Event(), NOWHERE)
    for number in range(9):
        viewer._tell("story", {"name": str(number)})
    assert [message["story"]["name"] for message in viewer._news() if "story" in message] == ["8"]
