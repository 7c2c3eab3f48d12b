"""Relay of a component's output: complete from the moment at which status says that the component has ended."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from agent.errors import RefusedError
from agent.guard.output_logs import OutputLogs
from agent.worker.components.paths import Places, log_directory
from agent.worker.control.output_relay import OutputRelay, Passage
from failover.core.types import State

NAME = "/lab/r1/mapper"
WRITTEN = b"one\ntwo\nthree\n"
COMMITTED = len(b"one\n")


class Listener:
    """A client that keeps what it is sent."""

    def __init__(self) -> None:
        self.heard = b""
        self.caller = SimpleNamespace(uid=0)

    async def output(self, _stream: int, _offset: int, content: bytes, times: tuple[tuple[int, int], ...]) -> None:
        self.heard += content
        self.times = times


class Worker:
    """A robot whose core says that the component is in a state, while its supervisor has not heard of an end."""

    def __init__(self, places: Places, state: State) -> None:
        self.settings: Any = None
        self.errands: Any = None
        self.places = places
        self.supervisors: Any = {NAME: SimpleNamespace(ended=None, component=SimpleNamespace())}
        self._view = SimpleNamespace(name=NAME, state=state, primary="r1", positions=())

    async def ask(self, _what: object, _component: str = "") -> Any:
        return SimpleNamespace(status=SimpleNamespace(components=(self._view,), peers=()))


@pytest.fixture
def places(tmp_path: Path) -> Places:
    process_pool: Any = None
    found = Places(tmp_path / "state", tmp_path / "run", process_pool)
    logs = OutputLogs(log_directory(NAME, found))
    logs.write(1, 0, WRITTEN)
    logs.commit((COMMITTED, 0))
    logs.close()
    return found


@pytest.mark.parametrize(
    ("state", "heard"),
    [(State.PRIMARY, WRITTEN[:COMMITTED]), (State.FINISHED, WRITTEN), (State.FAILED, WRITTEN)],
)
def test_logs_show_all_of_it_as_soon_as_status_says_that_it_has_ended(places: Places, state: State, heard: bytes) -> None:
    listener: Any = Listener()
    relay = OutputRelay(Worker(places, state))
    asyncio.run(relay.pass_on(listener, NAME, Passage()))
    assert listener.heard == heard


@pytest.mark.parametrize(("offset", "heard"), [(-6, b"three\n"), (-1000, WRITTEN), (-1, b"\n")])
def test_an_offset_below_zero_counts_from_the_end(places: Places, offset: int, heard: bytes) -> None:
    listener: Any = Listener()
    relay = OutputRelay(Worker(places, State.FINISHED))
    totals = asyncio.run(relay.pass_on(listener, NAME, Passage((offset, offset))))
    assert listener.heard == heard and totals == (len(WRITTEN), 0)


def test_a_robot_shows_no_user_what_another_users_component_of_the_same_name_wrote(places: Places) -> None:
    """That one was released; what it wrote lies here until the new one has written something."""
    logs = OutputLogs(log_directory(NAME, places))
    logs.belong(7002)
    logs.close()
    listener: Any = Listener()
    listener.caller = SimpleNamespace(uid=7001)
    relay = OutputRelay(Worker(places, State.PRIMARY))
    with pytest.raises(RefusedError, match="belongs to uid 7002"):
        asyncio.run(relay.pass_on(listener, NAME, Passage()))
    assert listener.heard == b""
    listener.caller = SimpleNamespace(uid=7002)
    asyncio.run(relay.pass_on(listener, NAME, Passage()))
    assert listener.heard == WRITTEN[:COMMITTED]


def test_what_was_shown_before_is_not_shown_again_however_new_it_is(places: Places) -> None:
    listener: Any = Listener()
    relay = OutputRelay(Worker(places, State.FINISHED))
    totals = asyncio.run(relay.pass_on(listener, NAME, Passage((COMMITTED, 0), since_ms=60_000)))
    assert listener.heard == WRITTEN[COMMITTED:] and totals == (len(WRITTEN), 0)
