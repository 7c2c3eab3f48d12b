"""Orders: taken once, in the order of their user, up to limits and while they are fresh; others see no result of them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from page import orders as module
from page.errors import TurnedAwayError
from page.limits import (
    IDS_REMEMBERED,
    ORDER_AGE_MAX_S,
    ORDER_WAITS_MAX_S,
    ORDERS_AT_ONCE,
    ORDERS_SHOWN,
    ORDERS_WAITING_MAX,
    USERS_REMEMBERED,
)
from page.orders import BOOT, Order, Orders, Wish
from page.sessions import Session

NOWHERE = Path("/nowhere/control.sock")


def wish(number: int, **fields: Any) -> Wish:
    return Wish(**{"id": f"wish-{number:04}", "verb": "stop", "name": "/lab/x", "boot": BOOT} | fields)


def given(session: Session, orders: Orders, count: int, first: int = 0) -> TurnedAwayError | None:
    """Give so many at once; the refusal of the first that was not taken."""
    for number in range(first, first + count):
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
        while any(one["state"] in ("waiting", "running") for one, _ in orders.log.values()):
            await asyncio.sleep(0.001)
        assert all("cannot reach the agent" in one["says"] for one, _ in orders.log.values())
        await orders.close()

    asyncio.run(run())


def test_an_order_that_comes_twice_has_one_number() -> None:
    def body(orders: Orders) -> None:
        session = Session("anna", None)
        assert {orders.give(session, wish(1)) for _ in range(3)} == {1} and orders.give(session, wish(2)) == 2
        assert orders.give(Session("anna", None), wish(1)) == 1, "the same user after another login"
        assert orders.give(Session("ben", None), wish(1)) == 3, "another user's"
        assert orders.give(Session("anna", 1000), wish(1)) == 4, "another account's"

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
        windows = range(ORDERS_WAITING_MAX // ORDERS_AT_ONCE + 1)
        refusals = [given(Session("anna", None), orders, ORDERS_AT_ONCE, 1000 * window) for window in windows]
        assert refusals[-1] is not None and f"{ORDERS_WAITING_MAX} orders of anna wait" in str(refusals[-1])
        assert len(orders.log) == ORDERS_WAITING_MAX

    with_orders(body)


def test_the_log_forgets_the_oldest() -> None:
    async def run() -> None:
        orders = Orders(NOWHERE, lambda: None)
        for number in range(ORDERS_SHOWN + 10):
            orders.give(Session("anna", None), wish(number))
            while orders.log[next(reversed(orders.log))][0]["state"] != "refused":
                await asyncio.sleep(0)
        assert list(orders.log) == list(range(11, ORDERS_SHOWN + 11))
        await orders.close()

    asyncio.run(run())


def test_an_order_for_the_page_before_a_restart_and_one_that_is_old_are_not_taken() -> None:
    def body(orders: Orders) -> None:
        session = Session("anna", None)
        with pytest.raises(TurnedAwayError, match="whether this order was carried out is not known") as refused:
            orders.give(session, wish(1, boot="before"))
        assert refused.value.status == 409 and refused.value.again_s == 0, "sending it again does not help"
        orders.give(session, wish(2))
        assert orders.give(session, wish(2, age_ms=ORDER_AGE_MAX_S * 2000)) == 1, "taken before"
        with pytest.raises(TurnedAwayError, match="is 30 s old and was not taken"):
            orders.give(session, wish(3, age_ms=ORDER_AGE_MAX_S * 2000))
        assert list(orders.log) == [1]

    with_orders(body)


def test_an_order_that_has_waited_long_is_not_carried_out(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        orders = Orders(NOWHERE, lambda: None)
        late = Order(1, 0.0, "anna", wish(1), None)
        late.taken_s -= ORDER_WAITS_MAX_S + 1
        await orders._carry_out_one(late)
        assert late.state == "refused" and "behind earlier orders, and was not carried out" in late.says

    asyncio.run(run())


def test_orders_of_a_user_are_remembered_up_to_a_limit() -> None:
    async def run() -> None:
        orders = Orders(NOWHERE, lambda: None)
        for number in range(IDS_REMEMBERED + 1):
            orders._remember(("anna", None), Order(number, 0.0, "anna", wish(number), None))
        assert "wish-0000" not in orders._known["anna", None] and "wish-0001" in orders._known["anna", None]
        for number in range(USERS_REMEMBERED):
            orders._remember(("user", number), Order(number, 0.0, "user", wish(number), None))
        assert ("anna", None) not in orders._known and len(orders._known) == USERS_REMEMBERED

    asyncio.run(run())


def test_a_mistake_of_the_page_ends_one_order_and_not_those_behind_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def run() -> None:
        orders = Orders(NOWHERE, lambda: None)
        monkeypatch.setattr(module, "ask_once", None)  # no function: calling it is the mistake
        session = Session("anna", None)
        orders.give(session, wish(1))
        while orders.log[1][0]["state"] != "refused":
            await asyncio.sleep(0)
        monkeypatch.undo()
        orders.give(session, wish(2))
        while orders.log[2][0]["state"] != "refused":
            await asyncio.sleep(0)
        assert "a mistake in the page" in orders.log[1][0]["says"] and "cannot reach the agent" in orders.log[2][0]["says"]
        await orders.close()

    asyncio.run(run())
    assert "order 1: a mistake in the page" in caplog.text


def test_other_users_and_the_log_are_told_no_argument_and_no_result(caplog: pytest.LogCaptureFixture) -> None:
    def body(orders: Orders) -> None:
        orders.give(Session("anna", None), wish(1))

    with caplog.at_level(logging.INFO, "failover.page"):
        with_orders(body)
    assert "order 1 is refused" in caplog.text and "cannot reach" not in caplog.text
    order = Order(1, 0.0, "anna", wish(1, verb="call", call="note", body={"pin": 1234}), None, says="swordfish")
    assert "1234" in str(order.told()) and "swordfish" in str(order.told())
    assert order.told_others()["what"] == "note"
    assert "1234" not in str(order.told_others()) and "swordfish" not in str(order.told_others())


@pytest.mark.parametrize("field", ["id", "name", "to"])
def test_a_name_cannot_begin_a_line_of_the_log(field: str) -> None:
    fields = {"id": "wish-0001", "verb": "stop", "name": "/lab/x", "boot": BOOT}
    for text in ("order\n12 of root", "order\r12345", "order\x1b[2J99", "order\u2028 123"):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(fields | {field: text}, Wish)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(fields | {"call": "a b"}, Wish)
    assert msgspec.convert(fields | {"name": "/labör/x y"}, Wish).name == "/labör/x y"
