"""A driver that was replaced handles nothing more: it says `moved`, and its callers go to the copy of the later epoch."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

import failover
from failover.core.messaging.envelope import Envelope, answer
from failover.core.messaging.mailbox import Mailbox, Outbox
from failover.core.naming.scan import SECOND, Terms
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.drivers.server import Serving
from tests.failover.drivers.serving import LIMIT_S, Lab, taking_messages, until

TERMS = Terms(scan_ns=SECOND)


@failover.driver("Lab/Arm", alias="arm")
class Arm:
    def __init__(self) -> None:
        self.heard: list[int] = []
        self.robot = ""

    @failover.command
    def move(self, number: int) -> int:
        self.heard.append(number)
        return number

    @failover.stream(rate_hz=100)
    def where(self) -> str:
        return self.robot


@pytest.fixture
def lab(folder: Path) -> Lab:
    return Lab(folder, "robot1", "robot2")


class Primacy:
    """The epoch of one copy, as its environment says it."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def __call__(self) -> int:
        return self.epoch


@contextlib.contextmanager
def arm(here: Here, epoch: int) -> Iterator[tuple[Serving, Primacy]]:
    primacy = Primacy(epoch)
    with taking_messages(Serving(Arm, here, TERMS, primacy)) as one:
        one.instance.robot = here.robot
        yield one, primacy


def is_fenced(one: Serving) -> bool:
    return bool(one._fence(0))


@pytest.mark.parametrize("caller", ["robot1", "robot2"])
def test_after_a_split_callers_of_the_old_copy_go_to_the_one_of_the_later_epoch(lab: Lab, caller: str) -> None:
    with arm(lab.here("robot1"), 1) as (old, _), Proxy(lab.here(caller), lookup(lab.here(caller), "arm")) as proxy:
        assert [proxy.call("move", number=number, timeout=LIMIT_S) for number in (1, 2)] == [1, 2]
        with arm(lab.here("robot2"), 2) as (new, _):
            until(lambda: is_fenced(old))
            done = [proxy.post("move", number=number) for number in range(3, 100)]
            assert [one.result(LIMIT_S) for one in done] == list(range(3, 100))
            assert old.instance.heard == [1, 2] and new.instance.heard == list(range(3, 100))
            assert proxy.place.robot == "robot2" and not is_fenced(new)
            assert lookup(lab.here("robot1"), "arm").robot == "robot2", "the higher epoch, not the lesser name"


@pytest.mark.parametrize("caller", ["robot1", "robot2"])
@pytest.mark.parametrize("is_split", [True, False], ids=["replaced", "ended"])
def test_a_stream_goes_on_at_the_copy_of_the_later_epoch(lab: Lab, caller: str, is_split: bool) -> None:
    with contextlib.ExitStack() as first:
        old, _ = first.enter_context(arm(lab.here("robot1"), 1))
        with Proxy(lab.here(caller), lookup(lab.here(caller), "arm")) as proxy:
            values = proxy.stream("where")
            until(lambda: next(values) == "robot1")
            if not is_split:
                first.close()
            with arm(lab.here("robot2"), 2):
                until(lambda: next(values) == "robot2")
                assert {next(values) for _ in range(20)} == {"robot2"}
                if is_split:
                    until(lambda: not old._actor._subscribers)
                values.close()  # type: ignore[attr-defined]


def test_a_message_that_names_a_later_epoch_is_refused_before_the_names_tell_of_it(lab: Lab) -> None:
    with arm(lab.here("robot1"), 1) as (old, _), Proxy(lab.here("robot1"), lookup(lab.here("robot1"), "arm")) as proxy:
        assert proxy.call("move", number=1, timeout=LIMIT_S) == 1
        proxy._sending._epoch = 2  # it has heard of it
        with pytest.raises(failover.NoAnswerError):
            proxy.call("move", number=2, timeout=0.5)
        assert old.instance.heard == [1]


def test_the_copy_that_stays_under_a_renewed_epoch_is_called_again(lab: Lab) -> None:
    with arm(lab.here("robot1"), 1) as (old, primacy), arm(lab.here("robot2"), 2) as (new, _):
        until(lambda: is_fenced(old))
        with Proxy(lab.here("robot1"), lookup(lab.here("robot1"), "arm")) as proxy:
            assert proxy.call("move", number=1, timeout=LIMIT_S) == 1
            primacy.epoch = 3  # as its agent writes it into its environment, when the robots have met again
            old.service.look()
            until(lambda: is_fenced(new))
            assert proxy.call("move", number=2, timeout=LIMIT_S) == 2
        assert (old.instance.heard, new.instance.heard) == ([2], [1])


def test_what_waits_in_a_mailbox_that_is_given_back_comes_again_as_if_it_had_never_come() -> None:
    outbox, box = Outbox("s", 1), Mailbox()
    for number in range(1, 4):
        outbox.post(Envelope("arm", "move", number, reliable=True), 0)
    outbox.committed()
    sent = outbox.due(0)
    for one in (sent[0], sent[1], msgspec.structs.replace(sent[2], seq=4, after=3)):
        box.arrived(one, 0)
    first = box.take(0)
    assert first is not None
    box.done(first, answer(first, 1))
    box.committed()
    assert [one.seq for one in box.give_back()] == [2, 4] and len(box) == 0
    assert box.arrived(sent[2], 0) == [] and box.take(0) is None, "the one before it must come again"
    box.arrived(sent[1], 0)
    assert [box.take(0).seq for _ in range(2)] == [2, 3]  # type: ignore[union-attr]


def test_a_stale_copy_that_says_moved_under_its_lower_epoch_is_believed(lab: Lab) -> None:
    with arm(lab.here("robot1"), 1) as (old, _), Proxy(lab.here("robot1"), lookup(lab.here("robot1"), "arm")) as proxy:
        assert proxy.call("move", number=1, timeout=LIMIT_S) == 1
        proxy._sending._epoch = 2  # it has heard of it
        looked: list[int] = []
        proxy._sending._moved = lambda: looked.append(1)  # type: ignore[method-assign]
        with pytest.raises(failover.NoAnswerError):
            proxy.call("move", number=2, timeout=0.2)
        assert looked and old.instance.heard == [1]


def test_a_stale_copy_asks_no_rights_but_says_that_it_has_moved(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    with arm(lab.here("robot1"), 1) as (old, _), Proxy(lab.here("robot1"), lookup(lab.here("robot1"), "arm")) as proxy:
        assert proxy.call("move", number=1, timeout=LIMIT_S) == 1
        monkeypatch.setattr(old._rights, "refusal", lambda *_: "no rule gives it")
        with arm(lab.here("robot2"), 2) as (new, _):
            until(lambda: is_fenced(old))
            assert proxy.call("move", number=2, timeout=LIMIT_S) == 2
            assert (old.instance.heard, new.instance.heard) == ([1], [2])


def test_a_driver_without_an_epoch_looks_for_no_rival_until_it_has_one(lab: Lab) -> None:
    with arm(lab.here("robot1"), 0) as (old, primacy), arm(lab.here("robot2"), 2):
        until(lambda: len(old.service.tree().claimants("Lab/Arm")) == 2)
        old.service._find_rival()
        assert old.service.rival is None and not is_fenced(old)
        primacy.epoch = 1
        old.service.look()
        until(lambda: is_fenced(old))
