"""Orders: taken once, in the order of their user, up to limits; the log forgets the oldest."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from page.errors import TurnedAwayError
from page.limits import ORDERS_AT_ONCE, ORDERS_SHOWN, ORDERS_WAITING_MAX
from page.orders import Orders, Wish
from page.sessions import Session

NOWHERE = Path("/nowhere/control.sock")


def wish(number: int) -> Wish:
    return Wish(f"wish-{number:04}", "stop", "/lab/x")


def given(session: Session, orders: Orders, count: int) -> TurnedAwayError | None:
    """Give so many at once; the refusal of the first that was not taken."""
    for number in range(count):
        try:
            orders.give(session, wish(number))
        except TurnedAwayError as error:
            return error
    return None


def with_orders(body: Callable[[Orders], object]) -> None:
    """In a loop, with an agent that is not there."""

    async def run() -> None:
        orders = Orders(NOWHERE, lambda: None)
        body(orders)
        while any(one["state"] in ("waiting", "running") for one in orders.log.values()):
            await asyncio.sleep(0.001)
        assert all("cannot reach the agent" in one["says"] for one in orders.log.values())
        await orders.close()

    asyncio.run(run())


def test_an_order_that_comes_twice_has_one_number() -> None:
    def body(orders: Orders) -> None:
        session = Session("anna", None)
        assert {orders.give(session, wish(1)) for _ in range(3)} == {1} and orders.give(session, wish(2)) == 2
        assert orders.give(Session("ben", None), wish(1)) == 3, "another session's"

    with_orders(body)


def test_too_many_at_once_are_told_when_to_come_again_and_not_taken() -> None:
    def body(orders: Orders) -> None:
        refused = given(Session("anna", None), orders, ORDERS_AT_ONCE + 1)
        assert refused is not None and refused.status == 429 and refused.again_s > 0
        assert len(orders.log) == ORDERS_AT_ONCE
        assert orders.give(Session("ben", None), wish(0)) > 0, "no user shuts another out"

    with_orders(body)


def test_so_many_of_one_user_wait_whatever_the_number_of_windows() -> None:
    def body(orders: Orders) -> None:
        refusals = [given(Session("anna", None), orders, ORDERS_AT_ONCE) for _ in range(ORDERS_WAITING_MAX // ORDERS_AT_ONCE + 1)]
        assert refusals[-1] is not None and f"{ORDERS_WAITING_MAX} orders of anna wait" in str(refusals[-1])
        assert len(orders.log) == ORDERS_WAITING_MAX

    with_orders(body)


def test_the_log_forgets_the_oldest() -> None:
    async def run() -> None:
        orders = Orders(NOWHERE, lambda: None)
        for number in range(ORDERS_SHOWN + 10):
            orders.give(Session("anna", None), wish(number))
            while orders.log[next(reversed(orders.log))]["state"] != "refused":
                await asyncio.sleep(0)
        assert list(orders.log) == list(range(11, ORDERS_SHOWN + 11))
        await orders.close()

    asyncio.run(run())
