"""A bundle comes from another robot over the team's encrypted connections, and is checked there."""

from __future__ import annotations

import base64
import getpass
from pathlib import Path

import pytest

from failover.core.programs import bundle
from failover.errors import CallRefusedError
from failover.programs import receiver
from tests.failover.drivers.serving import Lab as Team
from tests.failover.drivers.serving import called, serving
from tests.failover.programs.senders import Lab, engine


def test_a_bundle_of_several_parts_comes_from_another_robot(folder: Path, lab: Lab) -> None:
    team = Team(folder, "robot1", "robot2")
    content = lab.bundle(lab.source("1", engine(before=f"X = '{'x' * (2 * receiver.PART)}'")))
    cls = receiver.receiver(lab.store, lab.team, "robot1")
    with serving(cls, team.here("robot1")), called(team.here("robot2"), "robot1/programs") as proxy:
        assert receiver.send(proxy, content)["owner"] == getpass.getuser()
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
