"""Snapshots that come in, and the instant from which a robot writes the component's output itself."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any, cast

from agent.deposit import Deposit
from agent.places import Places
from checkpoint.errors import StoreError
from checkpoint.model import Position
from failover.core.acts import Admit
from failover.core.events import StoreFailed
from failover.core.messages import Offer
from failover.core.types import ComponentSpec

NAME = "/lab/mapper"


class Nursery:
    """Starts nothing."""

    def expect(self, count: int) -> None:
        """Not here."""


class Storing(Deposit):
    """Its disk takes as long as the test wants, and then refuses."""

    def __init__(self, directory: Path) -> None:
        none = cast(Any, None)
        super().__init__(none, Places(directory, directory, cast(Any, Nursery())), lambda _: None, none)
        self.begun, self.may_end, self.stored = threading.Event(), threading.Event(), 0

    def _put(self, offer: Offer, descriptor: int) -> Any:
        self.begun.set()
        assert self.may_end.wait(60)
        self.stored += 1
        raise StoreError("the disk is full")


def test_whoever_takes_over_waits_for_the_snapshot_that_is_being_stored_and_for_no_other(tmp_path: Path) -> None:
    """Storing one ends with its output in the log, which is the new copy's from then on."""

    async def run() -> None:
        deposit = Storing(tmp_path)
        offer = Offer(1, NAME, 1, Position(64, 1, b"d"), None, 1, b"", ComponentSpec(NAME))
        deposit.admit(Admit(NAME, 1, "robot1"))
        taken = [asyncio.create_task(deposit.take("robot1", offer, -1)) for _ in range(2)]
        await asyncio.to_thread(deposit.begun.wait, 60)
        deposit.admit(Admit(NAME, 2, ""))
        settled = asyncio.create_task(deposit.settled(NAME))
        await asyncio.sleep(0)
        assert not settled.done()
        deposit.may_end.set()
        await settled
        await asyncio.gather(*taken)
        assert deposit.stored == 1, "the second had not begun, and is refused"

    asyncio.run(run())


def test_whose_snapshots_they_were_is_known_after_the_claim_that_ends_their_admission(tmp_path: Path) -> None:
    """So that an outage is counted from the last word of that robot."""
    deposit = Storing(tmp_path)
    assert deposit.last_sender(NAME) == ""
    deposit.admit(Admit(NAME, 1, "robot1"))
    deposit.admit(Admit(NAME, 2, ""))
    assert deposit.last_sender(NAME) == "robot1"


def test_a_snapshot_whose_facts_are_no_facts_is_refused_by_name(tmp_path: Path) -> None:
    """From a peer that may send it; the lanes go on."""
    told: list[Any] = []

    class Reading(Deposit):
        def _put(self, offer: Offer, descriptor: int) -> Any:
            return {}["flags"]

    async def run() -> None:
        none = cast(Any, None)
        deposit = Reading(none, Places(tmp_path, tmp_path, cast(Any, Nursery())), told.append, none)
        deposit.admit(Admit(NAME, 1, "robot1"))
        await deposit.take("robot1", Offer(1, NAME, 1, Position(64, 1, b"d"), None, 1, b"", ComponentSpec(NAME)), -1)

    asyncio.run(run())
    (failed,) = told
    assert isinstance(failed, StoreFailed)
    assert failed.sender == "robot1"
    assert f"cannot keep a snapshot of {NAME} from robot1: its snapshot says something" in failed.message
