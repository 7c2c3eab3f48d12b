"""Robots of one team, each at a loopback address of its own: names and calls between them, by the team's keys alone."""

from __future__ import annotations

import contextlib
import socket
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest

from agent.worker.network.replication_link import new_keys
from failover.core.messaging.envelope import Envelope, decode, encode
from failover.core.naming.tree import Reach
from failover.drivers import here as here_module
from failover.drivers import sockets
from failover.drivers.here import Here, host_and_port
from failover.drivers.lookup import lookup, whole_tree
from failover.drivers.server import Serving
from failover.errors import DriverError, NameFormatError, NameUnknownError
from tests.failover.drivers.devices import ENGINE, Arm, Camera, Engine
from tests.failover.drivers.serving import Lab, called, serving, until


@pytest.fixture
def lab(folder: Path) -> Lab:
    return Lab(folder, "robot1", "robot2", "robot3")


def resolved(one: Serving, name: str) -> Any:
    with contextlib.suppress(NameUnknownError):
        return one.service.resolve(name)


def test_a_driver_is_found_and_called_from_another_robot(lab: Lab) -> None:
    with serving(Engine, lab.here("robot1")) as engine, serving(Camera, lab.here("robot2")) as camera:
        until(lambda: resolved(camera, "engine") and resolved(engine, "Lab/robot2/Camera"))
        with called(lab.here("robot2"), "engine") as proxy:
            proxy.call("set", duty=0.25)
            assert proxy.call("read") == {"duty": 0.25}
            values = proxy.stream("current")
            assert next(values) == 0.5
        with called(lab.here("robot1"), "Lab/robot2/Camera") as proxy:
            assert proxy.call("read") == 7


def test_an_answer_is_not_waited_for_before_its_message_has_left(lab: Lab) -> None:
    with serving(Engine, lab.here("robot1")), called(lab.here("robot2"), "engine") as proxy:
        way, waited = proxy._sending.route.way, []
        await_message = way.await_message

        def noted(timeout_ns: int, *wake: int) -> bytes | None:
            if timeout_ns:
                waited.append(proxy._sending._outbox.is_connected)
            return await_message(timeout_ns, *wake)

        way.await_message = noted  # type: ignore[method-assign]
        assert proxy.call("read") == {"duty": 0.0}
        assert waited and all(waited)


def test_a_robot_without_a_driver_asks_the_others(lab: Lab) -> None:
    with serving(Engine, lab.here("robot1")), called(lab.here("robot2"), "engine") as proxy:
        assert proxy.call("read") == {"duty": 0.0}


def test_several_programs_of_a_robot_without_a_driver_ask_at_once(lab: Lab) -> None:
    found: list[str] = []
    with serving(Engine, lab.here("robot1")):
        threads = [threading.Thread(target=lambda: found.append(lookup(lab.here("robot2"), "engine").robot)) for _ in range(5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert found == ["robot1"] * 5


def test_the_second_driver_of_a_robot_is_found_through_the_first(lab: Lab) -> None:
    with serving(Camera, lab.here("robot2")) as camera, serving(Arm, lab.here("robot1")) as arm:
        with serving(Engine, lab.here("robot1")) as engine:
            assert not engine.service._exchange.is_door
            until(lambda: resolved(camera, "engine") and resolved(engine, "Lab/robot2/Camera"))
            assert arm.service._exchange.is_door
        until(lambda: not resolved(camera, "engine"))


def test_another_process_becomes_the_door(lab: Lab) -> None:
    with serving(Camera, lab.here("robot2")) as camera:
        with serving(Arm, lab.here("robot1")):
            first = Serving(Engine, lab.here("robot1"))
        with first:
            until(lambda: first.service._exchange.is_door)
            until(lambda: resolved(camera, "engine") and resolved(camera, "engine").reach is Reach.LIVE)


def test_a_name_in_another_robots_subtree_is_refused(lab: Lab) -> None:
    with pytest.raises(NameFormatError, match="in the subtree of robot2"):
        Serving(Camera, lab.here("robot1"))
    assert [path.suffix for path in lab.here("robot1").directory.iterdir()] == [".lock"]


# --- Keys ------------------------------------------------------------------------------------------------------------


def asked(here: Here, address: str, robot: str, envelope: Envelope) -> Envelope | None:
    """The answer to one message, if there is one soon."""
    way = sockets.TeamWay(address, here, robot)
    try:
        if not way.await_sent(encode(envelope), 2_000_000_000):
            return None
        content = way.await_message(2_000_000_000)
        return None if content is None else decode(content)
    finally:
        way.close()


def address_of(one: Serving) -> str:
    (found,) = [address for address in one.service.record.addresses if address.startswith("tcp://")]
    return found


READ = Envelope(verb="read", id="1", sender="robot2/test")


def test_a_key_that_is_not_in_the_team_is_not_answered(lab: Lab) -> None:
    public, secret = new_keys()
    robots = lab.team.robots | {"robot2": msgspec_replace(lab.team.robots["robot2"], public)}
    stranger = Here("robot2", lab.here("robot2").directory, type(lab.team)("lab", robots), secret)
    with serving(Engine, lab.here("robot1")) as engine:
        good = asked(lab.here("robot2"), address_of(engine), "robot1", READ)
        assert good is not None and good.ok == {"duty": 0.0}
        assert asked(stranger, address_of(engine), "robot1", READ) is None
        until(lambda: engine._gate.refused)
        door = "tcp://{}:{}".format(*host_and_port(lab.team, "robot1"))
        way = sockets.TeamWay(door, stranger, "robot1")
        assert not way.await_sent(b"x", 1_000_000_000)
        way.close()


def msgspec_replace(robot: Any, public: str) -> Any:
    return type(robot)(robot.beats, robot.bulk, robot.role, public)


def test_a_robot_cannot_speak_for_another_one(lab: Lab) -> None:
    with serving(Engine, lab.here("robot1")) as engine:
        forged = msgspec.structs.replace(READ, sender="robot3/mission")
        answer = asked(lab.here("robot2"), address_of(engine), "robot1", forged)
        assert answer is not None and answer.error.kind == "wrong_sender"  # type: ignore[union-attr]


def test_a_message_that_a_person_writes_on_another_robot_needs_no_sender(lab: Lab) -> None:
    with serving(Engine, lab.here("robot1")) as engine:
        answer = asked(lab.here("robot2"), address_of(engine), "robot1", Envelope(verb="read"))
        assert answer is not None and answer.ok == {"duty": 0.0} and answer.to.startswith("robot2/by-hand-")
        assert [row["from"] for row in engine._actor._graph(Envelope(), engine.now_ns())] == ["robot2/by-hand"]


def test_without_a_key_no_port_is_open(here: Here) -> None:
    with serving(Engine, here) as engine:
        assert [address.partition(":")[0] for address in engine.service.record.addresses] == ["local", "unix"]
        assert engine._team is None and not engine.service._exchange.is_door
        assert engine.addresses_told()[1] == "only programs of this user on robot1 reach it: this test has no team"


def test_a_message_to_a_port_that_another_driver_has_got_moves_nothing(lab: Lab) -> None:
    with serving(Arm, lab.here("robot1")) as arm:
        wrong = msgspec.structs.replace(READ, to=ENGINE)
        answer = asked(lab.here("robot2"), address_of(arm), "robot1", wrong)
        assert answer is not None and answer.error.kind == "wrong_driver"  # type: ignore[union-attr]


# --- What the files say ----------------------------------------------------------------------------------------------


def test_the_robot_is_the_one_whose_key_lies_here(lab: Lab, here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(here_module.ROBOT)
    monkeypatch.setenv(here_module.TEAM, str(lab.write("robot2")))
    found = here_module.here()
    assert (found.robot, found.alone, found.others) == ("robot2", "", ("robot1", "robot3"))
    assert found.secret == lab.secrets["robot2"]


def test_a_team_that_was_named_and_cannot_be_used_is_an_error(lab: Lab, here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    place = lab.write("robot2")
    monkeypatch.setenv(here_module.TEAM, str(place))
    with pytest.raises(DriverError, match="cannot read this robot's key"):
        here_module.here()  # the environment says robot1
    monkeypatch.delenv(here_module.ROBOT)
    (place / "keys" / "robot2.secret").chmod(0o644)
    with pytest.raises(DriverError, match="open to others"):
        here_module.here()


def test_without_a_team_a_driver_says_why_it_is_alone(here: Here, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(here_module, "SYSTEM_TEAM", folder / "none")
    assert "there is no such file" in here_module.here().alone


def test_a_stale_socket_of_a_killed_driver_is_removed(here: Here) -> None:
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    dead.bind(str(here.directory / "dead.names"))
    dead.close()
    with serving(Engine, here):
        until(lambda: not (here.directory / "dead.names").exists())
        assert lookup(here, "engine").record.path == ENGINE
        assert len(whole_tree(here)) == 1
