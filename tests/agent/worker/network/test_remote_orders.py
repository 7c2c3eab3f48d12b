"""Orders and answers where each robot's own connection stands at another time."""

import asyncio
from typing import Any

import msgspec

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
