"""failover graph, against drivers that were called: equal to the matrix of what was sent."""

from __future__ import annotations

import contextlib
import json
import random
import threading
from collections import Counter

import pytest

from failover.cli import main
from failover.core.messaging.envelope import Envelope, encode
from failover.drivers.here import Here
from failover.drivers.local import LocalWay
from failover.errors import CallRefusedError
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
