"""Who is asked how things stand there."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from agent.questions import Lines, Questions


class Errands:
    """Peers that answer with their own picture."""

    async def send(self, peer: str, _question: str, _arguments: dict[str, Any], *, patience_s: float) -> dict[str, Any]:
        assert patience_s > 0
        return {"components": [{"name": "/team/one", "role": f"as {peer} sees it"}]}


class Team:
    """What the questions need of the rest: peers in all states, one of which has no bulk lane."""

    errands = Errands()

    async def ask(self, _what: str) -> None:
        pass

    def hindrance(self, peer: str) -> str:
        return "no lane" if peer == "cut" else ""

    def picture(self, _told: None) -> dict[str, Any]:
        states = {"well": "live", "cut": "live", "late": "suspect", "gone": "dead", "never": "unknown"}
        peers = [{"name": name, "state": state} for name, state in states.items()]
        return {"peers": peers, "components": [{"name": "/team/one"}]}


def test_a_robot_whose_last_beats_are_late_is_asked_as_one_that_lives() -> None:
    async def said(_frame: Any) -> None: ...

    questions = Questions(cast(Lines, Team()))
    picture = asyncio.run(questions.table()["status"](cast(Any, said), {"team": True}))
    (component,) = picture["components"]
    assert {peer: one["role"] for peer, one in component["elsewhere"].items()} == {
        "well": "as well sees it",
        "late": "as late sees it",
    }
