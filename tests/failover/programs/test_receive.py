"""A bundle comes from another robot over the team's encrypted connections, and is checked there."""

from __future__ import annotations

import base64
import getpass
from pathlib import Path
from typing import ClassVar

import pytest

import failover
from failover.cli import main
from failover.core.programs import bundle
from failover.errors import CallRefusedError, DriverError
from failover.programs import receiver
from tests.failover.drivers.serving import Lab as Team
from tests.failover.drivers.serving import called, serving
from tests.failover.programs.senders import Lab, engine


def test_a_bundle_of_several_parts_comes_from_another_robot(folder: Path, lab: Lab) -> None:
    team = Team(folder, "robot1", "robot2")
    content = lab.bundle(lab.source("1", engine(before=f"X = '{'x' * (2 * receiver.PART)}'")))
    cls = receiver.receiver(lab.store, lab.team, "robot1")
    with serving(cls, team.here("robot1")), called(team.here("robot2"), "robot1/programs") as proxy:
        assert receiver.send(proxy, content).owner == getpass.getuser()
        assert [one.version for one in lab.store.shelf("engine").versions] == ["1"]
        with pytest.raises(CallRefusedError, match="has no signature"):
            receiver.send(proxy, bytes(bundle.split(content)[1]))
        digest = "0" * 64
        for verb, body, words in (
            ("offer", {"digest": "x", "size": 1}, "matching regex"),
            ("offer", {"digest": digest, "size": 1 << 40}, "<="),
            ("part", {"digest": digest, "at": 0, "content": ""}, "do not follow"),
            ("finish", {"digest": digest}, "has not come whole"),
        ):
            with pytest.raises(CallRefusedError, match=words):
                proxy.call(verb, body)
        assert proxy.call("offer", {"digest": digest, "size": 3}) == 0
        with pytest.raises(CallRefusedError, match="more bytes than were offered"):
            proxy.call("part", {"digest": digest, "at": 0, "content": base64.b64encode(b"four").decode()})
        with pytest.raises(CallRefusedError, match="another bundle is on its way"):
            proxy.call("offer", {"digest": "1" * 64, "size": 3})


def test_a_driver_that_answers_as_no_robot_that_takes_bundles_does_gets_one_sentence(lab: Lab) -> None:
    @failover.driver("robot1/programs")
    class Odd:
        answers: ClassVar[dict[str, object]] = {"offer": 0, "part": 0, "finish": {}}

        @failover.command
        def offer(self, digest: str, size: int) -> object:
            return self.answers["offer"]

        @failover.command
        def part(self, digest: str, at: int, content: str) -> object:
            return self.answers["part"]

        @failover.command
        def finish(self, digest: str) -> object:
            return self.answers["finish"]

    content = lab.bundle(lab.source("1"))
    with serving(Odd, lab.here), called(lab.here, "robot1/programs") as proxy:
        with pytest.raises(DriverError, match="has 0 bytes of the bundle"):
            receiver.send(proxy, content)
        Odd.answers["offer"] = -1
        with pytest.raises(DriverError, match="has -1 bytes of the bundle, and 0 were sent"):
            receiver.send(proxy, content)
        Odd.answers["offer"] = 0
        for verb, answer in (("finish", {"name": 7}), ("part", "all"), ("offer", None)):
            Odd.answers |= {"part": len(content), verb: answer}
            with pytest.raises(DriverError, match=f"robot1/programs answered {verb} in a form that failover does not know"):
                receiver.send(proxy, content)


def test_a_program_whose_name_another_driver_has_is_listed_with_a_sentence(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    @failover.driver("Lab/robot1/Engine")
    class Other:
        @failover.query
        def read(self) -> int:
            return 1

    lab.send("1")
    with serving(Other, lab.here) as other:
        assert main.main(["program", "list"]) == 0
        assert "is no host of failover's: Lab/robot1/Engine has no verb '_versions'" in capsys.readouterr().out
        other._actor._own = {**other._actor._own, "_versions": lambda *_: {"name": "engine"}}
        assert main.main(["program", "list"]) == 0
        assert "answered _versions in a form" in capsys.readouterr().out


def test_orders_of_another_robot_are_refused(folder: Path, lab: Lab) -> None:
    team = Team(folder, "robot1", "robot2")
    lab.send("1")
    lab.here = team.here("robot1")
    with lab.hosting("1"), called(team.here("robot2"), "engine") as proxy:
        assert proxy.call("step", number=1, timeout=30) == 1
        with pytest.raises(CallRefusedError, match="give this order on the robot itself"):
            proxy.call("_switch", {"version": "1"}, timeout=30)
        with pytest.raises(CallRefusedError, match="give this order on the robot itself"):
            proxy.call("_rollback", timeout=30)
