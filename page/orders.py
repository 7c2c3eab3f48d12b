"""Orders that users give on the page: each is carried out once, those of one user in their order; the log shows all of them.

An order about a component carries the epoch that its user saw. The agent refuses it if the component has another one by then, in
the step in which it would obey (`failover.core.commands`): no order is carried out on a state that its user did not see.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import secrets
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from failover.core.naming.tree import Place
from failover.drivers.here import Here, here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import AgentRefusedError, FailoverError, LostAgentError
from page.agent_link import ask_once
from page.errors import TurnedAwayError
from page.limits import (
    IDS_REMEMBERED,
    ORDER_AGE_MAX_S,
    ORDER_S,
    ORDER_WAITS_MAX_S,
    ORDERS_SHOWN,
    ORDERS_WAITING_MAX,
    USERS_REMEMBERED,
)
from page.sessions import Session

LOG: Final = logging.getLogger("failover.page")

BOOT: Final = secrets.token_urlsafe(9)
"""Of this process: it remembers which orders it has taken, and a process before it has taken others."""

CALL: Final = "call"

ONE_LINE: Final = r"\A[^\x00-\x1f\x7f-\x9f\u2028\u2029]*\Z"
"""No control characters: names are written into the log, a line each."""

CALL_S: Final = 10.0
"""How long a driver may take."""

RESULT_SHOWN: Final = 2_000
"""Characters of what a driver returned."""

WITHOUT_EPOCH: Final = ("start", "reserve", "unreserve")
"""A new beginning has no epoch yet; a reservation is about all of them."""


class Wish(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a client asks for.

    Attributes:
        id: made by the client, another one for each order: one that comes twice is carried out once.
        name: of the component, or the driver's path. to: a robot, for handover, prefer and promote.
            For failback the robot that the user saw as its target, "" for any.
        epoch: that the user saw. call, body: a driver's verb and its arguments.
        boot: `BOOT` of the page's process that the client knows. age_ms: since its user gave the order.
    """

    id: Annotated[str, msgspec.Meta(min_length=8, max_length=64, pattern=ONE_LINE)]
    verb: Literal["handover", "failback", "prefer", "promote", "stop", "start", "release", "reserve", "unreserve", "call"]
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=300, pattern=ONE_LINE)]
    boot: Annotated[str, msgspec.Meta(max_length=64)]
    to: Annotated[str, msgspec.Meta(max_length=64, pattern=ONE_LINE)] = ""
    epoch: Annotated[int, msgspec.Meta(ge=0)] = 0
    age_ms: Annotated[float, msgspec.Meta(ge=0)] = 0
    call: Annotated[str, msgspec.Meta(max_length=64, pattern=r"\A\w*\Z")] = ""
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
    taken_s: float = msgspec.field(default_factory=time.monotonic)

    def told(self) -> dict[str, Any]:
        """For the clients of its user."""
        wish = self.wish
        what = f"{wish.call} {_brief(wish.body)}".strip() if wish.verb == CALL else wish.to
        fields = {"number": self.number, "at": self.at, "user": self.user, "verb": wish.verb, "name": wish.name, "what": what}
        return fields | {"id": wish.id, "epoch": wish.epoch, "state": self.state, "says": self.says, "took_ms": self.took_ms}

    def told_others(self) -> dict[str, Any]:
        """For other users: without a driver's arguments, and without the result, which may hold an answer or output."""
        return self.told() | {"what": self.wish.call or self.wish.to, "says": ""}


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
        self._known: OrderedDict[tuple[str, int | None], OrderedDict[str, int]] = OrderedDict()
        self.log: OrderedDict[int, tuple[dict[str, Any], dict[str, Any]]] = OrderedDict()
        """Number → the order as its user may see it, and as others may."""
        self.ended: Counter[str] = Counter()

    def give(self, session: Session, wish: Wish) -> int:
        """Take an order; its number in the log. It is carried out after the earlier ones of its user.

        Raises:
            TurnedAwayError: it is for another process or too old; the session gives too many, or too many of this user wait.
        """
        whose = (session.user, session.uid)
        if wish.boot != BOOT:
            raise TurnedAwayError(409, "the page was started again meanwhile: whether this order was carried out is not known")
        taken = self._known.get(whose)
        if taken is not None and wish.id in taken:
            return taken[wish.id]
        if wish.age_ms > ORDER_AGE_MAX_S * 1000:
            raise TurnedAwayError(
                409, f"this order is {wish.age_ms / 1000:.0f} s old and was not taken; look again, and give it anew"
            )
        if wait_s := session.orders.wait_s():
            raise TurnedAwayError(429, "too many orders in a short time; this one was not taken", wait_s)
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
        self._remember(whose, order)
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
        try:
            while not queue.empty():
                await self._carry_out_one(queue.get_nowait())
        finally:
            del self._queues[whose]

    async def _carry_out_one(self, order: Order) -> None:
        order.state, began_s = "running", time.monotonic()
        self._tell(order)
        try:
            order.says, order.state = await self._done(order), "done"
        except LostAgentError as error:
            order.says, order.state = f"{error}; whether it was carried out is not known: look at the tree", "refused"
        except FailoverError as error:
            order.says, order.state = str(error), "refused"
        except Exception:
            LOG.exception("order %d: a mistake in the page", order.number)
            order.says = "a mistake in the page, see its log; whether it was carried out is not known: look at the tree"
            order.state = "refused"
        order.took_ms = round((time.monotonic() - began_s) * 1000)
        self.ended[order.state] += 1
        LOG.info("order %d is %s", order.number, order.state)
        self._tell(order)

    async def _done(self, order: Order) -> str:
        """Carry one out; what came of it.

        Raises:
            FailoverError: it was refused, or its end is not known; says which.
        """
        wish = order.wish
        if (waited_s := time.monotonic() - order.taken_s) > ORDER_WAITS_MAX_S:
            raise TurnedAwayError(
                409, f"it has waited {waited_s:.0f} s behind earlier orders, and was not carried out; look again"
            )
        if wish.verb == CALL:
            return await self._call(order)
        arguments: dict[str, Any] = {"name": wish.name}
        if wish.verb not in WITHOUT_EPOCH:
            arguments["epoch"] = wish.epoch
        if wish.verb in ("handover", "failback"):
            arguments["to"] = wish.to
        if wish.verb in ("prefer", "promote"):
            arguments["robot"] = wish.to
        if wish.verb == "promote":
            arguments["sure"] = True
        if wish.verb == "reserve":
            asked = wish.body if isinstance(wish.body, dict) else {}
            arguments |= {"span_ms": asked.get("span_ms"), "why": asked.get("why")}
        return _sentence(wish, await ask_once(self._socket, wish.verb, order.uid, within_s=ORDER_S, **arguments))

    async def _call(self, order: Order) -> str:
        """Have a driver carry a verb out, if the rules let this user. Rules are about paths, so no other name is taken."""
        wish = order.wish
        our, place = await asyncio.to_thread(_found, wish.name)
        if place.record.path != wish.name:
            raise AgentRefusedError(
                f"{wish.name} is no path of a driver: call it by its path, {place.record.path}", "PermissionError"
            )
        may = await ask_once(self._socket, "may", order.uid, rights=["see", CALL], paths=[wish.name])
        for right in ("see", CALL):
            if because := may["answers"][right][wish.name]:
                raise AgentRefusedError(because, "PermissionError")
        return _brief(await asyncio.to_thread(_called, our, place, wish))

    def _remember(self, whose: tuple[str, int | None], order: Order) -> None:
        """Know the order again, in whatever session of its user."""
        known = self._known.setdefault(whose, OrderedDict())
        self._known.move_to_end(whose)
        known[order.wish.id] = order.number
        if len(known) > IDS_REMEMBERED:
            known.popitem(last=False)
        if len(self._known) > USERS_REMEMBERED:
            self._known.popitem(last=False)

    def _tell(self, order: Order) -> None:
        self.log[order.number] = order.told(), order.told_others()
        while len(self.log) > ORDERS_SHOWN:
            self.log.popitem(last=False)
        self._changed()


def _found(name: str) -> tuple[Here, Place]:
    """The driver that answers to a name."""
    our = here()
    return our, lookup(our, name)


def _called(our: Here, place: Place, wish: Wish) -> Any:
    """What the driver at that place returns."""
    with Proxy(our, place) as driver:
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
