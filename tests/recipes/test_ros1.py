"""The recipes of docs/recipes.md for ROS 1, with real nodes of Debian's packages: a lone node with its hook; a whole graph."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from xmlrpc.client import ServerProxy

import pytest

from tests.checkpoint.round_trip import Program, captured_and_killed, ended, restored, start

ROOT = Path(__file__).parents[2]
NODE = Path(__file__).with_name("ros1_node.py")
HOOK = ROOT / "examples" / "ros1_reregister.py"
SYSTEM_PYTHON = "/usr/bin/python3"
PACKAGES = "python3-rospy python3-roslaunch python3-rosmaster python3-std-msgs ros-std-msgs rosout"


def has_ros() -> bool:
    """Whether Debian's Python has ROS 1."""
    if not (os.path.exists(SYSTEM_PYTHON) and shutil.which("rosmaster") and shutil.which("roslaunch")):
        return False
    words = [SYSTEM_PYTHON, "-c", "import rospy, std_msgs.msg"]
    return subprocess.run(words, capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.root,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not has_ros(), reason=f"needs ROS 1: apt-get install {PACKAGES}"),
]


class Graph:
    """A ROS master of its own, and what nodes must know of it."""

    def __init__(self, directory: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        self.directory = directory
        ros = {
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(directory),
            "ROS_LOG_DIR": str(directory / "log"),
        }
        self.environment = {**os.environ, **ros}
        self.environment.pop("PYTHONPATH", None)

    @contextlib.contextmanager
    def master(self) -> Iterator[None]:
        """It runs for the body."""
        words = ["rosmaster", "--core", "-p", str(self.port)]
        process = subprocess.Popen(words, env=self.environment, stdin=subprocess.DEVNULL, start_new_session=True)
        try:
            self.await_master()
            yield
        finally:
            process.kill()
            process.wait()

    def await_master(self) -> None:
        """Until it answers."""
        deadline = time.monotonic() + 60
        while True:
            try:
                ServerProxy(self.uri).getPid("/test")
                return
            except OSError:
                assert time.monotonic() < deadline, "the ROS master did not come up"
                time.sleep(0.05)

    def node(self, what: str, words: list[str | Path] | None = None) -> Program:
        """A node that runs, named like what it does."""
        directory = self.directory / what
        directory.mkdir()
        program = start([*(words or [SYSTEM_PYTHON, NODE]), what, what], directory, env=self.environment)
        program.wait_for_line("ready")
        return program

    def register_again(self, name: str) -> None:
        """What ``after_resume`` runs."""
        words = [sys.executable, HOOK, f"/{name}", self.uri]
        ran = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        assert ran.returncode == 0, ran.stderr
        assert f"/{name} is registered again" in ran.stdout


def heard(listener: Program) -> int:
    """The number that it heard last; 0 for none."""
    numbers = [line for line in listener.output.splitlines() if line.isdecimal()]
    return int(numbers[-1]) if numbers else 0


def await_more(listener: Program, count: int = 5) -> None:
    """Until it has heard some more."""
    before = heard(listener)
    listener.wait_until(lambda: heard(listener) >= before + count, f"more than {before} heard")


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    """A master that runs."""
    made = Graph(tmp_path)
    with made.master():
        yield made


def test_a_lone_subscriber_hears_again_once_its_hook_has_run(graph: Graph) -> None:
    with ended(graph.node("talker")), ended(graph.node("listener")) as listener:
        await_more(listener)
        snapshot = captured_and_killed(listener)
        with ended(restored(snapshot, listener.directory)) as again:
            graph.register_again("listener")
            await_more(again)


def test_a_lone_publisher_is_heard_again_once_its_hook_has_run(graph: Graph) -> None:
    with ended(graph.node("listener")) as listener, ended(graph.node("talker")) as talker:
        await_more(listener)
        snapshot = captured_and_killed(talker)
        with ended(restored(snapshot, talker.directory)):
            graph.register_again("talker")
            await_more(listener)


@pytest.mark.compiler
def test_a_lone_subscriber_in_cpp_connects_anew_by_itself(graph: Graph, tmp_path: Path) -> None:
    program, libraries = tmp_path / "node", ["-lroscpp", "-lrosconsole", "-lrostime", "-lroscpp_serialization"]
    words = ["c++", "-O1", "-o", program, Path(__file__).with_name("ros1_node.cpp"), *libraries]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("needs roscpp: apt-get install libroscpp-dev libstd-msgs-dev")
    with ended(graph.node("talker")), ended(graph.node("listener", [program])) as listener:
        await_more(listener)
        snapshot = captured_and_killed(listener)
        with ended(restored(snapshot, listener.directory)) as again:
            await_more(again)


LAUNCH = """
<launch>
  <node name="talker" pkg="chat" type="node" args="talker talker" />
  <node name="listener" pkg="chat" type="node" args="listener listener" output="screen" />
</launch>
"""


def test_a_graph_that_is_one_component_goes_on_without_a_lost_message(tmp_path: Path) -> None:
    """roslaunch, its master and both nodes are captured, killed and restored together: no connection is lost."""
    package = tmp_path / "packages" / "chat"
    package.mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>chat</name></package>")
    (package / "node").write_text(f'#!/bin/sh\nexec {SYSTEM_PYTHON} -u {NODE} "$@"\n')
    (package / "node").chmod(0o755)
    (tmp_path / "chat.launch").write_text(LAUNCH)
    graph, directory = Graph(tmp_path), tmp_path / "whole"
    directory.mkdir()
    environment = {**graph.environment, "ROS_PACKAGE_PATH": f"{package.parent}:/usr/share"}
    words = [SYSTEM_PYTHON, shutil.which("roslaunch") or "", "-p", str(graph.port), str(tmp_path / "chat.launch")]
    launched = start(words, directory, env=environment, isolate=True)
    with ended(launched):
        await_more(launched, 10)
        snapshot = captured_and_killed(launched)
    count = heard(launched)
    with ended(restored(snapshot, directory)) as again:
        again.wait_until(lambda: heard(again) >= count + 20, "the graph going on")
    numbers = [int(line) for line in again.output.splitlines() if line.isdecimal()]
    missing = set(range(min(numbers), max(numbers) + 1)) - set(numbers)
    assert not missing, f"messages were lost: {sorted(missing)}"
