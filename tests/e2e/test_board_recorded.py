"""A recording over a takeover: the values of both copies, and what the agents decided, as a log."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.core.board import recording
from failover.recording.mcap_file import Recorded
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_board import board_of, two_with_boards
from tests.e2e.test_component_item import PROGRAM, ROOT


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    pytest.importorskip("mcap")
    with two_with_boards(tmp_path, monkeypatch) as both:
        yield both


@pytest.mark.root
def test_a_takeover_is_in_the_recording_of_the_robot_that_took_over(
    pair: tuple[RobotMachine, RobotMachine], tmp_path: Path
) -> None:
    first, second = pair
    path, link = tmp_path / "team.mcap", tmp_path / "board"
    link.symlink_to(board_of(first).resolve())
    robots.run(first, "count", sys.executable, "-c", PROGRAM, env={"FAILOVER_BOARD": str(link), "PYTHONPATH": str(ROOT)})
    robots.until_protected(first)
    name = robots.component(first, "count")["name"]
    command = [sys.executable, "-m", "failover", "board", "record", str(path), "--board", str(board_of(second))]
    with subprocess.Popen([*command, "--socket", str(second.socket)], cwd=ROOT, stdout=subprocess.PIPE, text=True) as recorder:
        robots.until(lambda: path.exists() and path.stat().st_size > 1000, "values of robot1 in the file")
        aside = tmp_path / "aside"
        aside.symlink_to(board_of(second).resolve())
        os.replace(aside, link)
        first.cut_power()
        robots.until_taken_over(second)
        robots.until(lambda: topics(path).get("/robot2/map"), "values of robot2 in the file")
        robots.until(lambda: any(name in one["name"] for one in decisions(path)), "the decision in the file")
        recorder.send_signal(signal.SIGINT)
        out, _ = recorder.communicate()
    assert recorder.returncode == 0 and " of 2 robots" in out
    found = topics(path)
    assert {"/robot1/map", "/robot2/map", recording.ROBOTS_TOPIC, recording.DECISIONS_TOPIC} <= set(found)
    taken = [one for one in decisions(path) if one["name"] == f"robot2 {name}" and one["level"] == recording.WARNING]
    assert taken and all(one["message"] for one in taken)
    for topic in ("/robot1/map", "/robot2/map"):
        counted = [json.loads(content)["value"][1] for content in found[topic]]
        assert counted == sorted(set(counted)) and counted[0] > 0, topic


def topics(path: Path) -> dict[str, list[bytes]]:
    """Topic → messages, of a file that may be growing."""
    found: dict[str, list[bytes]] = {}
    for _, channel, message in Recorded(path).messages():
        found.setdefault(channel.topic, []).append(message.data)
    return found


def decisions(path: Path) -> list[dict[str, object]]:
    return [json.loads(one) for one in topics(path).get(recording.DECISIONS_TOPIC, [])]
