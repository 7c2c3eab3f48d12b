"""What the worker process says to its main loop first; and that a witness's word starts, ends and overwrites nothing."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agent import config as configuration
from agent.errors import ConfigError, RefusedError
from agent.main import main as agent_main
from agent.main_loop.messages import Happened, HearKey, Inventory, TeamIs, ToMainLoop, ToWorker, event_of
from agent.worker import known_sites
from agent.worker.network.connections import BULK
from agent.worker.network.replication_link import LinkState
from agent.worker.process import Worker
from agent.worker.team_changes import TEAM_IS
from agent.worker.witness import Witness
from checkpoint.keeper.messages import Channel, pair
from checkpoint.model import Position
from failover.config import members, team
from failover.config.team import Robot, Team, sites_of
from failover.core.events import Event, Exited, Unread
from failover.core.types import ComponentSpec, Found
from failover.core.wire.messages import VERSION, Content, Errand, ErrandDone, Goodbye, Hello, Offer, Refuse

OFFER = Offer(7, "/lab/a", 1, Position(64, 1, b"d"), None, 10, b"x", ComponentSpec("/lab/a"))


@pytest.fixture
def settings(tmp_path: Path) -> configuration.Settings:
    """robot1's, in a team with a witness."""
    members = {
        "robot1": Robot(("127.0.0.1:7420",), "127.0.0.1:7421"),
        "gate": Robot(("127.0.0.1:7430",), "127.0.0.1:7431", "witness"),
        "robot2": Robot(("127.0.0.1:7440",), "127.0.0.1:7441"),
    }
    team.write(tmp_path / "team", Team("lab", members))
    path = tmp_path / "agent.toml"
    places = "".join(f'{part}_directory = "{tmp_path / part}"\n' for part in ("team", "state", "runtime"))
    path.write_text(f'robot = "robot1"\ninsecure = true\n{places}')
    return configuration.load(path)


def heard(settings: configuration.Settings, peer: str, message: Any, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What a robot answers to a message at once."""

    async def hear() -> list[Any]:
        ours, theirs = pair()
        with ours, theirs:
            worker = Worker(settings, Channel(ours, ToWorker))
            said: list[Any] = []
            monkeypatch.setattr(worker._connections, "say", lambda _peer, answer: said.append(answer))
            monkeypatch.setattr(worker._replication_link, "say", lambda _peer, answer: said.append(answer))
            monkeypatch.setattr(worker.errands, "received", lambda _peer, errand: said.append(errand))
            worker._hear(BULK, peer, message)
            return said

    return asyncio.run(hear())


@pytest.mark.parametrize("verb", ["stop", "release", "handover", "prefer", "promoted", "piece"])
def test_an_order_of_a_witness_is_refused(settings: configuration.Settings, verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    order = Errand(3, verb, b"\x80", 0)
    (answer,) = heard(settings, "gate", order, monkeypatch)
    assert isinstance(answer, ErrandDone) and answer.number == 3 and "gate is a witness: it votes" in answer.refusal
    assert heard(settings, "robot2", order, monkeypatch) == [order], "a robot's is carried out"


@pytest.mark.parametrize("verb", ["standing", "picture", "story"])
def test_a_witness_may_ask_how_things_stand(settings: configuration.Settings, verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    question = Errand(3, verb, b"\x80", 0)
    assert heard(settings, "gate", question, monkeypatch) == [question]


def test_a_snapshot_of_a_witness_is_refused(settings: configuration.Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    (answer,) = heard(settings, "gate", OFFER, monkeypatch)
    assert isinstance(answer, Refuse) and "gate is a witness" in answer.reason


@pytest.fixture
def far(settings: configuration.Settings) -> configuration.Settings:
    """The same in a team that has robot2 at another site."""
    robots = settings.team.robots
    return settings.with_robots({**robots, "robot2": robots["robot2"].at("hall")})


@pytest.mark.parametrize("verb", ["stop", "release", "handover", "prefer", "promoted", "piece", "drained"])
def test_an_order_of_another_site_is_refused(far: configuration.Settings, verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (answer,) = heard(far, "robot2", Errand(3, verb, b"\x80", 0), monkeypatch)
    assert isinstance(answer, ErrandDone) and answer.number == 3 and "robot2 is a member of another site" in answer.refusal
    for allowed in ("team_grant", "items", "sealed", "picture"):
        order = Errand(3, allowed, b"\x80", 0)
        assert heard(far, "robot2", order, monkeypatch) == [order]


def test_a_snapshot_of_another_site_is_refused(far: configuration.Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    (answer,) = heard(far, "robot2", OFFER, monkeypatch)
    assert isinstance(answer, Refuse) and "robot2 is a member of another site" in answer.reason


def test_a_file_of_another_site_comes_to_no_robot_and_a_sealed_copy_to_a_witness(
    far: configuration.Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    came: list[Any] = []
    for kind in (Worker, Witness):
        monkeypatch.setattr(kind, "hear_of_a_snapshot", lambda _self, peer, message: came.append((peer, message)))
    content = Content(9, 10, b"d" * 32)
    heard(far, "robot2", content, monkeypatch)
    assert came == []

    async def hear() -> None:
        ours, theirs = pair()
        with ours, theirs:
            there = replace(far, config=replace(far.config, robot="gate"))
            Witness(there, Channel(ours, ToWorker))._hear(BULK, "robot2", content)

    asyncio.run(hear())
    assert came == [("robot2", content)]


Greets = Callable[..., list[HearKey]]


@pytest.fixture
def greets(far: configuration.Settings, monkeypatch: pytest.MonkeyPatch) -> Greets:
    """What the main loop is told of a member that greets; ``settings``: ours."""
    told: list[Any] = []
    monkeypatch.setattr(Worker, "_say", lambda _self, message: told.append(message))
    monkeypatch.setattr("agent.worker.network.connections.AllConnections.answer", lambda *given: told.append(given[-1]))

    def said(peer: str, sites: dict[str, str] | None, settings: configuration.Settings = far, change: int = 0) -> list[Any]:
        told.clear()
        hello = Hello(VERSION, "lab", peer, 1, b"k" * 32, again=True, change=change, members=5, sites=sites)
        heard(settings, peer, hello, monkeypatch)
        return [message for message in told if isinstance(message, HearKey | Goodbye)]

    return said


def test_a_robot_of_another_site_gives_no_key_for_heartbeats(far: configuration.Settings, greets: Greets) -> None:
    sites = sites_of(far.team)
    assert greets("robot2", sites) == [], "no heartbeat of it is read"
    assert greets("gate", sites) == [HearKey("gate", b"k" * 32)]


def test_an_address_or_a_member_that_differs_makes_nobody_deaf(far: configuration.Settings, greets: Greets) -> None:
    """Files are brought to the robots one after the other."""
    sites = sites_of(far.team)
    assert greets("gate", {**sites, "robot9": "dock"}) == [HearKey("gate", b"k" * 32)]
    assert greets("gate", {name: site for name, site in sites.items() if name != "robot2"}) == [HearKey("gate", b"k" * 32)]


@pytest.mark.parametrize("change", [0, 1], ids=["the same change", "another change"])
@pytest.mark.parametrize("robot2", ["", "dock", None], ids=["no site", "another site", "a release without sites"])
def test_a_member_that_knows_other_sites_is_known_to_live_and_nothing_else_it_says_counts(
    far: configuration.Settings, greets: Greets, robot2: str | None, change: int
) -> None:
    key, goodbye = greets("gate", None if robot2 is None else {**sites_of(far.team), "robot2": robot2}, change=change)
    assert key == HearKey("gate", b"k" * 32, knows_other_sites=True)
    assert isinstance(goodbye, Goodbye) and "know other sites of robot2" in goodbye.reason


def test_a_robot_of_another_site_that_cannot_be_authenticated_holds_no_decision_up(
    far: configuration.Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Event] = []
    monkeypatch.setattr(Worker, "tell", lambda _self, event: told.append(event))

    async def comes() -> None:
        ours, theirs = pair()
        with ours, theirs:
            worker = Worker(far, Channel(ours, ToWorker))
            for peer in ("robot2", "gate", ""):
                worker._unread(peer, "its key is another one")

    asyncio.run(comes())
    assert told == [Unread("gate", "its key is another one"), Unread("", "its key is another one")]


def test_a_robot_without_sites_does_not_count_one_that_has_them(
    settings: configuration.Settings, far: configuration.Settings, greets: Greets
) -> None:
    key, goodbye = greets("gate", sites_of(far.team), settings)
    assert key.knows_other_sites and "know other sites of robot2" in goodbye.reason
    assert greets("gate", None, settings) == [HearKey("gate", b"k" * 32)], "neither has sites"


LIVES = """
import sys
from agent.worker import hub
hub.live(lambda settings, main_loop: sys.exit(f"{settings.config.robot} lives"))
"""


def test_a_worker_process_that_starts_anew_does_not_take_sites_that_were_edited_by_hand(
    settings: configuration.Settings, capsys: pytest.CaptureFixture[str]
) -> None:
    """The main loop would decide with them from then on."""
    known_sites.note(settings)

    def born() -> str:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            words = [sys.executable, "-c", LIVES, str(settings.path), str(theirs.fileno())]
            return subprocess.run(words, pass_fds=[theirs.fileno()], capture_output=True, text=True, check=False).stderr

    assert "robot1 lives" in born()
    robots = settings.team.robots
    team.write(
        Path(settings.config.team_directory), replace(settings.team, robots={**robots, "robot1": robots["robot1"].at("hall")})
    )
    said = born()
    assert "robot1 lives" not in said and "edited by hand" in said
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.load(settings.path)
    assert agent_main(["check", "--config", str(settings.path)]) == 1, "and a person hears it before the agent does"
    assert "edited by hand" in capsys.readouterr().err


def test_an_end_is_told_after_the_inventory_in_which_the_program_still_runs(settings: configuration.Settings) -> None:
    found, end = Found("/lab/a", 1, True, 0), Exited("/lab/a", 1, 7 << 8, "")

    class Worker(Witness):
        async def prepare(self) -> Inventory:
            """A program that was found ends while the worker looks for the next one."""
            self.tell(end)
            await asyncio.sleep(0)  # what is to be said is sent meanwhile
            return Inventory((), (found,))

    async def first_words() -> list[ToMainLoop]:
        ours, theirs = pair()
        with ours, theirs:
            worker = Worker(settings, Channel(ours, ToWorker))
            speaking = asyncio.create_task(worker._speak_to_main_loop())
            await worker._begin()
            worker.tell(end)
            while not worker._outgoing.empty():
                await asyncio.sleep(0)
            speaking.cancel()
            main_loop = Channel(theirs, ToMainLoop)
            return [main_loop.receive()[0] for _ in range(4)]

    members, inventory, *later = asyncio.run(first_words())
    assert members == TeamIs(settings.team.robots)
    assert isinstance(inventory, Inventory) and inventory.found == (found,)
    assert [event_of(message) for message in later if isinstance(message, Happened)] == [end, end]


# --- Robots that are no members any more ------------------------------------------------------------------------------


@pytest.fixture
def shrunk(settings: configuration.Settings) -> configuration.Settings:
    """The same, after robot2 was taken out."""
    return settings.with_team(members.left(settings.team, "robot2", "robot1"))


def test_answers_are_said_again_when_a_connection_stands_in_the_place_of_the_lost_one(
    settings: configuration.Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def live() -> list[object]:
        ours, theirs = pair()
        with ours, theirs:
            worker = Worker(settings, Channel(ours, ToWorker))
            said: list[Any] = []
            monkeypatch.setattr(worker.errands, "_hindrance", lambda _: "")
            monkeypatch.setattr(worker.errands, "_say", lambda _, answer: said.append(answer))
            for apart in ("_say", "link_lost"):
                monkeypatch.setattr(worker, apart, lambda _: None)
            worker.errands.received("robot2", Errand(3, "no such verb", b"\x80", 0))
            while not said:
                await asyncio.sleep(0)
            for state in (LinkState.CONNECTED, LinkState.CONNECTING, LinkState.CONNECTED):
                worker._way_changed(BULK, "robot2", state, "")
                said.append(state)
            return [one.number if isinstance(one, ErrandDone) else one for one in said]

    assert asyncio.run(live()) == [3, LinkState.CONNECTED, LinkState.CONNECTING, 3, LinkState.CONNECTED]


@pytest.mark.parametrize("message", [OFFER, Errand(3, "stop", b"\x80", 0), Errand(3, "team_taken", b"\x80", 0), Goodbye("x")])
def test_nothing_that_a_former_member_or_a_stranger_says_counts(
    shrunk: configuration.Settings, message: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may have been under way when the team changed."""
    assert heard(shrunk, "robot2", message, monkeypatch) == []
    assert heard(shrunk, "nobody", message, monkeypatch) == []


def test_a_former_member_may_ask_which_team_there_is(shrunk: configuration.Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    question = Errand(3, TEAM_IS, b"\x80", 0)
    assert heard(shrunk, "robot2", question, monkeypatch) == [question]
    assert heard(shrunk, "nobody", question, monkeypatch) == []


def test_a_former_member_that_greets_is_told(shrunk: configuration.Settings) -> None:
    async def greet() -> dict[str, int]:
        ours, theirs = pair()
        with ours, theirs:
            worker = Worker(shrunk, Channel(ours, ToWorker))
            worker._hear(BULK, "robot2", Hello(VERSION, "another", "robot2", 1, b"k" * 32))
            assert not worker.team_changes._behind
            worker._hear(BULK, "robot2", Hello(VERSION, "lab", "robot2", 1, b"k" * 32))
            return worker.team_changes._behind

    assert asyncio.run(greet()) == {"robot2": 0}


def test_a_former_member_is_admitted_and_connected_to(shrunk: configuration.Settings) -> None:
    async def known() -> tuple[set[str], set[str]]:
        ours, theirs = pair()
        with ours, theirs:
            worker = Worker(shrunk, Channel(ours, ToWorker))
            return set(worker._replication_link._peers), set(worker.settings.peers)

    assert asyncio.run(known()) == ({"gate", "robot2"}, {"gate"})


def test_a_witness_may_pass_a_change_of_the_team_on(settings: configuration.Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    order = Errand(3, "team_taken", b"\x80", 0)
    assert heard(settings, "gate", order, monkeypatch) == [order]


@pytest.mark.parametrize("is_link", [False, True], ids=["a file", "a link that leads nowhere"])
def test_a_witness_whose_folder_for_sealed_copies_is_harmed_says_so_and_votes_all_the_same(
    settings: configuration.Settings, is_link: bool
) -> None:
    settings.path.write_text(settings.path.read_text().replace("robot1", "gate") + '[store]\nsealed_size = "1GB"\n')
    folder = Path(settings.config.state_directory) / "sealed"
    folder.parent.mkdir(exist_ok=True)
    if is_link:
        folder.symlink_to("nowhere/at/all")
    else:
        folder.write_text("")

    async def begin() -> None:
        ours, theirs = pair()
        with ours, theirs:
            worker = Witness(configuration.load(settings.path), Channel(ours, ToWorker))
            assert await worker.prepare() == Inventory((), ())
            (notice,) = (one for one in worker.notices() if str(folder) in one)
            assert notice.startswith(f"gate cannot keep sealed copies in {folder}: ")
            assert notice.endswith("; repair that folder, and restart its agent")
            with pytest.raises(RefusedError, match="gate cannot keep sealed copies"):
                await worker._asked_for_a_copy("robot1", {"act": "listed", "folder": "lab"})

    asyncio.run(begin())
