"""The connection to the agent: one that hangs is not waited for."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from failover.errors import LostAgentError, NoAgentError
from page.agent_link import ask_once
from page.feeds import Feed


def test_an_agent_that_takes_the_question_and_does_not_answer_is_lost_after_a_while(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    async def run() -> None:
        hangs = asyncio.Event()

        async def take(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await hangs.wait()
            writer.close()

        server = await asyncio.start_unix_server(take, str(path))
        with pytest.raises(LostAgentError, match="has not answered status within 0 s: it hangs"):
            await ask_once(path, "status", within_s=0.05)
        hangs.set()
        server.close()

    asyncio.run(run())
    path.unlink(missing_ok=True)
    with pytest.raises(NoAgentError):
        asyncio.run(ask_once(path, "status"))


def test_a_picture_that_gets_old_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1000.0
    monkeypatch.setattr("page.feeds.time.monotonic", lambda: now_s)
    feed = Feed(None)
    feed.show({"team": {"away": ""}})
    assert feed.old_s() == 0
    now_s += 7
    feed.show_away("the agent has ended")
    assert feed.old_s() == 7, "what is shown is as old as before"
    feed.show({"team": {"away": ""}})
    assert feed.old_s() == 0
