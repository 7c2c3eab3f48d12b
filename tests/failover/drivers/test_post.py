"""Messages that a program posts without waiting: in order, from a queue with a limit, over deaths of the driver."""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
import zmq

from failover.core.messaging.mailbox import FLIGHT_MAX, MAILBOX_MAX
from failover.core.naming.tree import Place
from failover.drivers import route
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.drivers.name_service import new_boot
from failover.drivers.proxy import Proxy
from failover.drivers.server import Serving
from failover.errors import CallRefusedError, DriverError, EnvelopeError, MailboxFullError, NameAmbiguousError, NoAnswerError
from tests.failover.drivers.devices import Engine
from tests.failover.drivers.serving import LIMIT_S, called, serving, until
from tests.failover.drivers.test_kept import counter, reached


@contextlib.contextmanager
def shut(here: Here) -> Iterator[Serving]:
    """An engine that stands in its first command until its gate is opened, at the end of the body at the latest."""
    with serving(Engine, here) as engine:
        engine.instance.gate.clear()
        try:
            yield engine
        finally:
            engine.instance.gate.set()


def test_posts_and_calls_of_one_proxy_are_carried_out_in_order(here: Here) -> None:
    with serving(Engine, here) as engine, called(here, "engine") as proxy:
        proxy.call("set", duty=0.0)
        done = [proxy.post("set", duty=number / 1_000) for number in range(1, 301)]
        assert proxy.call("read", timeout=LIMIT_S) == {"duty": 0.3}
        assert [one.result(LIMIT_S) for one in done] == [None] * 300
        assert engine.instance.heard == [number / 1_000 for number in range(301)]


def test_what_is_refused_is_told_by_its_future_and_the_next_goes_on(here: Here) -> None:
    with serving(Engine, here), called(here, "engine") as proxy:
        wrong, right = proxy.post("set", duty=7), proxy.post("set", duty=0.5)
        with pytest.raises(CallRefusedError, match="<= 1"):
            wrong.result(LIMIT_S)
        assert right.result(LIMIT_S) is None and not right.cancel()
        with pytest.raises(EnvelopeError):
            proxy.post("set", duty=object())


def test_a_full_queue_takes_no_more_and_goes_on_when_there_is_room(here: Here) -> None:
    with shut(here) as engine, Proxy(here, lookup(here, "engine"), queue=100) as proxy:
        done = [proxy.post("set", duty=0.1) for _ in range(100)]
        with pytest.raises(MailboxFullError, match="100 messages to Lab/Robotino/Engines/3/PWM wait"):
            proxy.post("set", duty=0.2)
        until(lambda: proxy._sending._left == FLIGHT_MAX)
        assert proxy._sending._outbox.left == FLIGHT_MAX, "a sender leaves room for others"
        engine.instance.gate.set()
        assert [one.result(LIMIT_S) for one in done] == [None] * 100
        assert proxy.post("set", duty=0.2).result(LIMIT_S) is None
        assert engine.instance.heard == [0.1] * 100 + [0.2]
    with pytest.raises(DriverError, match=r"queue=0 .* from 1 to 1024"):
        Proxy(here, proxy.place, queue=0)


def test_several_senders_with_full_queues_get_all_through_one_mailbox(here: Here) -> None:
    done: list[Future[Any]] = []
    senders = MAILBOX_MAX // FLIGHT_MAX + 1

    def send() -> None:
        with Proxy(here, place) as proxy:
            done.extend([proxy.post("set", duty=0.1) for _ in range(2 * FLIGHT_MAX)])
            proxy.flush(LIMIT_S)

    with serving(Engine, here) as engine:
        place = lookup(here, "engine")
        threads = [threading.Thread(target=send) for _ in range(senders)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert all(one.result(0) is None for one in done)
        assert len(engine.instance.heard) == len(done) == senders * 2 * FLIGHT_MAX


def test_what_waits_for_a_driver_longer_than_its_deadline_expires_and_the_rest_arrives_in_order(here: Here) -> None:
    with serving(Engine, here):
        place = lookup(here, "engine")
    with Proxy(here, place) as proxy:
        short = proxy.post("set", duty=0.1, deadline_s=0.05)
        long = [proxy.post("set", duty=number / 10) for number in range(2, 5)]
        with pytest.raises(CallRefusedError, match="deadline passed while it waited to be sent; it was not handled") as refused:
            short.result(LIMIT_S)
        assert refused.value.kind == "expired" and not any(one.done() for one in long)
        with serving(Engine, here) as engine:
            proxy.flush(LIMIT_S)
            assert engine.instance.heard == [0.2, 0.3, 0.4]


def test_what_has_no_answer_when_the_proxy_is_closed_is_told_so(here: Here) -> None:
    with shut(here):
        proxy = called(here, "engine")
        done = [proxy.post("set", duty=0.1) for _ in range(FLIGHT_MAX + 1)]
        until(lambda: proxy._sending._left == FLIGHT_MAX)
        with pytest.raises(NoAnswerError, match=f"{FLIGHT_MAX + 1} messages that were posted .* within 0.01 s"):
            proxy.flush(0.01)
        with pytest.raises(NoAnswerError, match="did not answer 'read'"):
            proxy.call("read", timeout=0.01)
        proxy.close()
        with pytest.raises(NoAnswerError, match="the proxy was closed; it may have been carried out"):
            done[0].result(0)
        with pytest.raises(NoAnswerError, match="it has not left"):
            done[-1].result(0)
        with pytest.raises(DriverError, match="the proxy is closed"):
            proxy.post("set", duty=0.1)
        proxy.close()


def test_a_program_that_is_started_again_is_not_overtaken_by_what_its_process_before_has_sent(here: Here) -> None:
    with serving(Engine, here) as engine:
        place = lookup(here, "engine")
        old = Proxy(here, place, sender="mission")
        old.call("set", duty=0.1)
        boot = new_boot()
        until(lambda: new_boot() > boot)
        new = Proxy(here, place, sender="mission")
        new.call("set", duty=0.2)
        with pytest.raises(CallRefusedError, match="was started again"):
            old.call("set", duty=0.3, timeout=LIMIT_S)
        assert new.sender == "robot1/mission" and new.call("read") == {"duty": 0.2}
        assert engine.instance.heard == [0.1, 0.2]
        old.close()
        new.close()
        with pytest.raises(DriverError, match="without /"):
            Proxy(here, place, sender="robot2/mission")


def test_posts_outlive_deaths_of_a_driver_that_keeps_its_state(here: Here, folder: Path) -> None:
    count, lives = 400, 0
    done: list[Future[Any]] = []
    with counter(here, folder), reached(here) as first:
        place = first.place
    with Proxy(here, place) as proxy:
        while len(done) < count or not done[-1].done():
            lives += 1
            with counter(here, folder):
                while len(done) < min(lives * count // 4, count):
                    with contextlib.suppress(MailboxFullError):
                        done.append(proxy.post("add", sender="s", number=len(done)))
                wanted = len(done) if lives > 4 else len(done) - count // 8  # the death comes while some are on their way
                until(lambda wanted=wanted: done[wanted - 1].done())  # type: ignore[misc]
        with counter(here, folder):
            found = proxy.call("read", timeout=LIMIT_S)
    assert lives >= 4
    assert [one.result(0) for one in done] == list(range(1, count + 1)), "each answer is that of its message"
    assert [number for _, number in found["log"]] == list(range(count))


def test_an_answer_that_no_message_can_carry_is_refused_once_and_the_next_goes_on(here: Here) -> None:
    with serving(Engine, here), called(here, "engine") as proxy:
        for kind in ("", "error"):
            with pytest.raises(CallRefusedError, match="a message has 1048576 at most") as refused:
                proxy.call("picture", kind=kind)
            assert refused.value.kind == "bad_result"
        done, after = proxy.post("picture"), proxy.post("read")
        with pytest.raises(CallRefusedError, match="1048576"):
            done.result(LIMIT_S)
        assert after.result(LIMIT_S) == {"duty": 0.0}
        with pytest.raises(CallRefusedError, match="1048576"):
            next(proxy.stream("film"))


def test_a_verb_or_a_field_that_is_not_utf_8_is_not_taken_and_the_next_goes_on(here: Here) -> None:
    with serving(Engine, here) as engine, called(here, "engine") as proxy:
        for ask in (proxy.call, proxy.post, proxy.call):
            for verb, body in (("\ud800", None), ("set", {"\ud800": 1})):
                with pytest.raises(EnvelopeError, match="half of a character"):
                    ask(verb, body)
            proxy.call("set", duty=0.1, timeout=LIMIT_S)
        assert engine.instance.heard == [0.1] * 3


@pytest.mark.parametrize("is_posting", [False, True])
def test_a_body_that_no_message_can_carry_is_not_taken(here: Here, is_posting: bool) -> None:
    with serving(Engine, here), called(here, "engine") as proxy:
        if is_posting:
            proxy.post("set", duty=0.5).result(LIMIT_S)
        for take in (proxy.call, proxy.post):
            with pytest.raises(EnvelopeError, match="send the name of a file instead"):
                take("set", "x" * (1 << 20))
            with pytest.raises(EnvelopeError, match="512 are the most"):
                take("v" * 513)
        assert proxy.call("picture", size=1_000_000) == "x" * 1_000_000


@pytest.mark.parametrize("is_posting", [False, True])
def test_a_proxy_that_is_closed_takes_nothing_more_and_ends_a_call_that_waits(here: Here, is_posting: bool) -> None:
    with shut(here):
        proxy = called(here, "engine")
        if is_posting:
            proxy.post("set", duty=0.1)
        ended: list[BaseException] = []

        def call() -> None:
            try:
                proxy.call("set", duty=0.2, timeout=LIMIT_S)
            except NoAnswerError as error:
                ended.append(error)

        waiting = threading.Thread(target=call)
        waiting.start()
        until(lambda: proxy._sending._left == 1 + is_posting)
        proxy.close()
        waiting.join()
        assert "the proxy was closed; it may have been carried out" in str(ended[0])
        for take in (proxy.post, proxy.call):
            with pytest.raises(DriverError, match="the proxy is closed; make a new one"):
                take("set", duty=0.3)


def test_a_thread_that_sends_goes_on_when_the_names_cannot_be_asked(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    errors: list[Exception] = [
        OSError(errno.EMFILE, "Too many open files"),
        NameAmbiguousError("two"),
        zmq.ZMQError(errno.EMFILE),
    ]
    asked: list[Exception] = []

    def fails(*_: object) -> Place:
        asked.append(errors[len(asked) % len(errors)])
        raise asked[-1]

    with serving(Engine, here):
        place = lookup(here, "engine")
    with Proxy(here, place) as proxy:
        monkeypatch.setattr(route, "lookup", fails)
        done = proxy.post("set", duty=0.1)
        until(lambda: len(asked) >= len(errors) or done.done())
        assert not done.done()
        with serving(Engine, here):
            assert done.result(LIMIT_S) is None


def test_two_processes_of_one_sender_are_told_which_one_is_heard(here: Here) -> None:
    with serving(Engine, here) as engine:
        place = lookup(here, "engine")
        with Proxy(here, place, sender="mission") as old, Proxy(here, place, sender="mission") as new:
            assert new._sending._outbox._boot > old._sending._outbox._boot, "also within a millisecond"
            new.call("set", duty=0.2)
            with pytest.raises(CallRefusedError, match="robot1/mission was started again, or runs twice") as refused:
                old.call("set", duty=0.3, timeout=LIMIT_S)
            assert refused.value.kind == "outlived" and engine.instance.heard == [0.2]
            with pytest.raises(CallRefusedError, match="give each process a sender of its own"):
                old.post("set", duty=0.3).result(LIMIT_S)
            assert new.call("read") == {"duty": 0.2}


def test_the_lives_of_one_process_grow_when_the_clock_is_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    first = new_boot()
    monkeypatch.setattr(time, "time_ns", lambda: 1 << 40)
    assert first < new_boot() < new_boot()
