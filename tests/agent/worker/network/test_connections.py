"""All links of a robot together: a key that is refused on one is refused on each, at once."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from agent.config import Config, Settings
from agent.worker.network.connections import AllConnections
from agent.worker.network.links import Device
from agent.worker.network.replication_link import (
    ANY_DEVICE,
    AnyDevice,
    Callbacks,
    Devices,
    Keys,
    LinkState,
    ReplicationLink,
    new_keys,
)
from failover.config.team import Robot, Team
from failover.core.wire.messages import Bulk, Cancel
from tests.agent.worker.network.test_replication_link import free_port, until

FURTHER = 1
OURS, OLD, NEW = new_keys(), new_keys(), new_keys()


class Scene:
    """robot1 with two links; whoever has a key of robot2 may connect to either of them."""

    def __init__(self, devices: Devices = ANY_DEVICE) -> None:
        port, theirs, beside = free_port(), free_port(), free_port()
        self.address = {"bulk": f"127.0.0.1:{port}", "further": f"127.0.0.2:{port}"}
        self.settings = Settings(
            Path("agent.toml"),
            Config(robot="robot1"),
            Team(
                "lab",
                {
                    "robot1": Robot((self.address["bulk"], self.address["further"]), self.address["bulk"]),
                    "robot2": Robot((f"127.0.0.1:{theirs}", f"127.0.0.2:{beside}"), f"127.0.0.1:{theirs}"),
                },
            ),
            OURS[1],
        )
        self.heard: list[tuple[int, Bulk]] = []
        self.connections = AllConnections(
            self.settings, self.keys(OLD, NEW), lambda way, _, message: self.heard.append((way, message)), _nothing, devices
        )

    def keys(self, *theirs: tuple[str, str]) -> Keys:
        """What robot1 knows: its own keys, and one or two of robot2."""
        (public, _), *following = theirs
        return Keys(*OURS, {"robot1": OURS[0], "robot2": public}, {"robot2": following[0][0]} if following else {})

    @property
    def strangers(self) -> int:
        return self.connections._further[self.address["further"]].strangers

    @asynccontextmanager
    async def connected(self, link: str, pair: tuple[str, str]) -> AsyncIterator[ReplicationLink]:
        """One who calls itself robot2 and has this pair of keys."""
        peers = {"robot1": OURS[0], "robot2": pair[0]}
        callbacks = Callbacks(lambda *_: None, lambda *_: None)
        one = ReplicationLink("robot2", f"127.0.0.1:{free_port()}", {"robot1": self.address[link]}, Keys(*pair, peers), callbacks)
        one.open()
        try:
            await until(lambda: one.links["robot1"].state is LinkState.CONNECTED)
            yield one
        finally:
            await one.close()


def _nothing(*_: object) -> None:
    pass


def run(body: Callable[[Scene], Awaitable[None]]) -> None:
    async def main() -> None:
        scene = Scene()
        scene.connections.open()
        assert not scene.connections.troubles
        try:
            await body(scene)
        finally:
            await scene.connections.close()

    asyncio.run(main())


async def is_refused(scene: Scene, thief: ReplicationLink, message: Bulk) -> None:
    before = scene.strangers
    thief.say("robot1", message)
    await until(lambda: scene.strangers > before)
    assert (FURTHER, message) not in scene.heard


def test_a_new_key_that_is_used_on_one_link_ends_the_old_one_on_each() -> None:
    """A thief could else greet over the other link until the last moment, and keep the key of its heartbeats."""

    async def body(scene: Scene) -> None:
        async with scene.connected("further", OLD) as thief:
            thief.say("robot1", Cancel(1))
            await until(lambda: (FURTHER, Cancel(1)) in scene.heard)
            async with scene.connected("bulk", NEW) as owner:
                owner.say("robot1", Cancel(2))
                await until(lambda: (0, Cancel(2)) in scene.heard)
                await is_refused(scene, thief, Cancel(3))

    run(body)


def test_another_change_of_the_team_brings_no_old_key_back() -> None:
    async def body(scene: Scene) -> None:
        async with scene.connected("further", OLD) as thief, scene.connected("bulk", NEW) as owner:
            owner.say("robot1", Cancel(1))
            await until(lambda: (0, Cancel(1)) in scene.heard)
            third = {**scene.settings.team.robots, "robot3": Robot(("127.0.0.1:9",), "127.0.0.1:9")}
            both = scene.keys(OLD, NEW)
            with_third = Keys(both.public, both.secret, {**both.peers, "robot3": new_keys()[0]}, both.following)
            await scene.connections.change(scene.settings.with_team(replace(scene.settings.team, robots=third)), with_third)
            await is_refused(scene, thief, Cancel(2))

    run(body)


def test_a_further_link_refuses_the_old_key_while_the_replication_link_is_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(scene: Scene) -> None:
        goes_on, bulk = asyncio.Event(), scene.connections.bulk
        change = bulk.change

        async def slow(*arguments: object) -> None:
            await goes_on.wait()
            await change(*arguments)  # type: ignore[arg-type]

        monkeypatch.setattr(bulk, "change", slow)
        async with scene.connected("further", OLD) as thief:
            thief.say("robot1", Cancel(1))
            await until(lambda: (FURTHER, Cancel(1)) in scene.heard)
            changing = asyncio.create_task(scene.connections.change(scene.settings, scene.keys(NEW)))
            await asyncio.sleep(0)  # it has begun, and waits for the replication link
            await is_refused(scene, thief, Cancel(2))
            goes_on.set()
            await changing

    run(body)


class HeldElsewhere(AnyDevice):
    """The listener is held to an interface by which nothing comes here."""

    def __init__(self, device: Device) -> None:
        self.held = device

    def listening(self, _peers: Iterable[str]) -> Device | None:
        """That one."""
        return self.held


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: a listener is held to an interface")
def test_the_first_robot_of_another_site_comes_in_by_any_interface_at_once() -> None:
    """It is reached by a tunnel, and the listener was held to the interface of the bulk address until then."""
    others = [Device(name, index) for index, name in socket.if_nameindex() if name != "lo"]
    if not others:
        pytest.skip("needs an interface beside lo")

    def comes_in(scene: Scene) -> bool:
        host, port = scene.address["bulk"].split(":")
        with socket.socket() as client:
            return client.connect_ex((host, int(port))) == 0

    async def main() -> None:
        scene = Scene(HeldElsewhere(others[0]))
        scene.connections.open()
        try:
            assert not comes_in(scene)
            robots = scene.settings.team.robots
            far = scene.settings.with_robots({**robots, "robot2": robots["robot2"].at("harbour")})
            await scene.connections.change(far, scene.keys(OLD))
            assert comes_in(scene)
            await scene.connections.change(scene.settings, scene.keys(OLD))
            assert not comes_in(scene)
        finally:
            await scene.connections.close()

    asyncio.run(main())
