"""A program is replaced by one with other verbs: callers of the version before go on, and so does the way of a message."""

from __future__ import annotations

import contextlib
import io
import json

from failover.cli import main
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.programs.channel import Hello, Verb
from failover.programs.host import declared
from failover.programs.hosting import Hosting
from failover.programs.sources import Place
from tests.failover.drivers.serving import LIMIT_S, serving, taking_messages
from tests.failover.drivers.test_further import Lamp
from tests.failover.programs.senders import Lab, engine, switched

TENFOLD = """
class One:
    def __init__(self, engine): self.engine = engine

    @failover.command
    def step(self, number: int) -> int:
        return self.engine.step(number=number * 10)
"""
CALLS = """
os.environ |= {{"FAILOVER_DRIVERS": "{directory}", "FAILOVER_ROBOT": "robot1"}}
with failover.proxy("lamp") as lamp:
    return lamp.call("shine", seconds=3)
"""


def test_callers_of_the_version_before_are_understood_after_a_switch(lab: Lab) -> None:
    lab.send("1", engine(terms='speaks="1"'))
    lab.send("2", engine(before=TENFOLD, terms='speaks="2", earlier={"1": One}'), seconds=0)
    with lab.hosting("1"), Proxy(lab.here, lookup(lab.here, "engine"), version="1") as old, lab.proxy() as newest:
        assert old.call("step", number=1) == 1
        assert switched(newest, "2")["active"] == "2"
        assert old.call("step", number=2, timeout=LIMIT_S) == 20
        assert newest.call("step", number=3) == 3 and newest.call("read") == [1, 20, 3]
        assert "step@1" in newest.call("_describe")["verbs"]


def test_what_a_program_calls_is_on_the_way_of_its_message(lab: Lab) -> None:
    own = Place(
        lab.store, lab.team, "engine", directory=lab.source("1", engine(extra=CALLS.format(directory=lab.here.directory)))
    )
    with serving(Lamp, lab.here), taking_messages(Hosting(own, "", lab.here)), lab.proxy() as proxy:
        assert proxy.call("fly") == 3
        assert proxy.last is not None
        with contextlib.redirect_stdout(io.StringIO()) as said:
            assert main.main(["path", proxy.last.re, "--json"]) == 0
    (further,) = json.loads(said.getvalue())["further"]
    assert [part["who"] for part in further[::2]] == [proxy.sender, "robot1/Lab.robot1.Engine", "robot1/Lab.Lamp"]


def test_a_host_names_the_verbs_of_earlier_versions_too() -> None:
    verbs = {name: Verb("command", "queue", 0) for name in ("set", "set@2", "set@1")}
    told = declared(Hello("Lab/Lamp", (), None, verbs, {"set": {}, "set@1": {}}, {}, (), (), ()), "")
    assert [one.name for one in told.shown] == ["set", "set@1"]
