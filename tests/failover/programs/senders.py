"""Programs to send, and who sends commands to them: ``python -m tests.failover.programs.senders NAME HZ LEAST`` is one."""

from __future__ import annotations

import contextlib
import itertools
import json
import select
import sys
import time
from pathlib import Path

from failover.core.programs.bundle import Program
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.programs import keys, packing
from failover.programs.hosting import Hosting
from failover.programs.sources import Place
from failover.programs.store import Store
from tests.failover.drivers.serving import taking_messages

NAME = "Lab/robot1/Engine"

MANIFEST = """
name = "engine"
version = "{version}"
path = "Lab/robot1/Engine"
entry = "engine.py:Engine"
on_rollback = "{on_rollback}"
{more}
[health]
seconds = {seconds}
messages = {messages}
query = "{query}"
answer_s = {answer_s}
[permissions]
network = {network}
"""

ENGINE = """
import os
import failover

{before}

@failover.driver("Lab/robot1/Engine", alias="engine", {terms})
class Engine:
    {kept}

    @failover.command
    def step(self, number: int) -> int:
{body}
        self.{numbers}.append(number)
        return number

    @failover.query
    def read(self) -> list[int]:
        return list(self.{numbers})

    @failover.query
    def fly(self, what: str = "") -> object:
{extra}
"""

RULES = """
[[rights.rules]]
groups = ["{user}"]
verbs = ["program"]
paths = ["Lab/robot1/**"]
"""


def engine(
    *,
    kept: str = "numbers: list[int] = failover.kept(default=[])",
    numbers: str = "numbers",
    body: str = "pass",
    extra: str = "return 1",
    terms: str = "",
    before: str = "",
) -> str:
    """The source of a driver that remembers the numbers it was told."""

    def indented(text: str) -> str:
        return "\n".join(f"        {line}" for line in text.splitlines())

    return ENGINE.format(kept=kept, numbers=numbers, body=indented(body), extra=indented(extra), terms=terms, before=before)


class Lab:
    """A robot's store and team directory, one user with a key and the right to send programs."""

    def __init__(self, folder: Path, here: Here, user: str) -> None:
        self.folder, self.here, self.user = folder, here, user
        self.team = folder / "t"
        self.team.mkdir()
        self.store = Store(folder / "s").open()
        self.key = folder / "user.key"
        self.public = keys.new_pair(self.key)
        self.trust()
        (self.team / "rights.toml").write_text(RULES.format(user=user))

    def trust(self, *, until: str = "", owner: str = "") -> None:
        """The team's file of keys, with this user's."""
        lines = f'[[keys]]\nowner = "{owner or self.user}"\npublic = "{self.public}"\nuntil = "{until}"\n'
        (self.team / "programs.toml").write_text(lines)

    def source(
        self,
        version: str,
        text: str = "",
        *,
        seconds: float = 0.2,
        messages: int = 0,
        query: str = "",
        answer_s: float = 20,
        on_rollback: str = "replay",
        network: bool = False,
        more: str = "",
    ) -> Path:
        """A directory with a program."""
        place = self.folder / f"engine-{version}"
        place.mkdir(exist_ok=True)
        (place / "engine.py").write_text(text or engine())
        terms = {"version": version, "seconds": seconds, "messages": messages, "query": query, "answer_s": answer_s, "more": more}
        (place / "program.toml").write_text(MANIFEST.format(**terms, on_rollback=on_rollback, network=str(network).lower()))
        return place

    def bundle(self, source: Path, until_s: int = 0) -> bytes:
        """It, packed and signed."""
        return packing.sign(packing.pack(source), keys.read_secret(self.key), until_s)

    def send(self, version: str, text: str = "", **terms: object) -> Program:
        """A version comes to the robot."""
        return self.store.take(self.bundle(self.source(version, text, **terms)), self.team).program  # type: ignore[arg-type]

    def hosting(self, version: str = "", *, beside: bool = False) -> contextlib.AbstractContextManager[Hosting]:
        """A host, until the body ends."""
        return taking_messages(Hosting(Place(self.store, self.team, "engine", beside=beside), version, self.here))

    def proxy(self, name: str = "engine") -> Proxy:
        """A way to it."""
        return Proxy(self.here, lookup(self.here, name))


def until(proxy: Proxy, condition: object, limit_s: float = 60) -> dict[str, object]:
    """Wait for what `_versions` tells."""
    deadline = time.monotonic() + limit_s
    while True:
        found: dict[str, object] = proxy.call("_versions", timeout=limit_s)
        if condition(found):  # type: ignore[operator]
            return found
        assert time.monotonic() < deadline, found
        time.sleep(0.01)


def switched(proxy: Proxy, version: str) -> dict[str, object]:
    """Order a switch, and wait until its trial is over, one way or the other."""
    proxy.call("_switch", {"version": version}, timeout=60)
    return until(proxy, lambda found: not found["is_coming"] and not found["on_trial"] and found["said"])


def main(name: str, rate_hz: str, least: str) -> None:
    """Send numbers at a rate until the input ends; print what came of each as JSON."""
    from failover.drivers.here import here

    place = here()
    answers, took_ms = [], []
    with Proxy(place, lookup(place, name)) as proxy:
        print("begun", flush=True)
        due = time.monotonic()
        for number in itertools.count():
            if number >= int(least) and select.select([sys.stdin], [], [], 0)[0]:
                break
            time.sleep(max(due - time.monotonic(), 0))
            due += 1 / float(rate_hz)
            began = time.monotonic()
            answers.append(proxy.call("step", number=number, timeout=60))
            took_ms.append(round((time.monotonic() - began) * 1e3, 3))
    print(json.dumps({"answers": answers, "took_ms": took_ms}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
