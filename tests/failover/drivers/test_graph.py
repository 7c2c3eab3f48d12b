"""failover graph, against drivers that were called: equal to the matrix of what was sent."""

from __future__ import annotations

import contextlib
import json
import random
import threading
from collections import Counter
from typing import Any

import pytest

from failover.cli import main
from failover.core.messaging.envelope import Envelope, encode
from failover.core.messaging.traffic import Traffic
from failover.drivers.actor import Whose
from failover.drivers.here import Here
from failover.drivers.local import LocalWay
from failover.drivers.server import Serving
from failover.errors import CallRefusedError, DriverError
from tests.failover.drivers.devices import ENGINE, Arm, Engine
from tests.failover.drivers.serving import LIMIT_S, called, serving, until


def test_the_graph_is_the_matrix_of_what_was_sent(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    counts: Counter[tuple[str, str, str]] = Counter()
    errors: Counter[tuple[str, str, str]] = Counter()
    sizes: Counter[str] = Counter()
    lock = threading.Lock()

    def send(name: str, seed: int) -> None:
        """Raw messages, so that their sizes are known."""
        dice = random.Random(seed)
        way = LocalWay(str(here.file(ENGINE, "calls")))
        for number in range(dice.randrange(20, 40)):
            verb, duty = dice.choice([("set", 0.5), ("set", 7), ("read", None), ("stall", None)])
            body = {"duty": duty} if duty is not None else {}
            content = encode(Envelope("engine", verb, body, id=f"{name}-{number}", sender=f"robot1/{name}-{seed}-1"))
            assert way.await_sent(content, LIMIT_S * 10**9) and way.await_message(LIMIT_S * 10**9) is not None
            with lock:
                counts[f"robot1/{name}", ENGINE, verb] += 1
                errors[f"robot1/{name}", ENGINE, verb] += duty == 7 or verb == "stall"
                sizes[f"robot1/{name}"] += len(content)
        way.close()

    with serving(Engine, here) as engine, serving(Arm, here):
        threads = [threading.Thread(target=send, args=(name, seed)) for seed, name in enumerate(["one", "two", "three"])]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        with called(here, "engine") as proxy, contextlib.suppress(CallRefusedError):
            proxy.call("_describe")  # a driver's own verbs are no edges
        until(lambda: len(engine.service.tree()) == 2)
        assert main.main(["graph", "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert main.main(["graph", "--dot"]) == 0
        dot = capsys.readouterr().out
        assert main.main(["graph"]) == 0
        table = capsys.readouterr().out
    edges = {(one["from"], one["to"], one["verb"]): one for one in told["edges"]}
    assert {edge: one["count"] for edge, one in edges.items()} == counts
    assert {edge: one["errors"] for edge, one in edges.items()} == errors
    for name, size in sizes.items():
        assert sum(one["bytes"] for edge, one in edges.items() if edge[0] == name) == size
    assert all(one["p99_us"] for one in edges.values()) and told["silent"] == []
    assert dot.count(" -> ") == len(edges) and dot.startswith("digraph")
    assert table.count("robot1/") == len(edges)


def test_an_answer_leaves_before_its_message_is_counted(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[str] = []
    publish, done = Serving._publish, Traffic.done

    def published(self: Serving, whose: Whose, envelope: Envelope) -> bool:
        left.append("answer")
        return publish(self, whose, envelope)

    def counted(self: Traffic, *arguments: Any, **named: Any) -> None:
        left.append("count")
        done(self, *arguments, **named)

    monkeypatch.setattr(Serving, "_publish", published)
    monkeypatch.setattr(Traffic, "done", counted)
    with serving(Engine, here), called(here, "engine") as proxy:
        for _ in range(3):
            proxy.call("read")
    assert left == ["answer", "count"] * 3


@pytest.mark.parametrize(
    "answer",
    [
        None,
        7,
        "rows",
        {"from": "x"},
        [1],
        [{}],
        [{"from": "x", "verb": "set", "count": "many", "bytes": 1, "errors": 0, "p99_us": None}],
        [{"from": "x", "verb": "set", "count": -1, "bytes": 1, "errors": 0, "p99_us": None}],
        [{"from": "x", "verb": "set", "count": 1, "bytes": 1, "errors": 0, "p99_us": []}],
    ],
)
def test_a_driver_whose_answer_is_no_graph_gets_one_sentence_and_the_others_are_shown(
    here: Here, capsys: pytest.CaptureFixture[str], answer: object
) -> None:
    with serving(Engine, here) as engine, serving(Arm, here):
        with called(here, "arm") as proxy:
            proxy.call("read")
        engine._actor._own = {**engine._actor._own, "_graph": lambda *_: answer}
        until(lambda: len(engine.service.tree()) == 2)
        for words in (["graph"], ["graph", "--dot"], ["graph", "--json"]):
            assert main.main(words) == 1
            out, err = capsys.readouterr()
            assert err.startswith(f"failover: {ENGINE} answered _graph in a form that failover does not know: ")
            assert err.count("\n") == 1 and "read" in out


@pytest.mark.parametrize("answer", [7, [["x", "abc", None]], [["x", 1, 1 << 60]], [[1]], {"x": 1}])
def test_a_driver_whose_answer_is_no_way_of_a_message_is_passed_over(
    here: Here, capsys: pytest.CaptureFixture[str], answer: object
) -> None:
    with serving(Engine, here) as engine:
        engine._actor._own = {**engine._actor._own, "_path": lambda *_: answer}
        assert main.main(["path", "unheard"]) == 1
        assert "drivers that answered remembers a message 'unheard'" in capsys.readouterr().err


@pytest.mark.parametrize("answer", [None, 7, {"verbs": 7}, {"verbs": {"current": "stream"}}])
def test_a_stream_of_a_driver_that_does_not_say_what_it_has_is_refused(here: Here, answer: object) -> None:
    with serving(Engine, here) as engine, called(here, "engine") as proxy:
        engine._actor._own = {**engine._actor._own, "_describe": lambda *_: answer}
        with pytest.raises(DriverError, match="answered _describe in a form"):
            next(iter(proxy.stream("current")))
