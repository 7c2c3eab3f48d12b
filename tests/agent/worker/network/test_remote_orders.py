"""Orders and answers where each robot's own connection stands at another time."""

import asyncio
from typing import Any

import msgspec
import pytest

from agent.worker.network import remote_orders
from agent.worker.network.remote_orders import Errands
from failover.core.wire.messages import Bulk, Errand, ErrandDone


def test_an_answer_waits_for_the_connection_to_the_robot_that_asked() -> None:
    async def body() -> None:
        is_connected = asyncio.Event()
        said: list[Bulk] = []

        def say(_peer: str, message: Bulk) -> None:
            if is_connected.is_set():  # as the replication link does: what is said without a connection is lost
                said.append(message)

        async def echo(arguments: dict[str, Any], _by: int) -> dict[str, Any]:
            carried_out.set()
            return arguments

        carried_out = asyncio.Event()
        errands = Errands(say, lambda _: "" if is_connected.is_set() else "connecting", {"echo": echo})
        errands.received("robot1", Errand(1, "echo", msgspec.msgpack.encode({"a": 1})))
        await carried_out.wait()
        await asyncio.sleep(0.05)
        assert not said
        is_connected.set()
        async with asyncio.timeout(60):
            while not said:
                await asyncio.sleep(0)
        answer = said[0]
        assert isinstance(answer, ErrandDone) and msgspec.msgpack.decode(answer.content) == {"a": 1}

    asyncio.run(body())


def answered(said: list[Bulk], *numbers: int) -> Errands:
    """The end of a robot that has carried these orders of robot1 out, and said so; it runs in the loop."""

    async def echo(arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        return arguments

    errands = Errands(lambda _, message: said.append(message), lambda _: "", {"echo": echo})
    for number in numbers:
        errands.received("robot1", Errand(number, "echo", msgspec.msgpack.encode({"a": "b" * 1000})))
    return errands


async def until_said(said: list[Bulk], count: int) -> None:
    async with asyncio.timeout(60):
        while len(said) < count:
            await asyncio.sleep(0)


def numbers(said: list[Bulk]) -> list[int]:
    return [one.number for one in said if isinstance(one, ErrandDone)]


def test_an_answer_that_may_have_been_lost_with_its_connection_is_said_again_on_the_next_one_and_once() -> None:
    async def body() -> None:
        said: list[Bulk] = []
        errands = answered(said, 7, 8)
        await until_said(said, 2)
        errands.stands("robot1")
        assert len(said) == 2, "nothing was lost yet"
        errands.lost("robot1")
        errands.stands("robot1")
        errands.stands("robot1")
        assert numbers(said) == [7, 8, 7, 8] and said[:2] == said[2:]

    asyncio.run(body())


def test_what_no_peer_awaits_any_more_is_not_said_again(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body() -> None:
        said: list[Bulk] = []
        errands = answered(said, 7)
        await until_said(said, 1)
        monkeypatch.setattr(remote_orders, "PATIENCE_S", 0.0)
        await asyncio.sleep(0.01)
        errands.lost("robot1")
        errands.stands("robot1")
        assert numbers(said) == [7]

    asyncio.run(body())


def test_of_too_many_bytes_of_answers_the_oldest_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body() -> None:
        monkeypatch.setattr(remote_orders, "SAID_SIZE_MAX", 2500)
        said: list[Bulk] = []
        errands = answered(said, 1, 2, 3)
        await until_said(said, 3)
        errands.lost("robot1")
        errands.stands("robot1")
        assert numbers(said) == [1, 2, 3, 2, 3]

    asyncio.run(body())


def test_an_answer_that_an_earlier_life_awaited_is_none_to_a_later_one() -> None:
    async def first_number() -> int:
        given: list[Bulk] = []
        asking = asyncio.create_task(
            Errands(lambda _, message: given.append(message), lambda _: "", {}).send("robot2", "echo", {})
        )
        await until_said(given, 1)
        asking.cancel()
        (order,) = given
        assert isinstance(order, Errand)
        return order.number

    assert asyncio.run(first_number()) != asyncio.run(first_number())
