"""Orders that users give on the page: each is carried out once, those of one user in their order; the log shows all of them.

An order about a component carries the epoch that its user saw. The agent refuses it if the component has another one by then, in
the step in which it would obey (`failover.core.commands`): no order is carried out on a state that its user did not see.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from failover.drivers.proxy import proxy
from failover.errors import AgentRefusedError, FailoverError, LostAgentError
from page.agent_link import ask_once
from page.errors import TurnedAwayError
from page.limits import ORDERS_SHOWN, ORDERS_WAITING_MAX
from page.sessions import Session

LOG: Final = logging.getLogger("failover.page")

CALL: Final = "call"

CALL_S: Final = 10.0
"""How long a driver may take."""

RESULT_SHOWN: Final = 2_000
"""Characters of what a driver returned."""

WITHOUT_EPOCH: Final = ("start",)
"""A new beginning has no epoch yet."""


class Wish(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a client asks for.

    Attributes:
        id: made by the client, another one for each order: one that comes twice is carried out once.
        name: of the component, or the driver's path. to: a robot, for handover, prefer and promote.
        epoch: that the user saw. call, body: a driver's verb and its arguments.
    """

    id: Annotated[str, msgspec.Meta(min_length=8, max_length=64)]
    verb: Literal["handover", "failback", "prefer", "promote", "stop", "start", "release", "call"]
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=300)]
    to: Annotated[str, msgspec.Meta(max_length=64)] = ""
    epoch: Annotated[int, msgspec.Meta(ge=0)] = 0
    call: Annotated[str, msgspec.Meta(max_length=64)] = ""
    body: Any = None


class Order(msgspec.Struct):
    """One order, as the log shows it.

    Attributes:
        at: seconds since 1970. state: waiting, running, done or refused. says: its result, or why not.
    """

    number: int
    at: float
    user: str
    wish: Wish
    uid: int | None
    state: Literal["waiting", "running", "done", "refused"] = "waiting"
    says: str = ""
    took_ms: int | None = None

    def told(self) -> dict[str, Any]:
        """For the clients."""
        wish = self.wish
        what = f"{wish.call} {_brief(wish.body)}".strip() if wish.verb == CALL else wish.to
        fields = {"number": self.number, "at": self.at, "user": self.user, "verb": wish.verb, "name": wish.name, "what": what}
        return fields | {"id": wish.id, "epoch": wish.epoch, "state": self.state, "says": self.says, "took_ms": self.took_ms}


class Orders:
    """Those that wait, and the log. Lives in one loop."""

    def __init__(self, socket: Path | None, changed: Callable[[], None]) -> None:
        """
        Args:
            changed: called when the log is another one.
        """
        self._socket = socket
        self._changed = changed
        self._numbers = itertools.count(1)
        self._queues: dict[tuple[str, int | None], asyncio.Queue[Order]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self.log: OrderedDict[int, dict[str, Any]] = OrderedDict()
        self.ended: Counter[str] = Counter()

    def give(self, session: Session, wish: Wish) -> int:
        """Take an order; its number in the log. It is carried out after the earlier ones of its user.

        Raises:
            TurnedAwayError: the session gives too many, or too many of this user wait.
        """
        if (known := session.given(wish.id)) is not None:
            return known
        if wait_s := session.orders.wait_s():
            raise TurnedAwayError(429, "too many orders in a short time; this one was not taken", wait_s)
        whose = (session.user, session.uid)
        queue = self._queues.get(whose)
        if queue is None:
            queue = self._queues[whose] = asyncio.Queue(ORDERS_WAITING_MAX)
            task = asyncio.create_task(self._carry_out(whose, queue))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        order = Order(next(self._numbers), time.time(), session.user, wish, session.uid)
        try:
            queue.put_nowait(order)
        except asyncio.QueueFull:
            raise TurnedAwayError(429, f"{ORDERS_WAITING_MAX} orders of {session.user} wait already", 1) from None
        session.note(wish.id, order.number)
        LOG.info("order %d of %s: %s %s %s", order.number, session.user, wish.verb, wish.name, wish.to or wish.call)
        self._tell(order)
        return order.number

    async def close(self) -> None:
        """Carry nothing more out."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def risks(self, session: Session, name: str, robot: str) -> dict[str, Any]:
        """What ``promote`` would risk; nothing is done.

        Raises:
            AgentRefusedError, NoAgentError, LostAgentError: as `page.agent_link.ask_once`.
        """
        return await ask_once(self._socket, "promote", session.uid, name=name, robot=robot, sure=False)

    async def _carry_out(self, whose: tuple[str, int | None], queue: asyncio.Queue[Order]) -> None:
        """All orders of one user, one after the other; ends when there is none."""
        while not queue.empty():
            order = queue.get_nowait()
            order.state, began_s = "running", time.monotonic()
            self._tell(order)
            try:
                order.says, order.state = await self._done(order), "done"
            except LostAgentError as error:
                order.says, order.state = f"{error}; whether it was carried out is not known: look at the tree", "refused"
            except FailoverError as error:
                order.says, order.state = str(error), "refused"
            order.took_ms = round((time.monotonic() - began_s) * 1000)
            self.ended[order.state] += 1
            LOG.info("order %d is %s: %s", order.number, order.state, order.says)
            self._tell(order)
        del self._queues[whose]

    async def _done(self, order: Order) -> str:
        """Carry one out; what came of it.

        Raises:
            FailoverError: it was refused, or its end is not known; says which.
        """
        wish = order.wish
        if wish.verb == CALL:
            return await self._call(order)
        arguments: dict[str, Any] = {"name": wish.name}
        if wish.verb not in WITHOUT_EPOCH:
            arguments["epoch"] = wish.epoch
        if wish.verb == "handover":
            arguments["to"] = wish.to
        if wish.verb in ("prefer", "promote"):
            arguments["robot"] = wish.to
        if wish.verb == "promote":
            arguments["sure"] = True
        return _sentence(wish, await ask_once(self._socket, wish.verb, order.uid, **arguments))

    async def _call(self, order: Order) -> str:
        """Have a driver carry a verb out, if the rules let this user."""
        wish = order.wish
        may = await ask_once(self._socket, "may", order.uid, rights=[CALL], paths=[wish.name])
        if because := may["answers"][CALL][wish.name]:
            raise AgentRefusedError(because, "PermissionError")
        return _brief(await asyncio.to_thread(_called, wish))

    def _tell(self, order: Order) -> None:
        self.log[order.number] = order.told()
        while len(self.log) > ORDERS_SHOWN:
            self.log.popitem(last=False)
        self._changed()


def _called(wish: Wish) -> Any:
    """What the driver returns."""
    with proxy(wish.name) as driver:
        return driver.call(wish.call, wish.body, timeout=CALL_S)


def _brief(value: Any) -> str:
    """A value as people write it; "" for none."""
    if value is None:
        return ""
    text = msgspec.json.encode(value, enc_hook=str).decode(errors="replace")
    return text if len(text) <= RESULT_SHOWN else f"{text[:RESULT_SHOWN]}…"


def _sentence(wish: Wish, told: Mapping[str, Any]) -> str:
    if wish.verb == "stop":
        return f"it has ended, exit status {told.get('exit_status')}"
    if wish.verb == "start":
        return f"it runs at {told.get('robot')}"
    if wish.verb == "release":
        return "it is protected no longer"
    if wish.verb == "prefer":
        return f"it prefers {told.get('robot')}"
    return str(told.get("sentence") or f"it runs at {told.get('to')}, epoch {told.get('epoch')}")
