"""The recipes of docs/recipes.md for zenoh and Cyclone DDS: a subscriber hears on after it, or its publisher, was restored."""

from __future__ import annotations

import importlib.util
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, Terms
from checkpoint.errors import UnsupportedError
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    at_last,
    captured_and_killed,
    captured_at_last,
    ended,
    restored,
    start,
    transported,
)

HERE = Path(__file__).parent
SHM = Path("/dev/shm")
HOW = "pip install --require-hashes -r requirements-recipes.txt"
LOOPBACK = (
    '<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces></General>'
    "<SharedMemory><Enable>false</Enable></SharedMemory>"
)
DOMAIN = 77

pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]
needs_zenoh = pytest.mark.skipif(importlib.util.find_spec("zenoh") is None, reason=f"needs eclipse-zenoh: {HOW}")
needs_cyclone = pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason=f"needs cyclonedds: {HOW}")


def node(directory: Path, script: str, what: str, *arguments: str) -> Program:
    """A program that runs, in a folder of its own."""
    place = directory / what
    place.mkdir()
    environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK}
    program = start([sys.executable, HERE / script, what, *arguments], place, env=environment)
    program.wait_for_line("ready")
    return program


def heard(listener: Program) -> int:
    """The number that it heard last; 0 for none."""
    numbers = [line for line in listener.output.splitlines() if line.isdecimal()]
    return int(numbers[-1]) if numbers else 0


def await_more(listener: Program) -> None:
    """Until it has heard some more."""
    before = heard(listener)
    listener.wait_until(lambda: heard(listener) >= before + 5, f"more than {before} heard")


@pytest.fixture
def port() -> str:
    """A free one."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return str(free.getsockname()[1])


@pytest.fixture(autouse=True)
def segments_removed() -> Iterator[None]:
    """What killed programs of zenoh leave in /dev/shm goes with the test."""
    before = set(SHM.glob("*.zenoh"))
    yield
    for left in set(SHM.glob("*.zenoh")) - before:
        left.unlink(missing_ok=True)


# --- zenoh ---------------------------------------------------------------------------------------------------------------


@needs_zenoh
@pytest.mark.parametrize("moved", ["listener", "talker"])
def test_a_zenoh_program_without_shared_memory_connects_anew_to_its_router(moved: str, port: str, tmp_path: Path) -> None:
    with ended(node(tmp_path, "zenoh_node.py", "router", port, "false")):
        with ended(node(tmp_path, "zenoh_node.py", "listener", port, "false")) as listener:
            with ended(node(tmp_path, "zenoh_node.py", "talker", port, "false")) as talker:
                await_more(listener)
                one = listener if moved == "listener" else talker
                snapshot = captured_and_killed(one)
                with ended(restored(snapshot, one.directory)) as again:
                    await_more(again if moved == "listener" else listener)


@needs_zenoh
def test_a_zenoh_program_with_shared_memory_is_told_the_switch(port: str, tmp_path: Path) -> None:
    with ended(node(tmp_path, "zenoh_node.py", "router", port, "true")):
        with ended(node(tmp_path, "zenoh_node.py", "listener", port, "true")) as listener:
            with ended(node(tmp_path, "zenoh_node.py", "talker", port, "true")):
                await_more(listener)
                with pytest.raises(UnsupportedError, match="zenoh made it: set transport/shared_memory/enabled to false"):
                    ENGINE.protect(listener.pid, ProtectOrder("/test/listener"))


@needs_zenoh
def test_a_zenoh_program_with_shared_memory_is_captured_by_the_rule_detach(port: str, tmp_path: Path) -> None:
    """It finds its peers gone and opens new segments with them: what it had of the old ones is its own copy."""
    with ended(node(tmp_path, "zenoh_node.py", "router", port, "true")):
        with ended(node(tmp_path, "zenoh_node.py", "listener", port, "true")) as listener:
            with ended(node(tmp_path, "zenoh_node.py", "talker", port, "true")):
                await_more(listener)
                order = ProtectOrder("/test/listener", terms=Terms(detaches_memory=True))
                session = at_last(lambda: ENGINE.protect(listener.pid, order))
                try:
                    snapshot = transported(captured_at_last(session, CaptureOrder()))
                    listener.kill()
                finally:
                    session.close()
                with ended(restored(snapshot, listener.directory)) as again:
                    await_more(again)


# --- Cyclone DDS ---------------------------------------------------------------------------------------------------------


@needs_cyclone
@pytest.mark.parametrize("moved", ["listener", "talker"])
def test_a_program_of_cyclone_dds_goes_on(moved: str, tmp_path: Path) -> None:
    with ended(node(tmp_path, "cyclone_node.py", "listener", str(DOMAIN))) as listener:
        with ended(node(tmp_path, "cyclone_node.py", "talker", str(DOMAIN))) as talker:
            await_more(listener)
            one = listener if moved == "listener" else talker
            snapshot = captured_and_killed(one)
            with ended(restored(snapshot, one.directory)) as again:
                await_more(again if moved == "listener" else listener)
