"""Queries: which robots are asked for their state, and which users see a program's output there."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from agent.worker.control.queries import Lines, Questions
from failover.core.event_log.decisions import SAID

OWNER: Final = 7001
WORDS: Final = "password: swordfish"


class Errands:
    """Peers that answer with their own picture."""

    async def send(self, peer: str, _question: str, _arguments: dict[str, Any], *, patience_s: float) -> dict[str, Any]:
        assert patience_s > 0
        one = {
            "name": "/team/one",
            "role": f"as {peer} sees it",
            "owner": OWNER,
            "cold": f"it ended with exit code 3{SAID}{WORDS}",
        }
        return {"components": [one]}


class Team:
    """What the questions need of the rest: peers in all states, one of which has no replication link."""

    errands = Errands()

    async def ask(self, _what: str) -> None:
        pass

    def hindrance(self, peer: str) -> str:
        return "no lane" if peer == "cut" else ""

    def picture(self, _told: None) -> dict[str, Any]:
        states = {"well": "live", "cut": "live", "late": "suspect", "gone": "dead", "never": "unknown"}
        peers = [{"name": name, "state": state} for name, state in states.items()]
        notes = [f"it did not take its state{SAID}{WORDS}", "nothing to hide"]
        return {"peers": peers, "components": [{"name": "/team/one", "owner": OWNER, "notes": notes}]}


def asked_by(uid: int) -> dict[str, Any]:
    """The component as a user's `failover status` shows it."""
    client = SimpleNamespace(caller=SimpleNamespace(uid=uid))
    questions = Questions(cast(Lines, Team()))
    picture = asyncio.run(questions.table()["status"](cast(Any, client), {"team": True}))
    (component,) = picture["components"]
    return dict(component)


def test_a_robot_whose_last_beats_are_late_is_asked_as_one_that_lives() -> None:
    assert {peer: one["role"] for peer, one in asked_by(0)["elsewhere"].items()} == {
        "well": "as well sees it",
        "late": "as late sees it",
    }


@pytest.mark.parametrize(("uid", "may_read"), [(0, True), (OWNER, True), (7002, False)])
def test_what_a_program_wrote_last_is_shown_in_the_status_to_its_owner_and_root_alone(uid: int, may_read: bool) -> None:
    shown = asked_by(uid)
    assert (WORDS in str(shown)) is may_read
    assert (WORDS in str(shown["elsewhere"])) is may_read
    assert shown["notes"][1] == "nothing to hide"
    assert shown["notes"][0].startswith("it did not take its state; ")
