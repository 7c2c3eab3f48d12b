"""Drivers and programs that run on while the team changes: keys that are replaced, members that come and go."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from agent.worker.network.replication_link import new_keys
from failover.config import members, team
from failover.config.team import Robot, Team
from failover.core.messaging.envelope import Envelope, decode, encode
from failover.drivers import sockets
from failover.drivers.here import Here, TeamNow
from failover.drivers.proxy import Proxy
from tests.failover.drivers.devices import Camera, Engine
from tests.failover.drivers.serving import Lab, called, serving, until
from tests.failover.drivers.test_two_robots import READ, address_of, resolved


class Town(Lab):
    """A lab whose files lie there, and change as the agents change them."""

    def __init__(self, folder: Path, *robots: str) -> None:
        super().__init__(folder, *robots)
        for robot in robots:
            self.write(robot)

    def takes(self, after: Team, *robots: str) -> None:
        """These robots have another team now; without any: all of them."""
        for robot in robots or after.robots:
            team.write(self.place(robot), after)

    def begins(self, robot: str) -> Team:
        """Its new key counts beside the old one, at all robots; it uses the old one still. The team as it will be."""
        public, secret = new_keys()
        team.write_next_key(self.place(robot), robot, secret)
        self.takes(members.with_next_key(self.team, robot, public))
        return replace(self.team, robots=self.team.robots | {robot: replace(self.team.robots[robot], public_key=public)})

    def rotates(self, robot: str) -> None:
        """As its agent does it: both keys count, it uses the new one, the old one goes."""
        after = self.begins(robot)
        team.use_next_key(self.place(robot), robot)
        self.takes(after)
        self.team = after


@pytest.fixture
def town(folder: Path) -> Town:
    return Town(folder, "robot1", "robot2")


@pytest.fixture
def thief(town: Town) -> Here:
    """robot2, with keys as they were at the test's beginning: somebody has made a copy of them."""
    return Here("robot2", town.here("robot2").directory, town.team, town.secrets["robot2"], rules=town.folder / "copy")


class Thief:
    """One connection that is made with a copied key and stands."""

    def __init__(self, here: Here, address: str) -> None:
        self._way = sockets.TeamWay(address, here, "robot1")

    def asks(self, timeout_ns: int = 2_000_000_000) -> Envelope | None:
        if not self._way.await_sent(encode(READ), timeout_ns):
            return None
        content = self._way.await_message(timeout_ns)
        return None if content is None else decode(content)

    def close(self) -> None:
        self._way.close()


@pytest.fixture
def connections() -> Iterator[list[Thief]]:
    made: list[Thief] = []
    yield made
    for one in made:
        one.close()


def reads(proxy: Proxy) -> bool:
    return proxy.call("read", timeout=60) == {"duty": 0.0}


def test_a_program_calls_on_while_its_robot_replaces_its_key_and_a_copy_of_the_old_one_is_refused(
    town: Town, thief: Here, connections: list[Thief]
) -> None:
    with serving(Engine, town.here("robot1")) as engine, called(town.here("robot2"), "engine") as proxy:
        connections.append(stands := Thief(thief, address_of(engine)))
        assert reads(proxy) and stands.asks() is not None
        town.rotates("robot2")
        assert reads(proxy)
        assert stands.asks() is None, "on a connection that was made with the old key"
        refused = engine._gate.refused
        connections.append(anew := Thief(thief, address_of(engine)))
        assert anew.asks() is None
        assert engine._gate.refused > refused


def test_a_driver_whose_robot_replaces_its_key_is_called_on_and_proves_the_old_one_no_more(
    town: Town, connections: list[Thief], thief: Here
) -> None:
    with serving(Engine, town.here("robot1")) as engine, called(town.here("robot2"), "engine") as proxy:
        assert reads(proxy)
        address = address_of(engine)
        town.rotates("robot1")
        assert reads(proxy)
        until(lambda: engine.here.secret != town.secrets["robot1"])
        with called(town.here("robot2", secret=town.secrets["robot2"]), "engine") as another:
            assert reads(another) and address_of(engine) == address, "it listens where it did"
        connections.append(with_old := Thief(thief, address))  # its copy of the team has the old key of robot1
        assert with_old.asks() is None


def test_while_two_keys_count_a_driver_that_begins_proves_the_one_that_lies_there(town: Town) -> None:
    after = town.begins("robot2")
    team.use_next_key(town.place("robot2"), "robot2")
    here = replace_team(town, "robot2")
    with serving(Engine, town.here("robot1")), called(here, "engine") as proxy:
        assert reads(proxy)
        town.takes(after)
        assert reads(proxy)


def replace_team(town: Town, robot: str) -> Here:
    """As a process sees it that begins now."""
    secret = team.read_secret_key(town.place(robot), robot)
    return Here(robot, town.here(robot).directory, team.read(town.place(robot)), secret, rules=town.place(robot))


def test_a_robot_that_is_taken_out_is_refused_at_once_by_drivers_that_run(
    town: Town, thief: Here, connections: list[Thief]
) -> None:
    with serving(Engine, town.here("robot1")) as engine:
        connections.append(stands := Thief(thief, address_of(engine)))
        assert stands.asks() is not None
        town.takes(Team("lab", {"robot1": town.team.robots["robot1"]}), "robot1")
        assert stands.asks() is None
        connections.append(anew := Thief(thief, address_of(engine)))
        assert anew.asks() is None


def test_a_robot_that_comes_is_heard_by_drivers_that_run(folder: Path) -> None:
    town = Town(folder, "robot1", "robot2", "robot3")
    whole: dict[str, Robot] = town.team.robots
    with_two = Town.__new__(Town)
    with_two.folder, with_two.secrets = town.folder, town.secrets
    with_two.team = Team("lab", {name: whole[name] for name in ("robot1", "robot3")})
    with_two.takes(with_two.team, "robot1")
    with serving(Engine, with_two.here("robot1")) as engine:
        with serving(Camera, town.here("robot2")) as camera:
            town.takes(town.team, "robot1")
            until(lambda: resolved(engine, "Lab/robot2/Camera") and resolved(camera, "engine"))
            with called(town.here("robot2"), "engine") as proxy:
                assert reads(proxy)


def test_names_are_told_on_with_other_keys(town: Town) -> None:
    with serving(Engine, town.here("robot1")) as engine, serving(Camera, town.here("robot2")) as camera:
        until(lambda: resolved(camera, "engine") and resolved(engine, "Lab/robot2/Camera"))
        town.rotates("robot1")
        town.rotates("robot2")
        until(lambda: engine.service._exchange.here.team == camera.service._exchange.here.team == town.team)
    with serving(Engine, replace_team(town, "robot1")) as engine, serving(Camera, replace_team(town, "robot2")) as camera:
        until(lambda: resolved(camera, "engine") and resolved(engine, "Lab/robot2/Camera"))


@contextlib.contextmanager
def no_descriptor_left() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    first_free = os.open("/dev/null", os.O_RDONLY)
    os.close(first_free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (first_free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_keys_that_could_not_be_read_for_want_of_a_descriptor_are_read_later(
    town: Town, caplog: pytest.LogCaptureFixture
) -> None:
    now = TeamNow(town.here("robot1"))
    assert not now.look()
    town.rotates("robot2")
    with no_descriptor_left():
        assert not now.look() and not now.look()
        assert now.here.team != town.team
    (said,) = caplog.messages
    assert "Too many open files" in said and "team.toml" in said
    until(now.look)
    assert now.here.team == town.team


def test_what_others_prove_is_taken_even_if_the_own_key_cannot_be_read(town: Town, caplog: pytest.LogCaptureFixture) -> None:
    now = TeamNow(town.here("robot1"))
    team.secret_key_path(town.place("robot1"), "robot1").chmod(0o644)
    town.rotates("robot2")
    assert now.look() and not now.look()
    assert (now.here.team, now.here.secret) == (town.team, town.secrets["robot1"])
    (said,) = caplog.messages
    assert "chmod 600" in said


def test_a_member_without_a_key_keeps_no_revoked_key_of_another_one(town: Town) -> None:
    now = TeamNow(town.here("robot1"))
    third = Robot(("127.9.9.9:7420",), "127.9.9.9:7421")
    town.rotates("robot2")
    town.takes(replace(town.team, robots=town.team.robots | {"robot3": third}), "robot1")
    assert now.look()
    assert set(now.here.keys) == {robot.public_key for robot in town.team.robots.values()}


@pytest.mark.parametrize("damaged", [b"\xff" * 40, b"~" * 40, b"#" * 40], ids=["no text", "no Z85", "no number of 32 bits"])
def test_a_damaged_key_ends_no_driver(town: Town, damaged: bytes) -> None:
    path = team.secret_key_path(town.place("robot1"), "robot1")
    whole = path.read_bytes()
    with serving(Engine, town.here("robot1")) as engine, called(town.here("robot2"), "engine") as proxy:
        path.write_bytes(damaged)
        assert reads(proxy)
        path.write_bytes(whole)
        town.rotates("robot1")
        town.rotates("robot2")
        assert reads(proxy)
        until(lambda: engine.service._exchange.here.team == town.team)
        assert engine.service._thread.is_alive()


def test_a_driver_whose_address_is_taken_while_its_robot_replaces_its_key_goes_on_and_listens_there_again(
    town: Town, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with serving(Engine, town.here("robot1")) as engine, called(town.here("robot2"), "engine") as proxy:
        assert reads(proxy)
        host, port = town.here("robot1").host, address_of(engine).rpartition(":")[2]
        listen_again, others = sockets.listen_again, list[socket.socket]()

        def late(listening: sockets.Socket, address: str) -> bool:
            """Another program is quicker."""
            with contextlib.suppress(OSError):
                if not others:
                    others.append(socket.create_server((host, int(port))))
            return bool(others) and listen_again(listening, address)

        monkeypatch.setattr(sockets, "listen_again", late)
        town.rotates("robot1")
        until(lambda: others)
        with called(town.here("robot1"), "engine") as near:
            assert reads(near)
            until(lambda: f"another program has taken {address_of(engine)}" in caplog.text)
            assert reads(near)
        others[0].close()
        with called(town.here("robot2"), "engine") as another:
            assert reads(another) and reads(proxy)
        assert not engine._withdrawn


def test_a_stream_follows_to_a_robot_that_came_after_its_caller_began(folder: Path) -> None:
    town = Town(folder, "robot1", "robot2", "robot3")
    with_two = Town.__new__(Town)
    with_two.folder, with_two.secrets = town.folder, town.secrets
    with_two.team = Team("lab", {name: town.team.robots[name] for name in ("robot1", "robot3")})
    with_two.takes(with_two.team, "robot1")
    with serving(Engine, with_two.here("robot1")):
        proxy = called(with_two.here("robot1"), "engine")
        assert reads(proxy)
    with proxy, serving(Camera, with_two.here("robot1")), serving(Engine, town.here("robot2")):
        town.takes(town.team, "robot1")
        assert reads(proxy) and proxy.place.robot == "robot2"
        assert next(iter(proxy.stream("current"))) == 0.0
