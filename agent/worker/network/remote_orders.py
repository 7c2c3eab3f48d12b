"""Orders given on one robot and carried out on another, where the component runs.

An order travels as an `Errand` on the replication link, which identifies the sender; every robot of the team may give one. The
other robot carries it out as if it had been given there, and the answer travels back. It is carried out once or not at all: when
the connection is lost in between, the agent tells the client that the result is unknown.

Each robot makes a connection of its own. Where only the one that carries answers is lost, they are said again on the next one.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import secrets
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

import msgspec

from agent.errors import TROUBLE, RefusedError
from agent.system.crash import end_worker_on_mistake
from agent.system.permissions import NOBODY
from checkpoint.errors import UNDECODABLE
from failover.core.wire.messages import CHUNK_SIZE_MAX, Bulk, Errand, ErrandDone
from failover.errors import FailoverError

PATIENCE_S: Final = 75.0
"""How long an answer may take; the other robot gives its own orders up sooner."""

ANSWER_S: Final = 15.0
"""How long an answer waits for a connection to the robot that asked. Each robot makes its own: the other's may stand first."""

LOOK_S: Final = 0.02
"""How often it is looked whether the connection stands."""

SAID_SIZE_MAX: Final = 1 << 20
"""Bytes of answers to one peer that are kept, to be said again; the oldest are given up first."""

NUMBER_BITS: Final = 48
"""Of the first order's number, which is chosen at random: what an earlier life of this robot awaited is no answer to this one."""

UNDER_WAY_MAX: Final = 64
"""Errands of one peer that are carried out at a time; more are refused."""

SEALED: Final = "sealed"
"""The verb by which a robot asks a witness about sealed copies (`failover.archive.witness`)."""

ITEMS: Final = "items"
"""The verb by which a robot asks one of another site for the items of its board (`agent.worker.far_items`)."""

RECOVERED: Final = "recovered"
"""The verb by which it asks what an operator recovered there (`agent.worker.recoveries`)."""

CONTENT_MAX: Final = CHUNK_SIZE_MAX
"""Bytes of an answer: the replication link takes no larger message than a chunk of a snapshot."""

Order = Callable[[dict[str, Any], int], Awaitable[dict[str, Any]]]
"""Carries one verb out on this robot: its arguments, the uid of the user who gave it → its result."""

OrderOfPeer = Callable[[str, dict[str, Any]], Awaitable[dict[str, Any]]]
"""The same for one that counts as the robot's own, whoever its user is: the robot that gives it, its arguments → its result."""


class Errands:
    """Both ends: orders sent from here, and orders that came from others. Lives in the worker's loop."""

    def __init__(
        self,
        say: Callable[[str, Bulk], object],
        hindrance: Callable[[str], str],
        orders: dict[str, Order],
        of_peers: Mapping[str, OrderOfPeer] = MappingProxyType({}),
    ) -> None:
        """
        Args:
            hindrance: why nothing can be said to a peer now; "" when it can.
            orders: by name, those that another robot may give.
        """
        self._say = say
        self._hindrance = hindrance
        self._orders = orders
        self._of_peers = of_peers
        self._numbers = itertools.count(secrets.randbits(NUMBER_BITS))
        self._waiting: dict[tuple[str, int], asyncio.Future[ErrandDone]] = {}
        self._said: dict[str, deque[tuple[float, ErrandDone]]] = {}
        self._perhaps_unheard: set[str] = set()
        self._under_way: dict[str, set[asyncio.Task[None]]] = {}

    async def send(
        self, peer: str, verb: str, arguments: dict[str, Any], by: int = NOBODY, patience_s: float = PATIENCE_S
    ) -> dict[str, Any]:
        """Have a peer carry an order out, or answer a question.

        Args:
            by: uid of the user who gave the order.

        Raises:
            RefusedError: it cannot be reached; it refused, with its reasons; or its answer did not come.
        """
        if hindrance := self._hindrance(peer):
            raise RefusedError(f"cannot ask {peer}: {hindrance}; ask there, or try again")
        number = next(self._numbers)
        answer: asyncio.Future[ErrandDone] = asyncio.get_running_loop().create_future()
        self._waiting[peer, number] = answer
        try:
            self._say(peer, Errand(number, verb, msgspec.msgpack.encode(arguments), by))
            done = await asyncio.wait_for(answer, patience_s)
        except TimeoutError:
            raise RefusedError(f"{peer} did not answer to {verb} in {patience_s:g} s; see failover status") from None
        finally:
            self._waiting.pop((peer, number), None)
        if done.refusal:
            raise RefusedError(f"{peer}: {done.refusal}", done.kind, done.reasons)
        try:
            return msgspec.msgpack.decode(done.content, type=dict[str, Any])
        except UNDECODABLE as error:
            raise RefusedError(
                f"this robot does not understand the answer of {peer} to {verb}: {error}; same release there?"
            ) from error

    def done(self, peer: str, message: ErrandDone) -> None:
        """A peer has answered."""
        waiting = self._waiting.get((peer, message.number))
        if waiting is not None and not waiting.done():
            waiting.set_result(message)

    def lost(self, peer: str) -> None:
        """The connection has gone: it is not known whether an order arrived, nor an answer."""
        self._perhaps_unheard.add(peer)
        for (robot, number), waiting in self._waiting.items():
            if robot == peer and not waiting.done():
                sentence = "the connection was lost before its answer; failover status tells whether it was done"
                waiting.set_result(ErrandDone(number, b"", sentence))

    def stands(self, peer: str) -> None:
        """There is a connection again: say what may have been lost with the one before. A peer ignores what it has."""
        if peer in self._perhaps_unheard:
            self._perhaps_unheard.discard(peer)
            self._forget_old(peer)
            for _, answer in self._said.get(peer, ()):
                self._say(peer, answer)

    def received(self, peer: str, message: Errand) -> None:
        """A peer gives an order."""
        under_way = self._under_way.setdefault(peer, set())
        if len(under_way) >= UNDER_WAY_MAX:
            self._say(peer, ErrandDone(message.number, b"", f"{UNDER_WAY_MAX} orders of {peer} are under way; wait for them"))
            return
        task = asyncio.create_task(self._carry_out(peer, message))
        under_way.add(task)
        task.add_done_callback(under_way.discard)
        task.add_done_callback(end_worker_on_mistake)

    async def close(self) -> None:
        """Give up the orders under way."""
        tasks = [task for under_way in self._under_way.values() for task in under_way]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _carry_out(self, peer: str, message: Errand) -> None:
        try:
            done = ErrandDone(message.number, msgspec.msgpack.encode(await self._result(peer, message)))
        except RefusedError as refusal:
            done = ErrandDone(message.number, b"", str(refusal), refusal.kind, tuple(refusal.reasons))
        except (*TROUBLE, FailoverError) as trouble:
            done = ErrandDone(message.number, b"", str(trouble) or type(trouble).__name__)
        if len(done.content) > CONTENT_MAX:
            done = ErrandDone(message.number, b"", f"its answer of {len(done.content)} bytes is too long to travel; ask there")
        await self._until_it_can_be_told(peer)
        self._say(peer, done)
        self._said.setdefault(peer, deque()).append((asyncio.get_running_loop().time(), done))
        self._forget_old(peer)

    def _forget_old(self, peer: str) -> None:
        """Of the answers to a peer: those that it awaits no more, and what is too much."""
        said = self._said.get(peer, deque())
        oldest_s = asyncio.get_running_loop().time() - PATIENCE_S
        size = sum(len(answer.content) for _, answer in said)
        while said and (said[0][0] < oldest_s or size > SAID_SIZE_MAX or len(said) > UNDER_WAY_MAX):
            size -= len(said.popleft()[1].content)

    async def _until_it_can_be_told(self, peer: str) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_S):
                while self._hindrance(peer):
                    await asyncio.sleep(LOOK_S)

    async def _result(self, peer: str, message: Errand) -> dict[str, Any]:
        if message.verb in self._of_peers:
            return await self._of_peers[message.verb](peer, _arguments(message))
        if message.verb not in self._orders:
            raise RefusedError(f"no order {message.verb!r} can be given from another robot")
        return await self._orders[message.verb](_arguments(message), message.by)


def _arguments(message: Errand) -> dict[str, Any]:
    try:
        return msgspec.msgpack.decode(message.arguments, type=dict[str, Any])
    except UNDECODABLE as error:
        raise RefusedError(f"the arguments of {message.verb} were not understood: {error}; same release there?") from error
