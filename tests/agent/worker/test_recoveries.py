"""What an operator recovered at which site: who is asked, what is told, and answers that are none."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.config import Settings
from agent.errors import AgentError, RefusedError
from agent.main_loop.messages import Told
from agent.worker import recoveries
from agent.worker.network.remote_orders import RECOVERED
from agent.worker.recoveries import Answer, Recoveries, Recovery
from failover.core.events import Event, Recovered, SitesHeard
from failover.core.node import Node
from failover.core.types import COMPONENTS_MAX, MS, SPAN, Config, Record, State, VoteRecord
from tests.agent.worker.test_known_sites import settings

SITES = {"r1": "", "r2": "", "r5": "dock", "r8": "hall", "r9": "hall"}
MAPPER = Recovery("/lab/mapper", SPAN + 1, "r9")


class Lines:
    """The lines of a robot to those of other sites, which give the answers of the test; what its core is told."""

    def __init__(self, settings: Settings, answers: dict[str, Any]) -> None:
        self.settings, self.answers = settings, answers
        self.asked: list[str] = []
        self.events: list[Event] = []
        self.lived_ms = 301

    @property
    def errands(self) -> Any:
        return self

    def hindrance(self, peer: str) -> str:
        return "" if peer in self.answers else "not connected"

    async def send(self, peer: str, verb: str, _arguments: dict[str, Any], patience_s: float = 0) -> dict[str, Any]:
        """As `Errands.send`."""
        assert verb == RECOVERED and patience_s
        self.asked.append(peer)
        if isinstance(self.answers[peer], Exception):
            raise self.answers[peer]
        answer: dict[str, Any] = msgspec.to_builtins(self.answers[peer])
        return answer

    def tell(self, event: Event) -> None:
        self.events.append(event)

    async def ask(self, _what: str) -> Told:
        """As `Switchboard.ask`."""
        ours = (
            Record(MAPPER.component, MAPPER.epoch, "r9", State.STANDBY, begun=True),  # r8 protects it
            Record("/lab/planner", SPAN + 9, "r5", State.STANDBY, begun=True, elsewhere=1),  # recovered at the dock, once ours
            Record("/lab/anew", SPAN + 9, "r9", State.STANDBY, begun=True, elsewhere=-1),  # as well, and released here
            Record("/lab/waits", SPAN, "", State.STANDBY, begun=True),  # recovered here, and not claimed yet
            Record("/lab/own", 3, "r8", State.STANDBY, begun=True),
        )
        node = Node(
            Config("r8", ("r9",), grace_ms=300, site="hall", far={"r1": "", "r2": "", "r5": "dock"}), 1, VoteRecord(ours), 0
        )
        return Told(1, 0, node.status(self.lived_ms * MS))


def heard(lines: Lines, monkeypatch: pytest.MonkeyPatch, *, asked: int) -> list[Event]:
    """Run until so many questions were asked."""
    monkeypatch.setattr(recoveries, "ASK_S", 0.001)
    monkeypatch.setattr(recoveries, "LOOK_S", 0.001)

    async def live() -> None:
        task = asyncio.create_task(Recoveries(lines).run())
        while len(lines.asked) < asked:
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(live())
    return lines.events


def test_each_robot_of_another_site_is_asked_and_one_word_of_each_site_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = Lines(settings(tmp_path, SITES), {"r5": Answer(()), "r9": Answer((MAPPER,))})
    events = heard(lines, monkeypatch, asked=6)
    assert set(lines.asked) == {"r5", "r9"}
    assert Recovered("/lab/mapper", SPAN + 1, "r9") in events[: events.index(SitesHeard())]
    assert events.count(SitesHeard()) == 1


@pytest.mark.parametrize(
    "answer",
    [
        RefusedError("no order 'recovered' can be given from another robot"),
        {"recovered": [{"component": 1}]},
        {"recovered": 7},
        {},
    ],
)
def test_what_is_no_answer_counts_as_none(answer: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Lines(settings(tmp_path, SITES), {"r5": Answer(()), "r8": answer, "r9": answer})
    assert heard(lines, monkeypatch, asked=9) == []


def test_a_robot_that_is_of_no_other_site_is_not_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Lines(settings(tmp_path, SITES), {"r5": Answer(()), "r9": Answer((Recovery("/lab/mapper", SPAN, "r2"),))})
    assert set(map(type, heard(lines, monkeypatch, asked=6))) == {SitesHeard}


def test_a_robot_tells_what_was_recovered_at_its_own_site_and_nothing_else(tmp_path: Path) -> None:
    lines = Lines(settings(tmp_path, SITES, me="r8"), {})
    told = asyncio.run(Recoveries(lines).told())
    assert set(msgspec.convert(told, Answer).recovered) == {MAPPER, Recovery("/lab/waits", SPAN, "r8")}


def test_a_robot_does_not_speak_for_its_site_before_it_has_heard_its_neighbours(tmp_path: Path) -> None:
    lines = Lines(settings(tmp_path, SITES, me="r8"), {})
    lines.lived_ms = 200
    with pytest.raises(AgentError, match="has not heard each robot of its site"):
        asyncio.run(Recoveries(lines).told())


def test_a_robot_speaks_for_the_robots_of_its_own_site_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Lines(settings(tmp_path, SITES), {"r5": Answer((MAPPER,)), "r9": Answer(())})
    assert heard(lines, monkeypatch, asked=6) == [SitesHeard()]


def test_the_core_is_told_what_has_changed_and_all_of_it_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = {"r5": Answer(()), "r9": Answer((MAPPER,))}
    lines = Lines(settings(tmp_path, SITES), both)
    heard(lines, monkeypatch, asked=20)
    assert lines.events.count(Recovered("/lab/mapper", SPAN + 1, "r9")) == 1
    monkeypatch.setattr(recoveries, "AGAIN_S", 0.002)
    lines = Lines(settings(tmp_path, SITES), both)
    heard(lines, monkeypatch, asked=20)
    assert lines.events.count(Recovered("/lab/mapper", SPAN + 1, "r9")) > 1


def test_of_one_answer_no_more_is_read_than_a_robot_can_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flood = Answer(tuple(Recovery(f"/lab/c{number}", SPAN, "r9") for number in range(COMPONENTS_MAX + 5)))
    lines = Lines(settings(tmp_path, SITES), {"r5": Answer(()), "r9": flood})
    assert len(heard(lines, monkeypatch, asked=6)) == COMPONENTS_MAX + 1


def test_a_robot_whose_agent_is_starting_gives_no_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Lines(settings(tmp_path, SITES, me="r8"), {})

    async def nothing(_what: str) -> Told:
        return Told(1, 0)

    monkeypatch.setattr(lines, "ask", nothing)
    with pytest.raises(AgentError, match="is starting"):
        asyncio.run(Recoveries(lines).told())
