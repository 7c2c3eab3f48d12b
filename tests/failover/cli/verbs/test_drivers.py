"""failover names, call, send, path, with real drivers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from failover.cli import main
from failover.drivers.here import Here
from tests.failover.drivers.conftest import folder as folder
from tests.failover.drivers.conftest import here as here
from tests.failover.drivers.devices import ENGINE, Arm, Camera, Engine
from tests.failover.drivers.serving import Lab, serving, until


def said(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of one command line."""
    status = main.main(argv)
    out, err = capsys.readouterr()
    return status, out, err


def test_names_are_shown_as_a_tree(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(Engine, here), serving(Arm, here):
        status, out, _ = said(capsys, "names")
        lines = out.splitlines()
        assert status == 0 and lines[0] == "2 names"
        assert [line.split()[0] for line in lines[2:]] == ["Lab", "Robotino", "Arm", "Engines", "3", "PWM"]
        assert lines[-1].startswith("        PWM") and "engine" in lines[-1] and "set stall read" in lines[-1]
        status, out, _ = said(capsys, "names", "Lab/Robotino/Engines", "--json")
        (name,) = json.loads(out)["names"]
        assert (status, name["path"], name["reach"], name["robot"]) == (0, ENGINE, "live", "robot1")
        assert name["verbs"]["set"] == {"role": "command", "arguments": {"duty": {"type": "number", "minimum": -1, "maximum": 1}}}
        assert said(capsys, "names", "Lab/robot7")[::2] == (1, "failover: no driver is registered under Lab/robot7\n")


def test_call_carries_out_a_verb(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(Engine, here) as engine:
        assert said(capsys, "call", "engine", "set", '{"duty": 0.4}') == (0, "null\n", "")
        assert said(capsys, "call", ENGINE, "read") == (0, '{"duty": 0.4}\n', "")
        assert said(capsys, "call", "engine", "set", "0.5")[0] == 0 and engine.instance.heard == [0.4, 0.5]
        status, out, err = said(capsys, "call", "engine", "set", '{"duty": 4}')
        assert (status, out) == (1, "") and "failover: the body of set is not as declared" in err
        status, _, err = said(capsys, "call", "engine", "set", "{duty}")
        assert status == 1 and "is not JSON" in err
        status, _, err = said(capsys, "call", "motor", "read")
        assert status == 1 and "'motor' names nothing" in err
        engine.instance.gate.clear()
        status, _, err = said(capsys, "call", "engine", "set", "0.6", "--timeout-s", "0.2")
        engine.instance.gate.set()
        assert status == 1 and "did not answer 'set' within 0.2 s; it may still carry it out" in err


def test_send_sends_what_is_written(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(Engine, here) as engine:
        status, out, _ = said(capsys, "send", "engine", '{"body": {"duty": 0.3}, "odd": [1], "verb": "set", "id": "mine"}')
        answer = json.loads(out)
        assert (status, answer["re"], answer["ok"], engine.instance.duty) == (0, "mine", None, 0.3)
        status, out, _ = said(capsys, "send", "engine", '{"verb": "fly"}')
        assert status == 1 and json.loads(out)["error"]["kind"] == "unknown_verb"
        for message, words in (("[1]", "is a JSON object"), ('{"verb": 1}', "another kind")):
            status, out, err = said(capsys, "send", "engine", message)
            assert (status, out) == (1, "") and words in err


def test_path_tells_where_a_message_spent_its_time(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(Engine, here):
        called = json.loads(said(capsys, "call", "engine", "read", "--json")[1])
        status, out, _ = said(capsys, "path", called["id"], "--json")
        waiting, way, handling = json.loads(out)["parts"]
        assert (
            status == 0 and way["who"] == waiting["who"] and way["to"] == handling["who"] == f"robot1/{ENGINE.replace('/', '.')}"
        )
        assert all(0 <= part["at_least_ms"] <= part["took_ms"] <= part["at_most_ms"] for part in (waiting, way, handling))
        assert way["at_most_ms"] - way["at_least_ms"] < 0.01 * way["took_ms"] + 0.001  # one clock
        status, out, _ = said(capsys, "path", called["id"])
        assert status == 0 and len(out.splitlines()) == 5
        status, _, err = said(capsys, "path", "unheard")
        assert status == 1 and "none of the 1 drivers that answered remembers a message 'unheard'" in err


def test_a_path_between_robots_has_bounds(
    folder: Path, here: Here, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab(folder, "robot1", "robot2")
    there = lab.here("robot2")
    monkeypatch.setenv("FAILOVER_TEAM", str(lab.write("robot1")))
    with serving(Camera, there), serving(Engine, lab.here("robot1")) as engine:
        monkeypatch.setenv("FAILOVER_DRIVERS", str(lab.here("robot1").directory))
        until(lambda: len(engine.service.tree()) == 2)
        called = json.loads(said(capsys, "call", "Lab/robot2/Camera", "read", "--json")[1])
        status, out, _ = said(capsys, "path", called["id"], "--json")
        _, way, _ = json.loads(out)["parts"]
        assert status == 0 and 0 <= way["at_least_ms"] <= way["took_ms"] <= way["at_most_ms"]
        assert way["to"].startswith("robot2/")


@pytest.mark.parametrize("argv", [("names",), ("call", "engine", "read"), ("send", "engine", "{}"), ("path", "x")])
def test_without_a_driver_one_sentence(here: Here, capsys: pytest.CaptureFixture[str], argv: tuple[str, ...]) -> None:
    status, out, err = said(capsys, *argv)
    assert (status, out) == (1, "") and err.startswith("failover: no driver runs on robot1 for this user")
